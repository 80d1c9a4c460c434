"""Repeats an emergency stop until the vehicle says that it is locked."""

from __future__ import annotations

import math

from crazyarena.crazyswarm_compat.radio.lanes import Job, Lane
from crazyarena.crazyswarm_compat.radio.packets import Packet

_SLOW = 0.1  # s, between repeats after the burst


class EmergencyLane:
    """The mailbox of emergency stops; its owner holds the lock.

    Parameters
    ----------
    repeats, interval: of the burst, s.
    patience: how long it is repeated ten times a second after the burst, s.

    Attributes
    ----------
    locked: whether a stop was requested.
    due: when the next packet may go, ``inf`` for none.
    """

    def __init__(self, repeats: int, interval: float, patience: float) -> None:
        self._repeats = repeats
        self._interval = interval
        self._patience = patience
        self._packet: Packet | None = None
        self._born = 0.0
        self._count = 0
        self.due = math.inf
        self.locked = False

    def request(self, packet: Packet, now: float) -> None:
        """Begin, or begin again."""
        self._packet = packet
        self._born = self.due = now
        self._count = 0
        self.locked = True

    def confirmed(self) -> None:
        """The vehicle is locked: no more, once the burst is over."""
        if self._count >= self._repeats:
            self.due = math.inf

    def forget(self) -> None:
        """The vehicle was rebooted."""
        self.locked = False
        self.due = math.inf

    def failed(self) -> None:
        """A packet did not leave; it is not given up for want of a link."""
        self._count = max(0, self._count - 1)
        if math.isinf(self.due):
            self.due = 0.0

    def poll(self, now: float) -> Job | None:
        """The packet, if it is due."""
        if now < self.due or self._packet is None:
            return None
        self._count += 1
        burst = self._count < self._repeats
        self.due = now + (self._interval if burst else _SLOW)
        if (self._count - self._repeats) * _SLOW > self._patience:
            self.due = math.inf
        return Job(Lane.EMERGENCY, self._born, (self._packet,), repeated=self._count > 1)
