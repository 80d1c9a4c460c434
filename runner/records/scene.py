"""The track as a ``foxglove.SceneUpdate``, for 3-D views of a recording."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyarena.levels.schema import Level
from crazyarena.sim_backend.physics.sizes import (
    BASE_HEIGHT,
    BASE_WIDTH,
    BEAM_LENGTH,
    BEAM_OFFSET,
    BEAM_WIDTH,
    GATE_CENTRE_Z,
    OBSTACLE_CENTRE_Z,
    OBSTACLE_LENGTH,
    OBSTACLE_RADIUS,
    POST_LENGTH,
    POST_RADIUS,
    TALL,
)

_GATE = {"r": 0.1, "g": 0.5, "b": 0.9, "a": 1.0}
_OBSTACLE = {"r": 0.8, "g": 0.3, "b": 0.1, "a": 1.0}
_GOAL = {"r": 0.1, "g": 0.8, "b": 0.3, "a": 0.4}


def _vector(x: float, y: float, z: float) -> dict[str, float]:
    return {"x": float(x), "y": float(y), "z": float(z)}


def _pose(x: float, y: float, z: float, yaw: float = 0.0) -> dict[str, Any]:
    half = float(yaw) / 2
    orientation = {"x": 0.0, "y": 0.0, "z": math.sin(half), "w": math.cos(half)}
    return {"position": _vector(x, y, z), "orientation": orientation}


def _box(pose: dict[str, Any], size: tuple[float, float, float], colour: dict) -> dict[str, Any]:
    return {"pose": pose, "size": _vector(*size), "color": colour}


def _cylinder(pose: dict[str, Any], radius: float, length: float, colour: dict) -> dict[str, Any]:
    size = _vector(2 * radius, 2 * radius, length)
    return {"pose": pose, "size": size, "bottom_scale": 1.0, "top_scale": 1.0, "color": colour}


def _entity(name: str, **shapes: list[dict[str, Any]]) -> dict[str, Any]:
    zero = {"sec": 0, "nsec": 0}
    return {
        "timestamp": zero,
        "frame_id": "map",
        "id": name,
        "lifetime": zero,
        "frame_locked": False,
        "metadata": [],
        **{kind: shapes.get(kind, []) for kind in ("arrows", "cubes", "spheres", "cylinders")},
        "lines": [],
        "triangles": [],
        "texts": [],
        "models": [],
    }


def _gate(name: str, row: NDArray[np.float64]) -> dict[str, Any]:
    x, y, yaw = row[0], row[1], row[5]
    tall = row[6] == TALL
    z = GATE_CENTRE_Z[0 if tall else 1]
    ux, uy = math.cos(yaw) * BEAM_OFFSET, math.sin(yaw) * BEAM_OFFSET
    lying, standing = (BEAM_LENGTH, BEAM_WIDTH, BEAM_WIDTH), (BEAM_WIDTH, BEAM_WIDTH, BEAM_LENGTH)
    cubes = [
        _box(_pose(x, y, z + BEAM_OFFSET, yaw), lying, _GATE),
        _box(_pose(x, y, z - BEAM_OFFSET, yaw), lying, _GATE),
        _box(_pose(x + ux, y + uy, z, yaw), standing, _GATE),
        _box(_pose(x - ux, y - uy, z, yaw), standing, _GATE),
    ]
    if tall:
        post = _cylinder(_pose(x, y, POST_LENGTH / 2), POST_RADIUS, POST_LENGTH, _GATE)
        return _entity(name, cubes=cubes, cylinders=[post])
    base = (BASE_WIDTH, BASE_WIDTH, BASE_HEIGHT)
    return _entity(name, cubes=[*cubes, _box(_pose(x, y, BASE_HEIGHT / 2, yaw), base, _GATE)])


def _obstacle(name: str, row: NDArray[np.float64]) -> dict[str, Any]:
    x, y, yaw = row[0], row[1], row[5]
    base = (BASE_WIDTH, BASE_WIDTH, BASE_HEIGHT)
    pillar = _pose(x, y, OBSTACLE_CENTRE_Z, yaw)
    return _entity(
        name,
        cubes=[_box(_pose(x, y, BASE_HEIGHT / 2, yaw), base, _OBSTACLE)],
        cylinders=[_cylinder(pillar, OBSTACLE_RADIUS, OBSTACLE_LENGTH, _OBSTACLE)],
    )


def moved_gates(gates: NDArray[np.float64], which: Iterable[int], time: float) -> dict[str, Any]:
    """The gates ``which`` of (n, 7) at their places at a time, s."""
    entities = []
    for i in which:
        entity = _gate(f"gate {i}", gates[i])
        nanoseconds = round(time * 1e9)
        stamp = {"sec": nanoseconds // 10**9, "nsec": nanoseconds % 10**9}
        entities.append({**entity, "timestamp": stamp})
    return {"deletions": [], "entities": entities}


def scene_update(
    gates: NDArray[np.float64], obstacles: NDArray[np.float64], level: Level
) -> dict[str, Any]:
    """Gates (n, 7), obstacles (m, 6) at their true poses, and the goal."""
    size = 2 * level.goal.tolerance
    goal = {"pose": _pose(*level.goal.position), "size": _vector(size, size, size), "color": _GOAL}
    return {
        "deletions": [],
        "entities": [
            *(_gate(f"gate {i}", row) for i, row in enumerate(gates)),
            *(_obstacle(f"obstacle {i}", row) for i, row in enumerate(obstacles)),
            _entity("goal", spheres=[goal]),
        ],
    }
