"""A track of lsy_drone_racing for the arena's simulation: solids, and bodies for the cameras."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from crazyarena.levels.draw import Draw
from crazyarena.levels.lsy.arena import quaternions_of
from crazyarena.sim_backend.arena_world import track_truth
from crazyarena.sim_backend.physics.scene import (
    BOX,
    CYLINDER,
    GROUP,
    MARGIN,
    ROW_SIZE,
    S_CENTRE,
    S_CODE,
    S_COUNT,
    S_HALF,
    S_KIND,
    S_RADIUS,
    S_ROTATION,
)
from crazyarena.sim_backend.physics.successor_scene import (
    SO_CENTRE,
    SO_CODE,
    SO_HALF,
    SO_RADIUS,
    SO_REACH,
    SO_ROTATION,
    build_solids,
)
from crazyarena.types import Pose

Array = NDArray[np.float64]


class LsyTrack:
    """The :class:`~crazyarena.sim_backend.arena_world.Track` of a draw in the rows of
    :mod:`crazyarena.levels.lsy.arena`.

    Bodies are called as anywhere; the origin of a gate is the centre of its opening, that of an
    obstacle its top, and both have their full attitude.
    """

    moves = False

    def __init__(self, draw: Draw) -> None:
        self._bodies = track_truth(draw.gates, draw.obstacles)
        self._scene = lsy_scene_rows(draw.gates, draw.obstacles)

    def scene(self, time: float) -> Array:
        """Rows for the collision geometry."""
        return self._scene

    def bodies(self, time: float) -> dict[str, Pose]:
        """True poses by the names of the bodies."""
        return self._bodies


def lsy_scene_rows(gates: Array, obstacles: Array) -> Array:
    """Gates (n, 7) and obstacles (m, 6) as rows of :mod:`.physics.scene`, a group an object."""
    solids = build_solids(quaternions_of(gates), obstacles[:, :3])
    rows = []
    for code in range(len(gates) + len(obstacles)):
        parts = [_primitive(solid) for solid in solids if solid[SO_CODE] == code]
        rows += [_header(code, parts), *parts]
    return np.array(rows, dtype=np.float64).reshape(-1, ROW_SIZE)


def _primitive(solid: Array) -> Array:
    row = np.zeros(ROW_SIZE)
    row[S_CODE] = solid[SO_CODE]
    row[S_CENTRE : S_CENTRE + 3] = solid[SO_CENTRE : SO_CENTRE + 3]
    row[S_ROTATION : S_ROTATION + 9] = solid[SO_ROTATION : SO_ROTATION + 9]
    half = solid[SO_HALF : SO_HALF + 3]
    if solid[SO_RADIUS] > 0.0:
        # The caps of a capsule are filled by the cylinder's flat ends.
        row[S_KIND] = CYLINDER
        radius, long = solid[SO_RADIUS], half[2] + solid[SO_RADIUS]
        row[S_HALF : S_HALF + 3] = radius, radius, long
        row[S_RADIUS] = math.hypot(radius, long) + MARGIN
    else:
        row[S_KIND] = BOX
        row[S_HALF : S_HALF + 3] = half - MARGIN
        row[S_RADIUS] = solid[SO_REACH]
    return row


def _header(code: int, parts: list[Array]) -> Array:
    row = np.zeros(ROW_SIZE)
    row[S_KIND], row[S_CODE], row[S_COUNT] = GROUP, code, len(parts)
    centres = np.array([part[S_CENTRE : S_CENTRE + 3] for part in parts])
    middle = centres.mean(axis=0)
    row[S_CENTRE : S_CENTRE + 3] = middle
    row[S_ROTATION : S_ROTATION + 9] = parts[0][S_ROTATION : S_ROTATION + 9]
    reaches = np.linalg.norm(centres - middle, axis=1) + [part[S_RADIUS] for part in parts]
    row[S_RADIUS] = reaches.max()
    return row
