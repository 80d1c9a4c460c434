"""What waits to go on the air to one vehicle, and what goes first.

A Crazyradio carries one packet at a time for all its vehicles. When there is more to send than
it carries, the traffic gives way in this order, from the last: log data (they ride on the
answers to packets that have nothing to say), parameters and memories, poses (the newest
replaces the one that waits), and never setpoints, commands and stops.
"""

from __future__ import annotations

import threading
from collections import deque
from enum import IntEnum
from typing import NamedTuple

from crazyarena.crazyswarm_compat.radio import packets as pk

NULL = b"\xff"
_EMERGENCY, _WATCHDOG = 3, 4
_POSES = (8, 9)
_LIFTED = (2, 0)  # before what flies, which is (2, 1)
_ROOM = 64  # packets that wait without being replaced


class Share(IntEnum):
    """Classes of traffic on one dongle, the most urgent first."""

    STOP = 0
    WATCHDOG = 1
    FLIGHT = 2
    POSE = 3
    REST = 4
    POLL = 5


def share_of(packet: bytes) -> Share:
    """Class of a packet, by its port and first byte."""
    port, channel = packet[0] >> 4, packet[0] & 3
    kind = packet[1] if len(packet) > 1 else -1
    if port in (pk.PORT_SUPERVISOR, pk.PORT_LOCALIZATION) and channel == 1:
        if kind == _EMERGENCY:
            return Share.STOP
        if kind == _WATCHDOG:
            return Share.WATCHDOG
    if port == pk.PORT_LOCALIZATION and (channel != 1 or kind in _POSES):
        return Share.POSE
    if port in (pk.PORT_RPYT, pk.PORT_SETPOINT, pk.PORT_HIGH_LEVEL, pk.PORT_SUPERVISOR):
        return Share.FLIGHT
    return Share.REST


def is_request(packet: bytes) -> bool:
    """Whether the vehicle will answer."""
    streams = (pk.PORT_RPYT, pk.PORT_SETPOINT, pk.PORT_LOCALIZATION)
    return packet != NULL and packet[0] >> 4 not in streams


def _kind(packet: bytes) -> bytes:
    """What the next packet must have in common with this one to make it needless."""
    # The first byte of a position alone is a number's.
    return packet[:1] if packet[0] & 3 == 0 else packet[:2]


def _replaces(packet: bytes, last: bytes) -> bool:
    """Whether a setpoint makes the one before it needless."""
    if packet[0] >> 4 == pk.PORT_RPYT:
        # A setpoint without thrust unlocks the motors; it must arrive.
        return packet[0] == last[0] and any(last[1:])
    setpoint = packet[0] >> 4 == pk.PORT_SETPOINT and packet[0] & 3 == 0
    return setpoint and packet[:2] == last[:2]


class Waiting(NamedTuple):
    """A packet and when it was handed in, s."""

    packet: bytes
    since: float


class AirQueue:
    """Packets of one vehicle by class. Safe to share between threads.

    Setpoints and commands stay in order, as the vehicle would otherwise follow a setpoint that a
    command has ended; of setpoints in a row only the newest waits.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._lanes: dict[Share, deque[Waiting]] = {
            share: deque() for share in Share if share is not Share.POLL
        }
        self.replaced = dict.fromkeys(Share, 0)

    def put(self, packet: bytes, now: float) -> bool:
        """Hand in a packet; False if there is no room."""
        share = share_of(packet)
        with self._lock:
            lane = self._lanes[share]
            # What replaces another takes its place in the line, too.
            since = now
            if share is Share.STOP:
                lane.clear()  # one is as good as many
            elif share in (Share.WATCHDOG, Share.POSE):
                for old in [old for old in lane if _kind(old.packet) == _kind(packet)]:
                    lane.remove(old)
                    since = old.since
                    self.replaced[share] += 1
            elif share is Share.FLIGHT and lane and _replaces(packet, lane[-1].packet):
                since = lane.pop().since
                self.replaced[share] += 1
            if len(lane) >= _ROOM:
                return False
            lane.append(Waiting(packet, since))
            return True

    def first(self, lifted: Share | None = None) -> tuple[Share, float] | None:
        """Class and age mark of what goes next, None if nothing waits; what is ``lifted`` goes
        before setpoints."""
        with self._lock:
            for share in self._order(lifted):
                if self._lanes[share]:
                    return share, self._lanes[share][0].since
        return None

    def take(self, lifted: Share | None = None) -> Waiting | None:
        """The next packet."""
        with self._lock:
            for share in self._order(lifted):
                if self._lanes[share]:
                    return self._lanes[share].popleft()
        return None

    def _order(self, lifted: Share | None) -> list[Share]:
        return sorted(self._lanes, key=lambda share: (share, 1) if share != lifted else _LIFTED)

    def waits(self, share: Share) -> bool:
        """Whether anything of a class waits."""
        lane = self._lanes.get(share)
        return bool(lane)

    def clear(self) -> None:
        """Forget everything."""
        with self._lock:
            for lane in self._lanes.values():
                lane.clear()
