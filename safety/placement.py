"""Where the things of a track may stand: one rule, the level's, for survey, pre-flight and flight.

A level says by how much x, y and yaw of a gate or obstacle may differ from nominal, each by
itself. A track that was drawn or placed so is legal; measuring adds a little.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from crazyarena.levels import Level
from crazyarena.mocap.survey import Allowed
from crazyarena.safety.fence import Fence, gate_solids, pole_solids
from crazyarena.safety.shapes import Shape
from crazyarena.types import Pose

# What measuring adds to a level's ranges: m, rad.
MEASURING = (0.01, math.radians(2.0))
# What placing by hand may miss where a level states no range: m, rad.
BY_HAND = (0.05, 0.1)
# Feet stand on the floor, whatever the cameras' origin is off by, m.
_HEIGHT = 0.05
# Half the inner width of a gate, m, and the radius that a vehicle needs to pass.
_OPENING = 0.2
_VEHICLE = 0.08
# Way before and behind the opening that must be free as well, m.
_WAY = 0.3
# Depth of what counts as the opening itself, to either side of its plane, m.
_DEPTH = 0.1


def nominal_track(level: Level) -> dict[str, Pose]:
    """Poses of the level's track bodies: ``gate1``, ``gate2``, ..., ``obstacle1``, ...

    The origin of each body is the foot of the gate or pillar, its heading the level's yaw.
    """
    poses = {}
    rows = {
        "gate": [gate.row for gate in level.track.gates],
        "obstacle": [obstacle.row for obstacle in level.track.obstacles],
    }
    for kind, things in rows.items():
        for number, row in enumerate(things, 1):
            half = 0.5 * row[5]
            quaternion = np.array([0.0, 0.0, math.sin(half), math.cos(half)])
            poses[f"{kind}{number}"] = Pose(np.array(row[:3]), quaternion)
    return poses


def allowed(level: Level) -> dict[str, Allowed]:
    """How far each body of the track may be from nominal."""
    spread = level.randomization.gates_and_obstacles
    counts = {"gate": len(level.track.gates), "obstacle": len(level.track.obstacles)}
    result: dict[str, Allowed] = {}
    for kind, count in counts.items():
        if spread is None:
            low, high = 0.0, 0.0
            more, turn = BY_HAND
        else:
            low, high = spread.gates if kind == "gate" else spread.obstacles
            more, turn = MEASURING
        # A range need not hold zero, and then nominal itself is not legal.
        place = (low - more, high + more)
        rule = Allowed(place, place, (-_HEIGHT, _HEIGHT), (low - turn, high + turn))
        result |= {f"{kind}{i + 1}": rule for i in range(count)}
    return result


def obstructions(level: Level, poses: Mapping[str, Pose] | None = None) -> list[str]:
    """What keeps a vehicle from flying through a gate, in plain words.

    Parameters
    ----------
    poses: where gates and obstacles stand, by body name; nominal where left out.
    """
    where = {**nominal_track(level), **(poses or {})}
    solids: dict[str, list[Shape]] = {}
    for i, gate in enumerate(level.track.gates):
        x, y, yaw = _plan(where[f"gate{i + 1}"])
        foot = gate.z
        solids[f"gate{i + 1}"] = [
            shape for _, shape in gate_solids(x, y, foot + gate.type.height, foot, yaw, gate.type)
        ]
    for i, post in enumerate(level.track.obstacles):
        x, y, yaw = _plan(where[f"obstacle{i + 1}"])
        solids[f"obstacle{i + 1}"] = pole_solids(x, y, post.z, yaw)
    fence = Fence.from_arena(level.arena)
    problems = []
    for i, gate in enumerate(level.track.gates):
        name = f"gate{i + 1}"
        x, y, yaw = _plan(where[name])
        centre = (x, y, gate.z + gate.type.height)
        for other, shapes in solids.items():
            if other != name and any(_in_opening(shape, centre, yaw) for shape in shapes):
                problems.append(f"{other} stands in the opening of {name}; move one of them")
        for depth, side in ((0.0, "in it"), (-_WAY, "on one side"), (_WAY, "on the other side")):
            point = _through(centre, yaw, 0.0, depth, 0.0)
            room = fence.room(*point)
            if room < _VEHICLE:
                problems.append(
                    f"{name} has no room {side}: fence or keep-out zone are {room:.2f} m away at "
                    f"({point[0]:.2f}, {point[1]:.2f}, {point[2]:.2f}); a vehicle needs "
                    f"{_VEHICLE:g} m"
                )
    return problems


def _plan(pose: Pose) -> tuple[float, float, float]:
    x, y, z, w = pose.quaternion.tolist()
    yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return float(pose.position[0]), float(pose.position[1]), yaw


def _through(
    centre: Sequence[float], yaw: float, across: float, depth: float, up: float
) -> tuple[float, float, float]:
    """A point by its place in a gate: across its span, along the way through, and up; m."""
    c, s = math.cos(yaw), math.sin(yaw)
    return (
        centre[0] + c * across - s * depth,
        centre[1] + s * across + c * depth,
        centre[2] + up,
    )


def _in_opening(shape: Shape, centre: Sequence[float], yaw: float) -> bool:
    """Whether any of a solid is in the opening: on a grid finer than the thinnest solid."""
    steps = np.linspace(-1.0, 1.0, 9)
    for depth in np.linspace(-_DEPTH, _DEPTH, 5).tolist():
        for across in (_OPENING * steps).tolist():
            for up in (_OPENING * steps).tolist():
                # Clearance is positive inside a shape.
                if shape.clearance(*_through(centre, yaw, across, depth, up)) > 0.0:
                    return True
    return False
