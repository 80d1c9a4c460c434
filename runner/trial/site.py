"""Where the things of a track are to stand, and what the cameras' poses of them come to.

One kind for each contract: its bodies have their own origins, and its levels their own tolerances.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from crazyarena.levels.lsy.schema import LsyLevel
from crazyarena.levels.schema import Level
from crazyarena.mocap.survey import Allowed
from crazyarena.runner.trial.phase import Array
from crazyarena.runner.trial.tracked_world import heading_like
from crazyarena.safety.lsy_placement import lsy_allowed, lsy_nominal, start_problem
from crazyarena.safety.placement import allowed
from crazyarena.sim_backend.arena_world import track_truth
from crazyarena.types import Pose


class Site(Protocol):
    """See the module's text.

    Attributes
    ----------
    nominal: poses of the track's bodies by name.
    allowed: how far each may be from that.
    full_turn: bodies have a front.
    moving: bodies that may be anywhere.
    """

    nominal: Mapping[str, Pose]
    allowed: Mapping[str, Allowed]
    full_turn: bool
    moving: Sequence[str]

    def track(self, poses: Mapping[str, Pose]) -> tuple[Array, Array]:
        """Gates (n, 7) and obstacles (m, 6) as the referee takes them."""
        ...

    def start_problem(self, position: Array) -> str | None:
        """What is wrong with where the vehicle stands, beyond the checklist's own line."""
        ...

    @property
    def landmarks(self) -> Mapping[str, Pose] | None:
        """Bodies whose nominal places tell the cameras' axes; None for the level's own."""
        ...


class LevelSite:
    """That of a level of ours: bodies stand on the floor, and have no front."""

    full_turn = False
    landmarks: Mapping[str, Pose] | None = None

    def __init__(self, level: Level) -> None:
        self._level = level
        self._gates = np.array([[*gate.row] for gate in level.track.gates]).reshape(-1, 7)
        self._obstacles = np.array([o.row for o in level.track.obstacles]).reshape(-1, 6)
        self.nominal: Mapping[str, Pose] = track_truth(self._gates, self._obstacles)
        self.allowed: Mapping[str, Allowed] = allowed(level)
        self.moving: Sequence[str] = [f"gate{i + 1}" for i in level.track.tracked]

    def track(self, poses: Mapping[str, Pose]) -> tuple[Array, Array]:
        gates, obstacles = self._gates.copy(), self._obstacles.copy()
        for i, row in enumerate(gates):
            _put(row, poses[f"gate{i + 1}"])
            # Bodies are at the foot; posts have one length, so the kind tells the height.
            row[2] = self._level.track.gates[i].centre[2]
        for i, row in enumerate(obstacles):
            _put(row, poses[f"obstacle{i + 1}"])
            row[2] = self._obstacles[i, 2]
        return gates, obstacles

    def start_problem(self, position: Array) -> str | None:
        return None


class LsySite:
    """That of a level of lsy_drone_racing: gates by the centre of their opening, with their full
    attitude; obstacles by their top."""

    full_turn = True
    moving: Sequence[str] = ()

    def __init__(self, level: LsyLevel) -> None:
        self._level = level
        self.nominal: Mapping[str, Pose] = lsy_nominal(level)
        self.allowed: Mapping[str, Allowed] = lsy_allowed(level)

    @property
    def landmarks(self) -> Mapping[str, Pose]:
        # Where a layout is drawn no place is known beforehand.
        return {} if self._level.env.track.randomize else self.nominal

    def track(self, poses: Mapping[str, Pose]) -> tuple[Array, Array]:
        track = self._level.env.track
        gates, obstacles = np.zeros((len(track.gates), 7)), np.zeros((len(track.obstacles), 6))
        for i, row in enumerate(gates):
            pose = poses[f"gate{i + 1}"]
            row[:3] = pose.position
            row[3:6] = Rotation.from_quat(pose.quaternion).as_euler("xyz")
        for i, row in enumerate(obstacles):
            row[:3] = poses[f"obstacle{i + 1}"].position
        return gates, obstacles

    def start_problem(self, position: Array) -> str | None:
        return start_problem(self._level, float(position[0]), float(position[1]))


def _put(row: Array, pose: Pose) -> None:
    """Overwrite a nominal row with a measured pose; what has no front keeps its heading."""
    row[:3] = pose.position
    row[3:6] = (0.0, 0.0, heading_like(row[5], pose.quaternion))
