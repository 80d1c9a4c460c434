"""A track of lsy_drone_racing, and what its controllers draw, as ``foxglove.SceneUpdate``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from crazyarena.runner.contestant.contract_lsy.dialogue import Drawing
from crazyarena.runner.records.scene import _box, _cylinder, _entity, _vector
from crazyarena.sim_backend.physics.successor_scene import POLE_LENGTH, POLE_RADIUS, gate_boxes

_GATE = {"r": 0.1, "g": 0.5, "b": 0.9, "a": 1.0}
_POLE = {"r": 0.8, "g": 0.3, "b": 0.1, "a": 1.0}


def _pose(place: NDArray[np.float64], quat: Sequence[float] = (0.0, 0.0, 0.0, 1.0)) -> Any:
    x, y, z, w = map(float, quat)
    return {"position": _vector(*place), "orientation": {"x": x, "y": y, "z": z, "w": w}}


def lsy_scene(gates: NDArray[np.float64], obstacles: NDArray[np.float64]) -> dict[str, Any]:
    """Gates (n, 7: centre, quaternion) and obstacles (m, 3: tops) where they truly stand."""
    entities = []
    for index, gate in enumerate(gates):
        turn = Rotation.from_quat(gate[3:])
        cubes = [
            _box(
                _pose(gate[:3] + turn.apply(centre), gate[3:]),
                (2 * half[0], 2 * half[1], 2 * half[2]),
                _GATE,
            )
            for centre, half in gate_boxes()
        ]
        entities.append(_entity(f"gate {index}", cubes=cubes))
    for index, top in enumerate(obstacles):
        pole = _pose(top - [0.0, 0.0, POLE_LENGTH / 2])
        shape = _cylinder(pole, POLE_RADIUS, POLE_LENGTH, _POLE)
        entities.append(_entity(f"obstacle {index}", cylinders=[shape]))
    return {"deletions": [], "entities": entities}


def drawn_scene(drawings: Sequence[Drawing], time: float) -> dict[str, Any]:
    """What a controller has drawn at a time, s; it replaces what it drew before."""
    entity = _entity("drawings")
    nanoseconds = round(time * 1e9)
    entity["timestamp"] = {"sec": nanoseconds // 10**9, "nsec": nanoseconds % 10**9}
    for drawing in drawings:
        red, green, blue, alpha = drawing.rgba
        colour = {"r": red, "g": green, "b": blue, "a": alpha}
        if drawing.kind == "line":
            entity["lines"].append(
                {
                    "type": 0,
                    "pose": _pose(np.zeros(3)),
                    "thickness": drawing.size,
                    "scale_invariant": True,
                    "points": [_vector(*point) for point in drawing.points],
                    "color": colour,
                    "colors": [],
                    "indices": [],
                }
            )
        else:
            size = 2.0 * drawing.size
            entity["spheres"] += [
                {"pose": _pose(point), "size": _vector(size, size, size), "color": colour}
                for point in drawing.points
            ]
    return {"deletions": [], "entities": [entity]}
