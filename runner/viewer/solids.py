"""Meshes and lines for a scene: bodies of a ``foxglove.SceneUpdate``, and the arena's limits.

Scenes come out of recordings that anybody may have written: what is no body is left out.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Colour = tuple[float, float, float, float]

_SIDES = 20
_MOST_BODIES = 2000  # of one scene
_MOST_POINTS = 100_000
_FAR = 1e4  # m; nothing that is flown in is so large


class Mesh(NamedTuple):
    """vertices (n, 3) m, faces (m, 3) of their numbers, and one colour r, g, b, a (0..1)."""

    vertices: Array
    faces: NDArray[np.uint32]
    colour: Colour


class Lines(NamedTuple):
    """Segments (n, 2, 3) m of one colour r, g, b, a (0..1)."""

    segments: Array
    colour: Colour


def box(size: Sequence[float]) -> tuple[Array, NDArray[np.uint32]]:
    """A box of this size (3,) m about the origin."""
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    faces = [(a, b, c) for a, b, c, d in quads] + [(a, c, d) for a, b, c, d in quads]
    return corners * np.asarray(size), np.array(faces, np.uint32)


def cylinder(radius: float, length: float) -> tuple[Array, NDArray[np.uint32]]:
    """An upright cylinder about the origin."""
    angles = np.arange(_SIDES) * (2.0 * np.pi / _SIDES)
    ring = np.stack([radius * np.cos(angles), radius * np.sin(angles)], axis=1)
    low = np.column_stack([ring, np.full(_SIDES, -0.5 * length)])
    high = np.column_stack([ring, np.full(_SIDES, 0.5 * length)])
    ends = np.array([[0.0, 0.0, -0.5 * length], [0.0, 0.0, 0.5 * length]])
    k = np.arange(_SIDES)
    n = (k + 1) % _SIDES
    faces = np.concatenate(
        [
            np.stack([k, n, n + _SIDES], axis=1),
            np.stack([k, n + _SIDES, k + _SIDES], axis=1),
            np.stack([n, k, np.full(_SIDES, 2 * _SIDES)], axis=1),
            np.stack([k + _SIDES, n + _SIDES, np.full(_SIDES, 2 * _SIDES + 1)], axis=1),
        ]
    )
    return np.concatenate([low, high, ends]), faces.astype(np.uint32)


def ball(size: Sequence[float]) -> tuple[Array, NDArray[np.uint32]]:
    """An ellipsoid of these diameters (3,) m about the origin."""
    rings = _SIDES // 2
    polar = np.linspace(0.0, np.pi, rings + 1)
    around = np.arange(_SIDES) * (2.0 * np.pi / _SIDES)
    points = np.array(
        [
            [math.sin(p) * math.cos(a), math.sin(p) * math.sin(a), math.cos(p)]
            for p in polar
            for a in around
        ]
    )
    k, n = np.arange(_SIDES), (np.arange(_SIDES) + 1) % _SIDES
    faces = []
    for ring in range(rings):
        top, low = ring * _SIDES, (ring + 1) * _SIDES
        faces += [
            np.stack([k + top, k + low, n + low], 1),
            np.stack([k + top, n + low, n + top], 1),
        ]
    return 0.5 * points * np.asarray(size), np.concatenate(faces).astype(np.uint32)


def rotated(points: Array, quaternion: Sequence[float]) -> Array:
    """Points (n, 3) turned by a quaternion x, y, z, w of any length but 0."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_quat(quaternion).apply(points))


def _numbers(fields: Any, names: str) -> list[float]:
    """Numbers by name; raises ValueError for one that is none, or beyond any room."""
    if not isinstance(fields, Mapping):
        raise ValueError("no mapping")
    values = [float(fields[name]) for name in names]
    if not all(abs(value) <= _FAR for value in values):
        raise ValueError("not finite, or far away")
    return values


def _colour(fields: Any) -> Colour:
    r, g, b, a = (min(1.0, max(0.0, value)) for value in _numbers(fields, "rgba"))
    return r, g, b, a


def _body(kind: str, fields: Any) -> Mesh:
    size = _numbers(fields["size"], "xyz")
    if kind == "cubes":
        vertices, faces = box(size)
    elif kind == "spheres":
        vertices, faces = ball(size)
    else:
        vertices, faces = cylinder(0.5 * size[0], size[2])
    pose = fields["pose"]
    turned = rotated(vertices, _numbers(pose["orientation"], "xyzw"))
    placed = turned + _numbers(pose["position"], "xyz")
    return Mesh(placed, faces, _colour(fields["color"]))


def _line(fields: Any) -> Lines:
    points = np.array([_numbers(p, "xyz") for p in fields["points"][:_MOST_POINTS]])
    points = points.reshape(-1, 3)
    kind = int(fields.get("type", 0))
    if kind == 2:  # LINE_LIST
        segments = points[: len(points) // 2 * 2].reshape(-1, 2, 3)
    else:
        ends = np.roll(points, -1, axis=0) if kind == 1 else points[1:]  # LINE_LOOP, LINE_STRIP
        segments = np.stack([points[: len(ends)], ends], axis=1)
    return Lines(segments, _colour(fields["color"]))


def bodies(entities: Any) -> tuple[list[Mesh], list[Lines]]:
    """What entities of a ``foxglove.SceneUpdate`` look like, one mesh and one set of lines a
    colour."""
    meshes: list[Mesh] = []
    lines: list[Lines] = []
    for entity in entities if isinstance(entities, list) else ():
        if not isinstance(entity, Mapping):
            continue
        for kind in ("cubes", "cylinders", "spheres", "lines"):
            members = entity.get(kind)
            for fields in members if isinstance(members, list) else ():
                if len(meshes) + len(lines) >= _MOST_BODIES:
                    break
                try:
                    if kind == "lines":
                        lines.append(_line(fields))
                    else:
                        meshes.append(_body(kind, fields))
                except (ValueError, TypeError, KeyError, AttributeError, OverflowError):
                    continue
    return _joined(meshes), _joined_lines(lines)


def _joined(meshes: Iterable[Mesh]) -> list[Mesh]:
    by_colour: dict[Colour, list[Mesh]] = {}
    for mesh in meshes:
        by_colour.setdefault(mesh.colour, []).append(mesh)
    joined = []
    for colour, group in by_colour.items():
        starts = np.cumsum([0] + [len(mesh.vertices) for mesh in group[:-1]])
        faces = [mesh.faces + np.uint32(start) for mesh, start in zip(group, starts, strict=True)]
        vertices = np.concatenate([mesh.vertices for mesh in group])
        joined.append(Mesh(vertices, np.concatenate(faces), colour))
    return joined


def _joined_lines(lines: Iterable[Lines]) -> list[Lines]:
    by_colour: dict[Colour, list[Array]] = {}
    for line in lines:
        if len(line.segments):
            by_colour.setdefault(line.colour, []).append(line.segments)
    return [Lines(np.concatenate(parts), colour) for colour, parts in by_colour.items()]


def box_edges(low: ArrayLike, high: ArrayLike) -> Array:
    """The twelve edges (12, 2, 3) of a box."""
    ends = np.array([low, high], np.float64)
    corners = [(i, j, k) for i in (0, 1) for j in (0, 1) for k in (0, 1)]
    pairs = [(a, b) for a in corners for b in corners if a < b and _differ(a, b) == 1]
    return np.array([[[ends[c[axis], axis] for axis in range(3)] for c in pair] for pair in pairs])


def _differ(a: Sequence[int], b: Sequence[int]) -> int:
    return sum(x != y for x, y in zip(a, b, strict=True))


def _prism_edges(ring: Array, bottom: float, top: float) -> Array:
    low = np.column_stack([ring, np.full(len(ring), bottom)])
    high = np.column_stack([ring, np.full(len(ring), top)])
    around = [np.stack([r, np.roll(r, -1, axis=0)], axis=1) for r in (low, high)]
    return np.concatenate([*around, np.stack([low, high], axis=1)])


def _inset(ring: Array, margin: float) -> Array:
    """Corners of a polygon whose sides lie ``margin`` m further inside."""
    following = np.roll(ring, -1, axis=0)
    area = float(np.sum(ring[:, 0] * following[:, 1] - ring[:, 1] * following[:, 0]))
    sides = following - ring
    lengths = np.linalg.norm(sides, axis=1, keepdims=True)
    inwards = np.sign(area) * np.column_stack([-sides[:, 1], sides[:, 0]]) / lengths
    earlier = np.roll(inwards, 1, axis=0)
    mitre = inwards + earlier
    share = 2.0 / np.maximum(np.sum(mitre**2, axis=1, keepdims=True), 0.1)
    return ring + margin * mitre * share


def shape_edges(shape: Mapping[str, Any], margin: float = 0.0) -> Array:
    """Edges (n, 2, 3) of a solid of a level file (as plain data), ``margin`` m further inside; a
    hull has none further inside."""
    kind = shape["kind"]
    if kind == "box":
        low, high = np.asarray(shape["low"], float), np.asarray(shape["high"], float)
        return box_edges(low + margin, high - margin)
    if kind == "polytope":
        return np.empty((0, 2, 3)) if margin else _hull_edges(np.asarray(shape["vertices"], float))
    bottom, top = float(shape["bottom"]) + margin, float(shape["top"]) - margin
    if kind == "cylinder":
        angles = np.arange(4 * _SIDES) * (2.0 * np.pi / (4 * _SIDES))
        radius = max(0.0, float(shape["radius"]) - margin)
        circle = np.column_stack([np.cos(angles), np.sin(angles)])
        edges = _prism_edges(radius * circle + [shape["x"], shape["y"]], bottom, top)
        rings = edges[: 8 * _SIDES]
        return np.concatenate([rings, edges[8 * _SIDES :: _SIDES]])
    ring = np.asarray(shape["points"], float)
    return _prism_edges(_inset(ring, margin) if margin else ring, bottom, top)


def _hull_edges(vertices: Array) -> Array:
    """Edges of a convex hull, without those within a face."""
    from scipy.spatial import ConvexHull

    hull = ConvexHull(vertices)
    faces: dict[tuple[int, int], list[Array]] = {}
    for triangle, plane in zip(hull.simplices, hull.equations, strict=True):
        for a, b in ((0, 1), (1, 2), (2, 0)):
            key = tuple(sorted((int(triangle[a]), int(triangle[b]))))
            faces.setdefault(key, []).append(plane[:3])  # type: ignore[arg-type]
    edges = [
        [vertices[a], vertices[b]]
        for (a, b), normals in faces.items()
        if len(normals) < 2 or float(normals[0] @ normals[1]) < 1.0 - 1e-6
    ]
    return np.array(edges).reshape(-1, 2, 3)
