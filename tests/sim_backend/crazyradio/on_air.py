"""Vehicles that only remember, and a clock on which waiting takes no time."""

from __future__ import annotations

import threading

from crazyarena.sim_backend.crazyradio.air import Air, InUse, Station
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


def is_free(air):
    """Whether nobody holds the dongles; cflib's driver lets go in a thread of its own, and what
    connects before goes on with the dongle, and the air, of before."""
    try:
        for serial in air.serials:
            air.claim(serial, "test")
            air.release(serial, "test")
    except InUse:
        return False
    return True
