"""The vehicle's end of the radio, with the manners of the server's UDP links."""

from __future__ import annotations

import contextlib
import math
import random
import socket
import threading
from collections import deque
from typing import Any

from crazyarena.clock import Clock
from crazyarena.sim_backend.crazyradio.air import Station
from crazyarena.sim_backend.crazyradio.air_time import Rate
from crazyarena.sim_backend.crazyradio.receiver import Receiver
from crazyarena.sim_backend.crtp.faults import ChannelCounters, Faults
from crazyarena.sim_backend.crtp.packets import EVERYBODY

_INBOX = 15  # frames that the radio chip holds for the flight controller
_BOOT = 2.0  # s, from power until the vehicle answers
_ALL_OFF, _SYSTEM_OFF, _SYSTEM_ON, _RESET = 0x01, 0x02, 0x03, 0xF0


class Delay:
    """One direction between radio chip and flight controller: it delays, and never reorders."""

    def __init__(self, faults: Faults, rng: random.Random) -> None:
        self._faults = faults
        self._rng = rng
        self._waiting: deque[tuple[float, bytes, bool]] = deque()
        self.counters = ChannelCounters()

    def __len__(self) -> int:
        return len(self._waiting)

    def send(self, packet: bytes, now: float, everybody: bool = False) -> None:
        """Hand in a packet, and whether it is for everybody."""
        self.counters.carried += 1
        jitter = self._faults.jitter
        delay = self._faults.latency + (self._rng.uniform(-jitter, jitter) if jitter else 0.0)
        arrival = now + delay
        if self._waiting:
            arrival = max(arrival, self._waiting[-1][0])
        self._waiting.append((arrival, packet, everybody))

    def due(self) -> float:
        """When the next packet arrives, s; inf if none is under way."""
        return self._waiting[0][0] if self._waiting else math.inf

    def take(self, now: float) -> list[tuple[bytes, bool]]:
        """Packets that have arrived, and whether they are for everybody."""
        arrived = []
        while self._waiting and self._waiting[0][0] <= now:
            arrived.append(self._waiting.popleft()[1:])
        return arrived

    def clear(self) -> None:
        self._waiting.clear()


class RadioLink:
    """One vehicle on the air, as :class:`~crazyarena.sim_backend.crtp.server.VirtualServer` wants
    its links.

    Loss of ``faults`` is that of a single attempt, both ways; latency and jitter lie between
    radio chip and flight controller; a cut is a vehicle out of range.

    Parameters
    ----------
    channel, rate, address: of the vehicle's radio; ``dongle`` only stands in :attr:`uri`.
    clock: that of the server.
    faults: may be changed at any time.
    seed: of the jitter.
    """

    def __init__(
        self,
        channel: int,
        rate: Rate,
        address: bytes,
        clock: Clock,
        faults: Faults,
        *,
        dongle: int = 0,
        seed: int = 0,
    ) -> None:
        self.faults = faults
        rng = random.Random(seed)
        self.uplink = Delay(faults, rng)
        self.downlink = Delay(faults, rng)
        self.receiver = Receiver(self._deliver, self._power)
        self.station = Station(channel, rate, address, self.receiver, self._loss, self._loss)
        self.uri = f"radio://{dongle}/{channel}/{rate.label}/{address.hex().upper()}"
        self._clock = clock
        self._lock = threading.Lock()
        self._rebooted = False
        self._powered = True
        self._ear, self._bell = socket.socketpair()
        self._ear.setblocking(False)
        self._bell.setblocking(False)

    def _loss(self, now: float) -> float:
        return 1.0 if now < self.faults.cut_until else self.faults.loss

    # From the air, in whatever thread the dongle has

    def _deliver(self, packet: bytes, everybody: bool) -> bool:
        with self._lock:
            if not self._powered:
                return True  # the radio chip lives on without the flight controller
            if len(self.uplink) >= _INBOX and self.uplink.due() <= self._clock.now():
                return False
            self.uplink.send(packet, self._clock.now(), everybody)
        self._ring()
        return True

    def _power(self, request: int) -> None:
        now = self._clock.now()
        if request == _ALL_OFF:
            self.station.silent_until = math.inf
            self._powered = False
        elif request == _SYSTEM_OFF:
            self._powered = False
        elif request in (_SYSTEM_ON, _RESET):
            if request == _RESET:
                self.station.silent_until = now + _BOOT
            self._powered = True
        else:
            return
        # Without power the motors stop, as they do when the firmware begins again.
        self._rebooted = True
        self._ring()

    def _ring(self) -> None:
        try:
            self._bell.send(b"\0")
        except OSError:
            return  # rung already, or closed

    # For the server

    def fileno(self) -> int:
        """For a selector: readable when something came in."""
        return self._ear.fileno()

    def receive(self, now: float) -> list[tuple[bytes, Any]]:
        """Packets that have reached the flight controller."""
        with contextlib.suppress(OSError):
            self._ear.recv(4096)
        with self._lock:
            return [
                (packet, EVERYBODY if everybody else None)
                for packet, everybody in self.uplink.take(now)
            ]

    def boots(self) -> bool:
        """Whether somebody has switched the flight controller off or on over the radio since the
        last call."""
        asked, self._rebooted = self._rebooted, False
        return asked

    def send(self, datagram: bytes, now: float, receiver: Any = None) -> None:
        """Queue a packet for the ground station."""
        if self._powered:
            self.downlink.send(datagram, now)

    def flush(self, now: float) -> None:
        """Hand to the radio chip what has come through."""
        for packet, _ in self.downlink.take(now):
            if not self.receiver.say(packet):
                self.downlink.counters.lost += 1

    def due(self) -> float:
        """When the next packet under way arrives, s; inf if none."""
        return min(self.uplink.due(), self.downlink.due())

    def reboot(self, now: float) -> None:
        """The vehicle is switched off and on: silent while it boots, and nothing waits."""
        with self._lock:
            self.uplink.clear()
        self.downlink.clear()
        self.receiver.reset()
        self._powered = True
        self.station.silent_until = now + _BOOT

    def report(self) -> str:
        """What was received and sent, in words."""
        radio = self.receiver.counters
        return (
            f"heard {radio.heard} frames (delivered {radio.delivered}, doubles {radio.doubles}, "
            f"refused {radio.refused}) and {radio.broadcast} for everybody, "
            f"sent {self.downlink.counters.carried} (lost {radio.overflowed})"
        )

    def close(self) -> None:
        self.station.silent_until = math.inf
        self._ear.close()
        self._bell.close()
