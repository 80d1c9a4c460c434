"""A race of lsy_drone_racing's simulation as viewers see it while it flies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from crazyarena.clock import Clock
from crazyarena.levels.lsy.draw import LsyDraw
from crazyarena.levels.lsy.schema import LsyLevel
from crazyarena.live import Live
from crazyarena.runner.contestant.contract_lsy.dialogue import Drawing
from crazyarena.runner.judging.lsy_race_rules import RaceVerdict
from crazyarena.runner.trial.lsy_showing import LsyShowing

Array = NDArray[np.float64]

_NOWHERE = np.full(3, np.nan)
_LEVEL_TURN = np.array([0.0, 0.0, 0.0, 1.0])


class RaceShowing(LsyShowing):
    """Publishes the drones of one run, a row each; those that are out are not shown.

    Parameters as there; ``live`` has a row for each drone. The gate told is the leader's next one.
    """

    def __init__(
        self,
        live: Live,
        level: LsyLevel,
        episodes: int,
        pace: float = 1.0,
        wall: Clock | None = None,
    ) -> None:
        super().__init__(live, level, episodes, pace, wall)
        self._scene["vehicles"] = [f"drone {drone}" for drone in range(level.drones)]
        self._drawings: dict[int, Sequence[Drawing]] = {}
        live.scene(self._scene)

    def begin_race(self, index: int, draws: Sequence[LsyDraw]) -> None:
        """A race begins in this world."""
        self._drawings = {}
        self._set_up(index, draws[0])
        for drone, draw in enumerate(draws):
            start = draw.start
            self._place(start[:3], start[6:10], start[3:6], _NOWHERE, drone)
        self._publish()

    def step_race(
        self,
        time: float,
        rows: Sequence[Array | None],
        verdict: RaceVerdict,
        drawings: Mapping[int, Sequence[Drawing]],
    ) -> None:
        """A step was judged: ``rows`` are the ticks of each drone, or None where it is out."""
        passed = verdict.obs["n_gates_passed"]
        self._facts["time"] = time
        self._facts["gate"] = int(verdict.obs["target_gate"][int(np.argmax(passed))])
        for drone, said in verdict.each.items():
            for event in said.events:
                self._note(event.time, f"drone {drone}: {event.name}", event.detail)
        for drone, ticks in enumerate(rows):
            if ticks is None:
                self._place(_NOWHERE, _LEVEL_TURN, _NOWHERE, _NOWHERE, drone)
            else:
                self._place_row(ticks[-1], drone)
        self._drawings |= {drone: each for drone, each in drawings.items() if each}
        shown = [drawing for each in self._drawings.values() for drawing in each]
        self._go_on(time, shown if drawings else None)
