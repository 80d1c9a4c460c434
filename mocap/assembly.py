"""One frame for one instant, from sources that deliver each body by itself (VRPN, single topics).

Everything behind a source judges frames: a body that is not in one was not seen. So what a source
sends in pieces is put together first, and nobody waits longer for the last piece than stated.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from crazyarena.clock import Clock
from crazyarena.errors import InputError
from crazyarena.mocap.source import FrameQueue
from crazyarena.types import Pose, PoseFrame

# Longest wait for the bodies of an instant, s: well below half a period at 100 Hz, and longer
# than a burst of poses takes from one host to the next.
DEFAULT_WAIT = 0.004
# Stamps of one instant agree this well after conversion between clocks, s.
SAME = 1e-4
# A body is awaited from this share of its usual interval on, and no longer than this many of
# them: one that is hidden must not hold up the others for ever.
_EARLY, _LATE = 0.7, 2.5
_SMOOTHING = 0.1
# A body whose interval is not known yet is awaited for so long, s.
_FIRST = 0.25


class Assembler:
    """Put together what belongs to one instant.

    A frame is complete when all bodies are in it that are due by their own usual interval; else
    it goes when a body comes again, when another instant begins, or ``wait`` s after its first
    piece arrived. A complete frame has waited for nobody.

    Parameters
    ----------
    wait: s; shortened to 0.4 of the shortest interval of a body, so that quick cameras are not
        held up longer than one frame.
    same: pieces carry capture times, which differ by no more than this within an instant, s;
        bodies that are not in step stay frames of their own. None if they carry none: arrival
        within ``wait`` makes an instant.
    learn: pass everything on untouched until two successive pieces have one stamp and different
        bodies. Only with ``same``.

    Raises
    ------
    InputError: ``wait`` is not between 0 and 0.1 s.
    """

    def __init__(
        self, wait: float = DEFAULT_WAIT, same: float | None = None, learn: bool = False
    ) -> None:
        if not 0.0 < wait <= 0.1:
            raise InputError(f"mocap assemble: found {wait}; need a wait above 0 and up to 0.1 s")
        self._wait = wait
        self._same = same
        self._singly = not learn
        self._latest: PoseFrame | None = None
        self._bodies: dict[str, Pose] = {}
        self._markers: list[np.ndarray] = []
        self._head: PoseFrame | None = None
        self._last: dict[str, float] = {}
        self._interval: dict[str, float] = {}
        self._source_id: int | None = None
        self._next_id = 0

    @property
    def singly(self) -> bool:
        """True when the source is known to deliver in pieces."""
        return self._singly

    @property
    def due(self) -> float:
        """Session time at which what waits must go, s; inf when nothing waits."""
        if self._head is None:
            return math.inf
        shortest = min((self._interval.get(name, math.inf) for name in self._last), default=0.0)
        return self._head.received + min(self._wait, 0.4 * shortest)

    def add(self, piece: PoseFrame) -> list[PoseFrame]:
        """Take one piece; return the frames that are complete by it."""
        if not self._singly:
            self._learn(piece)
            if not self._singly:
                return [piece]
        # An id missed is a loss, whatever bodies it would have brought.
        step = 1 if self._source_id is None else piece.frame_id - self._source_id
        self._source_id = piece.frame_id
        lost = max(0, step - 1)
        if not piece.bodies and not len(piece.markers):
            self._next_id += lost
            return []
        done = []
        if self._head is not None and not self._belongs(piece):
            done.append(self._finish(self._head.received))
        self._next_id += lost
        if self._head is None:
            self._head = piece
        self._bodies.update(piece.bodies)
        if len(piece.markers):
            self._markers.append(piece.markers)
        for name in piece.bodies:
            self._pace(name, piece.timestamp)
        if self._complete():
            done.append(self._finish(piece.received))
        return done

    def flush(self, now: float) -> list[PoseFrame]:
        """Return what has waited long enough at session time ``now``, s."""
        if now < self.due:
            return []
        return [self._finish(now)]

    def _learn(self, piece: PoseFrame) -> None:
        latest = self._latest
        self._latest = piece
        for name in piece.bodies:
            self._pace(name, piece.timestamp)
        if (
            latest is not None
            and latest.bodies
            and piece.bodies
            and abs(piece.timestamp - latest.timestamp) <= (self._same or 0.0)
            and not latest.bodies.keys() & piece.bodies.keys()
        ):
            self._singly = True
            self._latest = None
            self._source_id = piece.frame_id - 1
            # Ids go on from those already handed out.
            self._next_id = piece.frame_id

    def _belongs(self, piece: PoseFrame) -> bool:
        assert self._head is not None
        if self._bodies.keys() & piece.bodies.keys():
            return False
        if self._same is not None:
            return abs(piece.timestamp - self._head.timestamp) <= self._same
        return piece.received < self.due

    def _pace(self, name: str, time: float) -> None:
        last = self._last.get(name)
        self._last[name] = time
        if last is None or time <= last:
            return
        interval = self._interval.get(name)
        if interval is None:
            self._interval[name] = time - last
        elif time - last < 2.0 * interval:
            self._interval[name] += _SMOOTHING * (time - last - interval)
        else:
            # A gap, or a tracker that became slower for good: follow, but slowly.
            self._interval[name] = 1.1 * interval

    def _complete(self) -> bool:
        assert self._head is not None
        for name, last in self._last.items():
            if name in self._bodies:
                continue
            age = self._head.timestamp - last
            interval = self._interval.get(name)
            if interval is None:
                if age <= _FIRST:
                    return False
            elif _EARLY * interval <= age <= _LATE * interval:
                return False
        # Who else will come is not known before somebody has come twice.
        return all(name in self._interval for name in self._bodies)

    def _finish(self, received: float) -> PoseFrame:
        head = self._head
        assert head is not None
        markers = np.concatenate(self._markers) if self._markers else head.markers
        frame = replace(
            head,
            received=max(received, head.received),
            frame_id=self._next_id,
            bodies=self._bodies,
            markers=markers,
        )
        self._next_id += 1
        self._head = None
        self._bodies = {}
        self._markers = []
        return frame


def take_assembled(
    queue: FrameQueue, assembler: Assembler | None, clock: Clock, timeout: float
) -> list[PoseFrame]:
    """Frames of ``queue`` through ``assembler``, waiting up to ``timeout`` s for the first."""
    if assembler is None:
        return queue.take(timeout)
    end = clock.now() + timeout
    done: list[PoseFrame] = []
    while True:
        wait = max(0.0, min(end, assembler.due) - clock.now()) if not done else 0.0
        pieces = queue.take(wait)
        for piece in pieces:
            # What is due by the time the next piece came goes without it.
            done += assembler.flush(piece.received)
            done += assembler.add(piece)
        now = clock.now()
        done += assembler.flush(now)
        if done or now >= end or (not pieces and queue.finished):
            return done
