"""The pose source: the one interface behind which camera systems, logs and simulation differ."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any, Protocol, runtime_checkable

from crazyarena.types import PoseFrame


class SourceState(StrEnum):
    """Connection of a source, as far as the source itself can tell."""

    CONNECTING = "connecting"
    LIVE = "live"
    LOST = "lost"
    ENDED = "ended"
    CLOSED = "closed"


@dataclass(frozen=True, slots=True)
class SourceStatus:
    """Counters since the source was opened.

    lost: gaps in the frame ids; dropped: frames thrown away because nobody fetched them;
    malformed: payloads that could not be read; foreign: frames of another publisher than the one
    that is believed; error: the last trouble in words.
    """

    state: SourceState = SourceState.CONNECTING
    frames: int = 0
    lost: int = 0
    dropped: int = 0
    malformed: int = 0
    reconnects: int = 0
    error: str | None = None
    foreign: int = 0


@runtime_checkable
class PoseSource(Protocol):
    """Where pose frames come from. One thread may call ``frames``; any may call ``close``."""

    def frames(self, timeout: float = 0.0) -> list[PoseFrame]:
        """Return every frame that arrived since the last call, in order.

        Waits up to ``timeout`` s for the first one; an empty list means none came, or that
        the source was closed. Sources on virtual time never wait.
        """
        ...

    @property
    def status(self) -> SourceStatus:
        """Present connection state and counters."""
        ...

    def close(self) -> None:
        """Release everything within a second; idempotent; wakes a waiting ``frames``."""
        ...


class FrameQueue:
    """Hands frames from a receiving thread to the one that fetches, and counts what is lost.

    Parameters
    ----------
    capacity: frames kept when nobody fetches; beyond it the oldest are dropped and counted.
    """

    def __init__(self, capacity: int = 8192) -> None:
        self._frames: deque[PoseFrame] = deque()
        self._capacity = capacity
        self._ready = threading.Condition(threading.Lock())
        self._last_id = 0
        self._run: int | None = None
        self._status = SourceStatus()

    @property
    def status(self) -> SourceStatus:
        return self._status

    @property
    def finished(self) -> bool:
        """True when nothing will come any more."""
        return self._status.state in (SourceState.CLOSED, SourceState.ENDED)

    def put(self, frame: PoseFrame, run: int) -> None:
        """Add a frame of the sender's run ``run``; another run starts new ids."""
        with self._ready:
            status = self._status
            if status.state is SourceState.CLOSED:
                return
            lost = 0
            reconnects = status.reconnects
            if self._run == run:
                lost = max(0, frame.frame_id - self._last_id - 1)
            elif self._run is not None:
                reconnects += 1
            self._run = run
            self._last_id = frame.frame_id
            dropped = status.dropped
            if len(self._frames) >= self._capacity:
                self._frames.popleft()
                dropped += 1
            self._frames.append(frame)
            self._status = SourceStatus(
                SourceState.LIVE,
                status.frames + 1,
                status.lost + lost,
                dropped,
                status.malformed,
                reconnects,
                status.error,
                status.foreign,
            )
            self._ready.notify()

    def note(self, state: SourceState | None = None, **changes: Any) -> None:
        """Change the state or counters; a closed queue stays closed."""
        with self._ready:
            if self._status.state is SourceState.CLOSED:
                return
            if state is not None:
                changes["state"] = state
            self._status = replace(self._status, **changes)
            if state in (SourceState.CLOSED, SourceState.ENDED):
                self._ready.notify_all()

    def reject(self, reason: str) -> None:
        """Count one malformed payload."""
        with self._ready:
            self._status = replace(self._status, malformed=self._status.malformed + 1, error=reason)

    def turn_away(self, reason: str) -> None:
        """Count one frame of a publisher that is not believed."""
        with self._ready:
            self._status = replace(self._status, foreign=self._status.foreign + 1, error=reason)

    def take(self, timeout: float) -> list[PoseFrame]:
        with self._ready:
            if not self._frames and timeout > 0:
                self._ready.wait_for(
                    lambda: self._frames or self.finished,
                    timeout,
                )
            taken = list(self._frames)
            self._frames.clear()
        return taken

    def close(self) -> None:
        self.note(SourceState.CLOSED)
