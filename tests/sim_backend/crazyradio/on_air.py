"""Vehicles that only remember, and a clock on which waiting takes no time."""

from __future__ import annotations

import threading

from crazyarena.sim_backend.crazyradio.air import Air, Station
from crazyarena.sim_backend.crazyradio.air_time import Rate
from crazyarena.sim_backend.crazyradio.receiver import Receiver

ADDRESS = bytes.fromhex("e7e7e7e701")


class Leaping:
    """A clock that jumps to every deadline."""

    def __init__(self):
        self._now = 0.0
        self._lock = threading.Lock()

    def now(self):
        return self._now

    def sleep_until(self, deadline):
        with self._lock:
            self._now = max(self._now, deadline)
        return 0.0


class Vehicle:
    """A radio chip and what it has handed on."""

    def __init__(self, address=ADDRESS, channel=80, rate=Rate.M2, **station):
        self.got = []
        self.room = True
        self.receiver = Receiver(self._take)
        self.station = Station(channel, rate, address, self.receiver, **station)

    def _take(self, packet, everybody):
        if self.room:
            self.got.append(packet)
        return self.room


def air_with(*vehicles, **options):
    return Air([vehicle.station for vehicle in vehicles], **options)
