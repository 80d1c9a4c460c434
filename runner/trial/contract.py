"""What a contract brings to a trial; the trial itself is the same program for all of them.

A contract says how worlds are drawn, who judges, what the contestant is told first, when its
controller is made and which of its methods are called between runs. :class:`Contract2022` is that
of the 2022 competition.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, ClassVar, Protocol

import numpy as np

from crazyarena.levels import dump_level
from crazyarena.levels.draw import Draw, LevelRandom
from crazyarena.levels.schema import Level
from crazyarena.runner.judging.referee import Event, Referee, Verdict, observation
from crazyarena.runner.judging.why import explain
from crazyarena.runner.records.scene import scene_update
from crazyarena.runner.trial.phase import MeasuredTrack

Array = np.ndarray
Follow = Callable[[float], Array] | None


class Draws(Protocol):
    """Worlds of consecutive episodes."""

    def reset(self) -> Draw: ...


class Judge(Protocol):
    """What the control loop asks of a referee."""

    def judge(self, rows: Array) -> Verdict: ...

    def reason(self, verdict: Verdict) -> str: ...

    @property
    def gates(self) -> int: ...

    @property
    def gates_passed(self) -> int: ...

    @property
    def ticks(self) -> int: ...


class Contract(Protocol):
    """See the module's text.

    Attributes
    ----------
    level: as what worlds and rigs are put together from.
    renews: every episode has a new controller, and begins with an observation of its own.
    after, between: hooks that are called after every run, and before the next.
    """

    level: Level
    renews: ClassVar[bool]
    after: ClassVar[tuple[str, ...]]
    between: ClassVar[tuple[str, ...]]

    def draws(self, seed: int) -> Draws: ...

    def referee(self) -> Any:
        """A :class:`Judge` for all episodes."""
        ...

    def begin(
        self, referee: Any, draw: Draw, track: MeasuredTrack, follow: Follow, start: Array
    ) -> None:
        """A new episode on this track."""
        ...

    def first(self, referee: Any, start: Array) -> Any:
        """What the contestant is told at its start, (12,)."""
        ...

    def metadata(self, draw: Draw, track: MeasuredTrack, start: Array) -> dict[str, str]:
        """For the recording: the level, and what was drawn."""
        ...

    def scene(self, track: MeasuredTrack) -> dict[str, Any]:
        """A ``foxglove.SceneUpdate`` of the true track."""
        ...

    def why(
        self,
        referee: Any,
        reason: str,
        events: Sequence[Event],
        rows: Array,
        highest: float,
        first_command: str | None,
        error: str | None,
    ) -> str:
        """Why an episode ended, in one line."""
        ...


class Contract2022:
    """That of the 2022 competition: one controller for all episodes, gates told of in order."""

    renews: ClassVar[bool] = False
    after: ClassVar[tuple[str, ...]] = ("interEpisodeLearn",)
    between: ClassVar[tuple[str, ...]] = ("interEpisodeReset",)

    def __init__(self, level: Level) -> None:
        self.level = level

    def draws(self, seed: int) -> LevelRandom:
        return LevelRandom(self.level, seed)

    def referee(self) -> Referee:
        return Referee(self.level)

    def begin(
        self, referee: Referee, draw: Draw, track: MeasuredTrack, follow: Follow, start: Array
    ) -> None:
        referee.begin(track.gates, track.obstacles, follow)
        referee.warm_up(start)

    def first(self, referee: Referee, start: Array) -> list[Any]:
        return observation(start)

    def metadata(self, draw: Draw, track: MeasuredTrack, start: Array) -> dict[str, str]:
        return {"level": self.level.name, "level_file": self._level_file}

    @cached_property
    def _level_file(self) -> str:
        # Once a trial: writing YAML takes as long as a few seconds of flight.
        return dump_level(self.level)

    def scene(self, track: MeasuredTrack) -> dict[str, Any]:
        return scene_update(track.gates, track.obstacles, self.level)

    def why(
        self,
        referee: Referee,
        reason: str,
        events: Sequence[Event],
        rows: Array,
        highest: float,
        first_command: str | None,
        error: str | None,
    ) -> str:
        return explain(
            reason,
            events,
            rows,
            referee.true_gates,
            referee.level,
            highest=highest,
            passed=referee.gates_passed,
            first_command=first_command,
            error=error,
        )


__all__ = ["Contract", "Contract2022", "Draws", "Judge"]
