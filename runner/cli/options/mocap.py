"""What the motion-capture subcommands share."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from crazyarena.levels import Level
    from crazyarena.types import Pose

SOURCE_HELP = (
    "Where poses come from: vicon, qualisys, optitrack, vrpn, nokov, fzmotion, zenoh or replay."
)
HOST_HELP = "Host of the camera software, or zenoh endpoint such as tcp/10.0.0.5:7447."
OPTION_HELP = "Further option of the source, KEY=VALUE, under its own name (repeatable)."


def nominal_track(level: Level) -> Mapping[str, Pose]:
    """Poses of the level's track bodies: ``gate1``, ``gate2``, ..., ``obstacle1``, ...

    The origin of each body is the foot of the gate or pillar, its heading the level's yaw.
    """
    import math

    import numpy as np

    from crazyarena.types import Pose

    poses = {}
    rows = {
        "gate": [gate.row for gate in level.track.gates],
        "obstacle": [obstacle.row for obstacle in level.track.obstacles],
    }
    for kind, things in rows.items():
        for number, row in enumerate(things, 1):
            x, y, z, _, _, yaw = row[:6]
            half = 0.5 * yaw
            poses[f"{kind}{number}"] = Pose(
                np.array([x, y, z]),
                np.array([0.0, 0.0, math.sin(half), math.cos(half)]),
            )
    return poses
