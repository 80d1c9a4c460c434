"""The rules of lsy_drone_racing for several drones on one track: a referee for each of them.

Each is judged by itself, by the rules of a single one; that others have touched it is in its
trace. A drone that is out, for whatever reason, is taken away: its observation stays as it was, at
(-1, -1, -1). The race is over when all are out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyarena.levels.lsy.draw import LsyDraw
from crazyarena.levels.lsy.schema import MAX_STEPS, LsyLevel
from crazyarena.runner.judging.lsy_rules import GONE, LsyReferee, LsyVerdict

Array = NDArray[np.float64]


@dataclass(slots=True)
class RaceVerdict:
    """What a step comes to.

    obs: of all drones, each key with a leading axis for them, which is what everybody sees.
    each: of those judged in this step, by drone. terminated: all drones are out.
    """

    obs: dict[str, Any]
    each: dict[int, LsyVerdict]
    terminated: bool
    truncated: bool


class RaceReferee:
    """Judges one race after the other of a level.

    Attributes
    ----------
    drones: the :class:`LsyReferee` of each drone. racing: whether it is still in the race.
    """

    def __init__(self, level: LsyLevel) -> None:
        self.drones = [LsyReferee(level) for _ in range(level.drones)]
        self.racing = [True] * level.drones
        self._steps = 0
        self._obs: list[dict[str, Any]] = []

    def begin(self, draws: Sequence[LsyDraw], states: Sequence[Array]) -> dict[str, Any]:
        """Start a race at ``states``, (13,) each; returns the first observation."""
        self.racing = [True] * len(self.drones)
        self._steps = 0
        self._obs = [
            referee.begin(draw, state)
            for referee, draw, state in zip(self.drones, draws, states, strict=True)
        ]
        return self.obs

    @property
    def obs(self) -> dict[str, Any]:
        """What everybody sees: arrays (drones, ...) by key."""
        return {name: np.stack([obs[name] for obs in self._obs]) for name in self._obs[0]}

    def withdraw(self, drone: int) -> None:
        """Take a drone out that has nobody left to fly it."""
        self.racing[drone] = False
        self._obs[drone] = {**self._obs[drone], "pos": GONE.astype(np.float32)}

    def judge(self, rows: Sequence[Array | None]) -> RaceVerdict:
        """Judge the ticks (k, TRACE_SIZE) of a step, a drone each; None for those that are out."""
        each: dict[int, LsyVerdict] = {}
        for drone, ticks in enumerate(rows):
            if ticks is None or not self.racing[drone]:
                continue
            verdict = each[drone] = self.drones[drone].judge(ticks)
            self._obs[drone] = verdict.obs
            self.racing[drone] = not verdict.terminated
        self._steps += 1
        return RaceVerdict(self.obs, each, not any(self.racing), self._steps >= MAX_STEPS)
