"""The cameras of a campaign flight."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import replace

from crazyarena.clock import Clock
from crazyarena.mocap.sim_source import SimSource
from crazyarena.mocap.source import SourceState, SourceStatus
from crazyarena.types import PoseFrame


class FaultyCameras:
    """A pose source whose frames pass through whatever fault is set.

    ``spoil(frame, now)`` returns the frame as it is delivered, or None; ``delay`` s is added to
    the way of every frame.
    """

    def __init__(self, source: SimSource, clock: Clock) -> None:
        self._source = source
        self._clock = clock
        self.spoil: Callable[[PoseFrame], PoseFrame | None] | None = None
        self.delay = 0.0
        self._held: deque[tuple[float, PoseFrame]] = deque()

    def frames(self, timeout: float = 0.0) -> list[PoseFrame]:
        for frame in self._source.frames():
            spoiled = frame if self.spoil is None else self.spoil(frame)
            if spoiled is not None:
                due = frame.received + self.delay
                if self._held:
                    due = max(due, self._held[-1][0])
                self._held.append((due, replace(spoiled, received=due)))
        now = self._clock.now()
        ready = []
        while self._held and self._held[0][0] <= now:
            ready.append(self._held.popleft()[1])
        return ready

    @property
    def status(self) -> SourceStatus:
        return SourceStatus(SourceState.LIVE)

    def close(self) -> None:
        self._source.close()
