"""The contract of lsy_drone_racing in a trial: a new controller for every episode, everything near
seen at once."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from scipy.spatial.transform import Rotation

from crazyarena.levels.draw import Draw
from crazyarena.levels.lsy.arena import ArenaDraws, poles_of, quaternions_of
from crazyarena.levels.lsy.schema import LsyLevel
from crazyarena.levels.schema import Level
from crazyarena.runner.contestant.contract_lsy.dialogue import EPISODE_HOOKS
from crazyarena.runner.judging.lsy_referee import LsyTrialReferee
from crazyarena.runner.judging.lsy_rules import lsy_why
from crazyarena.runner.judging.referee import Event
from crazyarena.runner.records.lsy_scene import lsy_scene
from crazyarena.runner.trial.contract import Array, Draws, Follow
from crazyarena.runner.trial.phase import MeasuredTrack
from crazyarena.sim_backend.trace import TR_TIME

COMMAND_LAYOUT = {
    "state": "asked_args, sent_args: a full state",
    "attitude": "asked_args, sent_args: roll, pitch, yaw (rad) in 6 to 8, thrust (0 to 65535) in "
    "10",
}
"""What commands look like in recordings, by control mode."""


class ContractLsy:
    """See the module's text. level: of lsy_drone_racing; arena: what its arena is put together
    from, with the vehicle that flies."""

    renews: ClassVar[bool] = True
    after: ClassVar[tuple[str, ...]] = EPISODE_HOOKS
    between: ClassVar[tuple[str, ...]] = ()

    def __init__(self, level: LsyLevel, arena: Level) -> None:
        self.lsy = level
        self.level = arena

    def draws(self, seed: int) -> Draws:
        vehicle = self.level.vehicle
        return ArenaDraws(self.lsy, vehicle.mass, (vehicle.ixx, vehicle.iyy, vehicle.izz), seed)

    def referee(self) -> LsyTrialReferee:
        return LsyTrialReferee(self.lsy, self.level)

    def begin(
        self, referee: LsyTrialReferee, draw: Draw, track: MeasuredTrack, follow: Follow,
        start: Array,
    ) -> None:  # fmt: skip
        referee.begin(track.gates, track.obstacles, follow)
        referee.told_before(*self._nominal(draw, track))
        referee.warm_up(start)

    def _nominal(self, draw: Draw, track: MeasuredTrack) -> tuple[Array, Array]:
        """What the contestant is told of the track before it has seen it.

        The level's own poses; where a whole layout is drawn or built, what stands there less
        offsets drawn as in simulation.
        """
        level = self.lsy.env.track
        if not level.randomize:
            gates = np.array([[*gate.pos, *gate.rpy, 0.0] for gate in level.gates])
            tops = np.array([pole.pos for pole in level.obstacles], float).reshape(-1, 3)
            return gates, poles_of(tops)
        gates = track.gates.copy()
        gates[:, :6] -= draw.gates[:, :6] - draw.nominal_gates[:, :6]
        return gates, track.obstacles

    def first(self, referee: LsyTrialReferee, start: Array) -> dict[str, Any]:
        state = np.concatenate(
            [
                start[0:6:2],
                start[1:6:2],
                Rotation.from_euler("xyz", start[6:9]).as_quat(),
                start[9:12],
            ]
        )
        return referee.first(state)

    def metadata(self, draw: Draw, track: MeasuredTrack, start: Array) -> dict[str, str]:
        return {
            "level": self.lsy.name,
            "level_file": json.dumps(self.lsy.config),
            "rng": str(self.lsy.rng.value),
            "contract": "lsy_drone_racing",
            "command_layout": COMMAND_LAYOUT[self.lsy.env.control_mode],
        }

    def scene(self, track: MeasuredTrack) -> dict[str, Any]:
        return lsy_scene(quaternions_of(track.gates), track.obstacles[:, :3])

    def why(
        self,
        referee: LsyTrialReferee,
        reason: str,
        events: Sequence[Event],
        rows: Array,
        highest: float,
        first_command: str | None,
        error: str | None,
    ) -> str:
        # What ends a trial by itself has no event: then its last rows tell when.
        ended = (
            float(rows[-1, TR_TIME]) if len(rows) else max((e.time for e in events), default=0.0)
        )
        return lsy_why(reason, events, error, referee.gates_passed, referee.gates, ended)
