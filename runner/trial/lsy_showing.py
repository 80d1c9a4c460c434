"""A run of lsy_drone_racing's simulation as viewers see it while it flies."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyarena.clock import Clock, WallClock
from crazyarena.levels.lsy.draw import LsyDraw
from crazyarena.levels.lsy.schema import LsyLevel
from crazyarena.live import POSITION, QUATERNION, SETPOINT, VELOCITY, Live
from crazyarena.plain_text import shown, shown_line
from crazyarena.runner.contestant.contract_lsy.dialogue import Drawing
from crazyarena.runner.judging.lsy_rules import LsyVerdict
from crazyarena.runner.records.lsy_scene import drawn_scene, lsy_scene
from crazyarena.runner.records.shown_scene import NOMINAL
from crazyarena.runner.trial.pace import Pace
from crazyarena.runner.trial.phase import Phase
from crazyarena.sim_backend.trace import TR_POS, TR_QUAT, TR_SETPOINT, TR_VEL

Array = NDArray[np.float64]

_PERIOD = 1.0 / 30.0  # s, between pictures
_MOST_EVENTS = 12


class LsyShowing:
    """Publishes one run; nobody waits for a viewer.

    Parameters
    ----------
    live: where to. episodes: how many there will be.
    pace: times real time that simulated time may pass with; 0 for as fast as it goes.
    """

    def __init__(
        self,
        live: Live,
        level: LsyLevel,
        episodes: int,
        pace: float = 1.0,
        wall: Clock | None = None,
    ) -> None:
        self._live = live
        self._wall = wall if wall is not None else WallClock()
        self._pace = Pace(pace, self._wall)
        limits = level.env.track.safety_limits
        low, high = limits.pos_limit_low, limits.pos_limit_high
        arena = {"low": list(low), "high": list(high)}
        self._scene: dict[str, Any] = {"title": level.name, "arena": arena, "vehicles": []}
        self._published = -math.inf
        self._events: deque[list[Any]] = deque(maxlen=_MOST_EVENTS)
        self._facts: dict[str, Any] = {"level": level.name, "episodes": episodes, "control": False}
        live.scene(self._scene)

    def begin(self, index: int, draw: LsyDraw) -> None:
        """An episode begins in this world."""
        self._set_up(index, draw)
        self._place(draw.start[:3], draw.start[6:10], draw.start[3:6], np.full(3, np.nan))
        self._publish()

    def _set_up(self, index: int, draw: LsyDraw) -> None:
        """Show the track of an episode."""
        told = lsy_scene(draw.nominal_gates, draw.nominal_obstacles)["entities"]
        for entity in told:
            for body in (*entity["cubes"], *entity["cylinders"]):
                body["color"] = NOMINAL
        track = lsy_scene(draw.gates, draw.obstacles)["entities"]
        self._scene |= {"track": track, "nominal": told, "drawn": []}
        self._live.scene(self._scene)
        self._live.begin()
        self._pace.begin()
        self._facts |= {"episode": index, "gates": len(draw.gates), "gate": 0, "why": ""}
        self._facts |= {"phase": Phase.RUN.value, "time": 0.0}

    def step(
        self, time: float, row: Array, verdict: LsyVerdict, drawings: Sequence[Drawing] | None
    ) -> None:
        """A control step was judged: ``row`` is the last of the trace."""
        self._facts["time"], self._facts["gate"] = time, int(verdict.obs["target_gate"])
        for event in verdict.events:
            self._note(event.time, event.name, event.detail)
        self._place_row(row)
        self._go_on(time, drawings)

    def _go_on(self, time: float, drawings: Sequence[Drawing] | None) -> None:
        """Vehicles are where they are at ``time`` s."""
        self._live.extend()
        if drawings:
            self._scene["drawn"] = drawn_scene(drawings, time)["entities"]
            self._live.scene(self._scene)
        self._pace.keep(time)
        if self._wall.now() - self._published >= _PERIOD:
            self._publish()

    def end(self, time: float, termination: str, why: str, success: bool) -> None:
        """The episode is over; ``why`` says more of its termination."""
        self._facts["why"] = shown(why)
        self._facts["phase"] = (Phase.COMPLETE if success else Phase.FAIL).value
        self._note(time, termination, "")
        self._publish()

    def close(self) -> None:
        """Nothing more will be shown of this run."""
        self._facts["phase"] = "over"
        self._publish()

    def _note(self, time: float, name: str, detail: str) -> None:
        self._events.append([time, shown_line(name), shown(detail)[:200]])

    def _place_row(self, row: Array, vehicle: int = 0) -> None:
        self._place(
            row[TR_POS : TR_POS + 3],
            row[TR_QUAT : TR_QUAT + 4],
            row[TR_VEL : TR_VEL + 3],
            row[TR_SETPOINT : TR_SETPOINT + 3],
            vehicle,
        )

    def _place(
        self, position: Array, turn: Array, velocity: Array, setpoint: Array, vehicle: int = 0
    ) -> None:
        row = self._live.rows[vehicle]
        row[POSITION : POSITION + 3] = position
        row[QUATERNION : QUATERNION + 4] = turn
        row[VELOCITY : VELOCITY + 3] = velocity
        row[SETPOINT : SETPOINT + 3] = setpoint

    def _publish(self) -> None:
        self._published = self._wall.now()
        speeds = np.linalg.norm(self._live.rows[:, VELOCITY : VELOCITY + 3], axis=1)
        self._facts["speed"] = round(float(np.nan_to_num(speeds).max()), 3)
        self._facts["events"] = list(self._events)
        self._live.publish(self._facts)
