"""The rules of lsy_drone_racing for a trial: those of its real race, on what cameras see.

Gates and what is seen are judged as in its simulation (:mod:`.lsy_rules`), between two steps of
the environment. A run ends at the last gate, outside of the level's safety limits, at a contact of
the drone's box with the measured track, on its back, or after 1500 steps.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyarena.levels.lsy.arena import quaternions_of
from crazyarena.levels.lsy.draw import LsyDraw
from crazyarena.levels.lsy.schema import LsyLevel
from crazyarena.levels.schema import Level
from crazyarena.runner.judging import verdict_row as vd
from crazyarena.runner.judging.lsy_rules import COLLISION, GATES_PASSED, LsyReferee
from crazyarena.runner.judging.referee import Event, Verdict
from crazyarena.sim_backend.physics.successor_scene import (
    SOLID_SIZE,
    build_solids,
    place_drone,
    touched,
)
from crazyarena.sim_backend.trace import TR_CONTACT, TR_POS, TR_QUAT, TR_TIME

Array = NDArray[np.float64]


class LsyTrialReferee:
    """What a trial asks of a :class:`~crazyarena.runner.judging.referee.Referee`.

    level: of lsy_drone_racing; arena: the same as what the arena is put together from.
    """

    def __init__(self, level: LsyLevel, arena: Level) -> None:
        self._rules = LsyReferee(level, real=True)
        self.level = arena
        self._rate = level.env.freq
        self._box = np.zeros(SOLID_SIZE)
        self._row = np.zeros(vd.SIZE)
        self._verdict: Verdict | None = None

    def begin(
        self, gates: Array, obstacles: Array, follow: Callable[[float], Array] | None = None
    ) -> None:
        """Begin an episode on a track, nothing of which moves; rows as in
        :mod:`crazyarena.levels.lsy.arena`. What is nominal is :meth:`told_before`'s."""
        self.true_gates = np.array(gates, dtype=np.float64)
        self._obstacles = np.array(obstacles, dtype=np.float64)
        self._nominal = self.true_gates, self._obstacles
        self._solids = build_solids(quaternions_of(self.true_gates), self._obstacles[:, :3])
        self._verdict = None
        self.ticks = 0

    def told_before(self, gates: Array, obstacles: Array) -> None:
        """Where gates and obstacles are said to be before they are seen."""
        self._nominal = gates, obstacles

    def first(self, state: Array) -> dict[str, Any]:
        """Observation at a start (13,): position, velocity, quaternion, body rates."""
        true, nominal = self.true_gates, self._nominal
        draw = LsyDraw(
            state,
            0.0,
            np.zeros((3, 3)),
            quaternions_of(true),
            self._obstacles[:, :3],
            quaternions_of(nominal[0]),
            nominal[1][:, :3],
            None,  # type: ignore[arg-type]
        )
        return self._rules.begin(draw, state)

    def warm_up(self, state: Array) -> None:
        """Compile what judging needs; state: (12,)."""
        place_drone(self._box, 0.0, 0.0, -9.0, 0.0, 0.0, 0.0, 1.0)
        touched(self._solids, self._box)

    def judge(self, rows: Array) -> Verdict:
        """Judge the rows (k, TRACE_SIZE) of a step; with none the last verdict stands."""
        if len(rows) == 0:
            if self._verdict is None:
                raise ValueError("the first control step of an episode needs at least one pose")
            self._verdict.events = ()
            return self._verdict
        for row in rows:
            row[TR_CONTACT] = self._contact(row)
        self.ticks += len(rows)
        said = self._rules.judge(rows)
        verdict = self._verdict = Verdict()
        last = rows[-1]
        gate = int(said.obs["target_gate"])
        verdict._last = last
        verdict.obs = said.obs  # type: ignore[assignment]
        verdict.reward = said.reward
        verdict.done = said.terminated or said.truncated
        verdict.collided = said.reason == COLLISION
        verdict.violated = False
        verdict.completed = self._rules.passed == self._rules.gates
        verdict.tumbled = False
        verdict.gate = gate
        verdict.info = {
            "obs": said.obs,
            "reason": said.reason,
            "terminated": said.terminated,
            "truncated": said.truncated,
            **self._of_gate(gate, said.obs),
        }
        verdict.row = self._written(last, verdict)
        verdict.events = [Event(e.name, self.ticks, e.time, e.detail) for e in said.events]
        return verdict

    def _contact(self, row: Array) -> float:
        px, py, pz = row[TR_POS : TR_POS + 3]
        qx, qy, qz, qw = row[TR_QUAT : TR_QUAT + 4]
        place_drone(self._box, px, py, pz, qx, qy, qz, qw)
        return float(touched(self._solids, self._box))

    def _of_gate(self, gate: int, obs: dict[str, Any]) -> dict[str, Any]:
        """What is told of the next gate, as injections take it."""
        if gate < 0:
            return {"current_target_gate_in_range": False, "current_target_gate_pos": []}
        seen = bool(obs["gates_visited"][gate])
        rows = self.true_gates if seen else self._nominal[0]
        return {
            "current_target_gate_in_range": seen,
            "current_target_gate_pos": rows[gate, :6].tolist(),
        }

    def _written(self, last: Array, verdict: Verdict) -> Array:
        row = self._row
        row[:] = np.nan
        row[vd.VD_TIME], row[vd.VD_TICKS] = last[TR_TIME], self.ticks
        row[vd.VD_GATE] = verdict.gate
        row[vd.VD_COMPLETED] = verdict.info["reason"] == GATES_PASSED
        row[vd.VD_CONTACT] = last[TR_CONTACT]
        row[vd.VD_REWARD] = verdict.reward
        row[vd.VD_DONE], row[vd.VD_TRUNCATED] = verdict.done, verdict.info["truncated"]
        row[vd.VD_IN_RANGE] = verdict.info["current_target_gate_in_range"]
        return row

    def reason(self, verdict: Verdict) -> str:
        """Why an episode that is done has ended."""
        return str(verdict.info["reason"])

    @property
    def gates(self) -> int:
        """How many passes make a run."""
        return self._rules.gates

    @property
    def gates_passed(self) -> int:
        return self._rules.passed
