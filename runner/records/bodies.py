"""The solids of a ``foxglove.SceneUpdate``: where they are, and how far a path is from them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

_KINDS = ("cubes", "cylinders", "spheres")


@dataclass(frozen=True, slots=True)
class Body:
    """One solid. centre (3,) m, turn: body to world, half (3,) m; cylinders stand along their z."""

    kind: str
    centre: Array
    turn: Rotation
    half: Array

    def corners(self) -> Array:
        """(8, 3) m, of the box around it."""
        signs = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        return self.centre + self.turn.apply(signs * self.half)

    def distance(self, points: Array) -> Array:
        """Distance of points (n, 3) from its surface, m; negative inside."""
        local = self.turn.inv().apply(np.atleast_2d(points) - self.centre)
        if self.kind == "spheres":
            return np.linalg.norm(local, axis=1) - self.half[0]
        if self.kind == "cylinders":
            radial = np.hypot(local[:, 0], local[:, 1]) - self.half[0]
            beyond = np.stack([radial, np.abs(local[:, 2]) - self.half[2]], axis=1)
        else:
            beyond = np.abs(local) - self.half
        outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
        return outside + np.minimum(beyond.max(axis=1), 0.0)


def bodies(entity: Mapping[str, Any]) -> Iterator[Body]:
    """Solids of one entity; what is no solid of finite size is left out."""
    for kind in _KINDS:
        for shape in entity.get(kind) or ():
            try:
                place, turn, size = (
                    np.array([float(part[axis]) for axis in axes])
                    for part, axes in (
                        (shape["pose"]["position"], "xyz"),
                        (shape["pose"]["orientation"], "xyzw"),
                        (shape["size"], "xyz"),
                    )
                )
            except (KeyError, TypeError, ValueError, AttributeError):
                continue
            norm = np.linalg.norm(turn)
            if np.isfinite([*place, *turn, *size]).all() and norm > 1e-9:
                yield Body(kind, place, Rotation.from_quat(turn / norm), size / 2)


def distances(points: Array, entities: Iterable[Mapping[str, Any]]) -> dict[str, Array]:
    """Distance of points (n, 3) from each entity but the goal and drawings, m, by its name."""
    found: dict[str, Array] = {}
    for entity in entities:
        name = str(entity.get("id", ""))
        if name in ("goal", "drawings") or not len(points):
            continue
        each = [body.distance(points) for body in bodies(entity)]
        if each:
            found[name] = np.min(each, axis=0)
    return found


def opening(entity: Mapping[str, Any]) -> tuple[Array, float] | None:
    """Centre (3,) of what a gate's first four bars surround, and half its height, m."""
    bars = [body for body in bodies(entity) if body.kind == "cubes"][:4]
    if len(bars) < 4:
        return None
    centre = np.mean([bar.centre for bar in bars], axis=0)
    return centre, float(min(bar.distance(centre)[0] for bar in bars))


def gate_openings(entities: Iterable[Mapping[str, Any]]) -> dict[str, tuple[Array, float]]:
    """Openings of the gates of a track by their names, in their order."""
    found = {}
    for entity in entities:
        name = str(entity.get("id", ""))
        if name.startswith("gate ") and (hole := opening(entity)) is not None:
            found[name] = hole
    return found
