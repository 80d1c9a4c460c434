"""Replay a pose log through the same interface a camera system has."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from crazyarena.clock import Clock, VirtualClock
from crazyarena.errors import InputError
from crazyarena.mocap.poselog import read_pose_log
from crazyarena.mocap.source import SourceState, SourceStatus
from crazyarena.types import PoseFrame

# Upper bound of one wait, so that close() in another thread is noticed at once.
_NAP = 0.05
# Frames per call: a whole log at infinite speed would not fit in memory.
_BATCH = 1024


class ReplaySource:
    """Frames of a log, each at the time it was received then, times ``speed``.

    Parameters
    ----------
    path: ``.mcap`` or ``.csv`` pose log.
    clock: the session clock; the first frame is due when the source is opened.
    speed: 1 for real time, 2 for twice as fast, ``inf`` to deliver everything at once.
    rebase: shift time stamps to the session clock (needed by everything that asks for "now");
        without it frames keep the stamps of the recording, bit for bit. With a speed other
        than 1 the intervals between stamps stay those of the recording, so estimates do too;
        rebasing then only makes sense on a virtual clock or at ``speed=1``.

    A log that is damaged further on ends there, with the reason in ``status.error``.

    Raises
    ------
    InputError: unreadable file, or a speed that is not positive.
    """

    def __init__(
        self, clock: Clock, path: str | Path, speed: float = 1.0, rebase: bool = False
    ) -> None:
        if not speed > 0:
            raise InputError(f"replay speed: found {speed}; need a number above 0 or inf")
        self._clock = clock
        self._speed = speed
        self._log: Iterator[PoseFrame] = iter(read_pose_log(path))
        self._error: str | None = None
        self._next = next(self._log, None)
        first = 0.0 if self._next is None else self._next.received
        self._first = first
        self._start = clock.now()
        self._shift = self._start - first if rebase else 0.0
        self._closed = threading.Event()
        self._delivered = 0

    def _due(self) -> float:
        assert self._next is not None
        if math.isinf(self._speed):
            return self._start
        return self._start + (self._next.received - self._first) / self._speed

    def _advance(self) -> None:
        try:
            self._next = next(self._log, None)
        except InputError as error:
            # A crash cuts files short; what stands before the cut is still worth having.
            self._next = None
            self._error = str(error)

    def frames(self, timeout: float = 0.0) -> list[PoseFrame]:
        give_up = self._clock.now() + timeout
        taken: list[PoseFrame] = []
        while self._next is not None and len(taken) < _BATCH and not self._closed.is_set():
            now = self._clock.now()
            due = self._due()
            if due <= now:
                frame = self._next
                if self._shift:
                    frame = replace(
                        frame,
                        timestamp=frame.timestamp + self._shift,
                        received=frame.received + self._shift,
                    )
                taken.append(frame)
                self._advance()
            elif taken or now >= give_up or isinstance(self._clock, VirtualClock):
                break
            else:
                self._clock.sleep_until(min(due, give_up, now + _NAP))
        self._delivered += len(taken)
        return taken

    @property
    def status(self) -> SourceStatus:
        if self._closed.is_set():
            state = SourceState.CLOSED
        else:
            state = SourceState.ENDED if self._next is None else SourceState.LIVE
        return SourceStatus(state, frames=self._delivered, error=self._error)

    def close(self) -> None:
        self._closed.set()
