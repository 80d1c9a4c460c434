"""Solids in space with a signed distance to their surface.

Positive is inside. Inside a union the distance is a lower bound (that of the best member), so
members should overlap by at least twice the margin that is kept from the surface; everything
else is exact. Point queries are a few scalar operations: they run on every pose frame.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from crazyarena.errors import InputError

Bounds = tuple[tuple[float, float, float], tuple[float, float, float]]


class Shape(Protocol):
    """A solid; coordinates in m."""

    @property
    def bounds(self) -> Bounds:
        """Lower and upper corner of a box around it."""
        ...

    def clearance(self, x: float, y: float, z: float) -> float:
        """Distance from a point to the surface, m; negative outside."""
        ...


class Box:
    """Axis-aligned box from ``low`` to ``high`` (3,)."""

    def __init__(self, low: ArrayLike, high: ArrayLike) -> None:
        self._low = _point(low)
        self._high = _point(high)
        if not all(a < b for a, b in zip(self._low, self._high, strict=True)):
            raise InputError(f"box: expected low < high on every axis, found {low!r} .. {high!r}")

    @property
    def bounds(self) -> Bounds:
        return self._low, self._high

    def clearance(self, x: float, y: float, z: float) -> float:
        (lx, ly, lz), (hx, hy, hz) = self._low, self._high
        dx, dy, dz = min(x - lx, hx - x), min(y - ly, hy - y), min(z - lz, hz - z)
        inside = min(dx, dy, dz)
        if inside >= 0.0:
            return inside
        return -math.hypot(min(dx, 0.0), min(dy, 0.0), min(dz, 0.0))


class Cylinder:
    """Upright cylinder."""

    def __init__(self, x: float, y: float, radius: float, bottom: float, top: float) -> None:
        if not (radius > 0.0 and bottom < top):
            raise InputError(
                f"cylinder: expected radius > 0 and bottom < top, found radius {radius}, "
                f"bottom {bottom}, top {top}"
            )
        self.x, self.y, self.radius = float(x), float(y), float(radius)
        self.bottom, self.top = float(bottom), float(top)

    @property
    def bounds(self) -> Bounds:
        x, y, r = self.x, self.y, self.radius
        return (x - r, y - r, self.bottom), (x + r, y + r, self.top)

    def clearance(self, x: float, y: float, z: float) -> float:
        side = self.radius - math.hypot(x - self.x, y - self.y)
        return _extruded(side, min(z - self.bottom, self.top - z))


class Prism:
    """Upright prism over a simple polygon (n, 2), convex or not, either way round."""

    def __init__(self, points: ArrayLike, bottom: float, top: float) -> None:
        corners = np.asarray(points, dtype=np.float64)
        if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3:
            raise InputError(f"prism: expected at least 3 points [x, y], found {points!r}")
        if not bottom < top:
            raise InputError(f"prism: expected bottom < top, found {bottom} and {top}")
        ring = [(float(x), float(y)) for x, y in corners]
        self._edges = tuple(
            (ax, ay, bx - ax, by - ay, (bx - ax) ** 2 + (by - ay) ** 2)
            for (ax, ay), (bx, by) in zip(ring, ring[1:] + ring[:1], strict=True)
        )
        self.points = tuple(ring)
        self.bottom, self.top = float(bottom), float(top)
        self._refuse_bad_ring()

    def _refuse_bad_ring(self) -> None:
        n = len(self._edges)
        for i, (ax, ay, dx, dy, length2) in enumerate(self._edges):
            if length2 < 1e-12:
                raise InputError(f"prism: expected distinct points, found [{ax:g}, {ay:g}] twice")
            for j in range(i + 2, n - (i == 0)):
                cx, cy, ex, ey, _ = self._edges[j]
                # Each edge's ends on both sides of the other's line: they cross or touch.
                if (
                    _side(ax, ay, dx, dy, cx, cy) * _side(ax, ay, dx, dy, cx + ex, cy + ey) <= 0
                    and _side(cx, cy, ex, ey, ax, ay) * _side(cx, cy, ex, ey, ax + dx, ay + dy) <= 0
                    and _overlap(ax, dx, cx, ex)
                    and _overlap(ay, dy, cy, ey)
                ):
                    raise InputError(
                        f"prism: expected edges that do not cross, found edges {i} and {j} crossing"
                    )
        if abs(sum(ax * (ay + dy) - (ax + dx) * ay for ax, ay, dx, dy, _ in self._edges)) < 1e-9:
            raise InputError("prism: expected a polygon with an area, found points on a line")

    @property
    def bounds(self) -> Bounds:
        xs, ys = zip(*self.points, strict=True)
        return (min(xs), min(ys), self.bottom), (max(xs), max(ys), self.top)

    def clearance(self, x: float, y: float, z: float) -> float:
        nearest = math.inf
        inside = False
        for ax, ay, dx, dy, length2 in self._edges:
            px, py = x - ax, y - ay
            along = (px * dx + py * dy) / length2
            along = 0.0 if along < 0.0 else 1.0 if along > 1.0 else along
            ox, oy = px - along * dx, py - along * dy
            distance = ox * ox + oy * oy
            if distance < nearest:
                nearest = distance
            # Even-odd rule along the ray towards +x.
            if (ay > y) != (ay + dy > y) and px < dx * py / dy:
                inside = not inside
        side = math.sqrt(nearest)
        return _extruded(side if inside else -side, min(z - self.bottom, self.top - z))


class Polytope:
    """Convex hull of points (n, 3)."""

    def __init__(self, vertices: ArrayLike) -> None:
        from scipy.spatial import ConvexHull, QhullError

        corners = np.asarray(vertices, dtype=np.float64)
        if corners.ndim != 2 or corners.shape[1] != 3 or len(corners) < 4:
            raise InputError(f"polytope: expected at least 4 points [x, y, z], found {vertices!r}")
        try:
            hull = ConvexHull(corners)
        except QhullError:
            raise InputError(
                f"polytope: expected points that span a volume, found {corners.tolist()}"
            ) from None
        # Triangles of one face share its plane.
        planes = {tuple(row) for row in np.round(hull.equations, 12).tolist()}
        self._planes = tuple(sorted(planes))
        self._triangles = corners[hull.simplices]
        self._bounds: Bounds = (_point(corners.min(axis=0)), _point(corners.max(axis=0)))

    @property
    def planes(self) -> tuple[tuple[float, ...], ...]:
        """Outward unit normals and offsets (nx, ny, nz, d): inside is n p + d <= 0."""
        return self._planes

    @property
    def bounds(self) -> Bounds:
        return self._bounds

    def clearance(self, x: float, y: float, z: float) -> float:
        outermost = max(a * x + b * y + c * z + d for a, b, c, d in self._planes)
        if outermost <= 0.0 or not math.isfinite(outermost):
            return -outermost
        point = np.array([x, y, z])
        return -min(_triangle_distance(point, *corners) for corners in self._triangles)


class Union:
    """All points that are in any of the members."""

    def __init__(self, members: Sequence[Shape]) -> None:
        if not members:
            raise InputError("union: expected at least one shape, found none")
        self.members = tuple(members)

    @property
    def bounds(self) -> Bounds:
        lows, highs = zip(*(member.bounds for member in self.members), strict=True)
        low = _point(np.min(lows, axis=0))
        return low, _point(np.max(highs, axis=0))

    def clearance(self, x: float, y: float, z: float) -> float:
        return max(member.clearance(x, y, z) for member in self.members)


def _point(values: ArrayLike) -> tuple[float, float, float]:
    array = np.asarray(values, dtype=np.float64)
    if array.shape != (3,) or not np.isfinite(array).all():
        raise InputError(f"shape: expected three finite numbers, found {values!r}")
    x, y, z = array.tolist()
    return x, y, z


def _extruded(side: float, height: float) -> float:
    """Signed distance of an upright solid from those of its outline and its height range."""
    if side < 0.0 and height < 0.0:
        return -math.hypot(side, height)
    return min(side, height)


def _side(ax: float, ay: float, dx: float, dy: float, x: float, y: float) -> float:
    return dx * (y - ay) - dy * (x - ax)


def _overlap(a: float, da: float, b: float, db: float) -> bool:
    return max(min(a, a + da), min(b, b + db)) <= min(max(a, a + da), max(b, b + db))


def _triangle_distance(p: np.ndarray, a: np.ndarray, b: np.ndarray, c: np.ndarray) -> float:
    """Distance from a point to a triangle: to its plane above it, else to its edges."""
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal)
    edges = ((a, b), (b, c), (c, a))
    if all(float(np.cross(v - u, p - u) @ normal) >= 0.0 for u, v in edges):
        return abs(float((p - a) @ normal))
    best = math.inf
    for u, v in edges:
        along = float(np.clip((p - u) @ (v - u) / ((v - u) @ (v - u)), 0.0, 1.0))
        best = min(best, float(np.linalg.norm(p - u - along * (v - u))))
    return best
