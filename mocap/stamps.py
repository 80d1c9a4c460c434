"""Time stamps that cross process and machine borders.

Sessions count from their own zero (:mod:`crazyarena.clock`), so a stamp on the wire is the
host's monotonic time together with the identity of the host that counted it. A reader on the
same host converts exactly; on another host the offset between the two clocks is estimated
from the fastest recent message, as one-way delay filters do (Cristian 1989; the minimum
filter of NTP, RFC 5905 section 10).
"""

from __future__ import annotations

import hashlib
import time
import uuid
from collections import deque
from functools import cache
from pathlib import Path

from crazyarena.clock import Clock


def host_time() -> float:
    """Return the monotonic time of this host, s; shared by all its processes."""
    return time.monotonic()


@cache
def host_id() -> int:
    """Return 64 bits that name this boot of this host."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_bytes()
    except OSError:
        boot = uuid.getnode().to_bytes(8, "little")
    return int.from_bytes(hashlib.sha256(boot).digest()[:8], "little")


def new_run() -> int:
    """Return 64 random bits that name one run of a publisher."""
    return uuid.uuid4().int & 0xFFFFFFFFFFFFFFFF


class HostStamps:
    """Session time to host time, for publishers."""

    def __init__(self, clock: Clock) -> None:
        # The fastest of a few readings: a preemption between the two clocks would
        # otherwise shift every stamp of the session.
        readings = [(host_time(), clock.now(), host_time()) for _ in range(5)]
        before, session, after = min(readings, key=lambda r: r[2] - r[0])
        self.offset = 0.5 * (before + after) - session

    def to_host(self, session_time: float) -> float:
        return session_time + self.offset

    def to_session(self, stamp: float) -> float:
        return stamp - self.offset


class StampReader:
    """Convert stamps of other processes or machines to session time.

    Parameters
    ----------
    clock: the session clock.
    window: messages over which the fastest one-way trip is sought (other hosts only).
    assumed_transit: the trip time of that fastest message, s; what no one-way measurement
        can tell.
    """

    def __init__(self, clock: Clock, window: int = 1024, assumed_transit: float = 2e-4) -> None:
        self._local = HostStamps(clock)
        self._assumed_transit = assumed_transit
        self._window = window
        self._host: int | None = None
        self._count = 0
        # Monotone queue of (message number, offset): the head is the window's minimum.
        self._offsets: deque[tuple[int, float]] = deque()

    def capture_time(self, host: int, captured: float, sent: float, received: float) -> float:
        """Return the session time of ``captured`` (s), never later than ``received``.

        ``captured`` and ``sent`` are stamps of ``host``; ``received`` is session time.
        """
        if host == host_id():
            return min(self._local.to_session(captured), received)
        if host != self._host:
            self._host = host
            self._offsets.clear()
        self._count += 1
        offset = received - sent
        while self._offsets and self._offsets[-1][1] >= offset:
            self._offsets.pop()
        self._offsets.append((self._count, offset))
        while self._offsets[0][0] <= self._count - self._window:
            self._offsets.popleft()
        return min(captured + self._offsets[0][1] - self._assumed_transit, received)
