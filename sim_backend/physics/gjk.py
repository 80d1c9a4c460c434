"""Distance between two convex cores (Gilbert, Johnson & Keerthi 1988).

Shapes are rows in the layout of ``scene.py``. The closest point of a simplex to the origin
follows the Voronoi-region tests of Ericson, *Real-Time Collision Detection*, 2005, section 5.1.
"""

from __future__ import annotations

import math

import numpy as np

from crazyarena.jit import kernel
from crazyarena.sim_backend.physics.scene import (
    BOX,
    FACETS,
    S_CENTRE,
    S_HALF,
    S_KIND,
    S_ROTATION,
)

TOLERANCE = 1e-7  # m, of a distance
_MAX_ITERATIONS = 48
_FACET_COS = np.cos(2.0 * np.pi / FACETS * np.arange(FACETS))
_FACET_SIN = np.sin(2.0 * np.pi / FACETS * np.arange(FACETS))
_FACETS_PER_RAD = FACETS / (2.0 * np.pi)

# Four scratch rows: a point of the Minkowski difference and the point of shape A behind it.
SIMPLEX_ROWS = 4
_W = 0
_A = 3


@kernel
def support(shapes, i, dx, dy, dz):
    """Farthest point of a core in a world direction, relative to the core's centre."""
    r = S_ROTATION
    lx = shapes[i, r] * dx + shapes[i, r + 3] * dy + shapes[i, r + 6] * dz
    ly = shapes[i, r + 1] * dx + shapes[i, r + 4] * dy + shapes[i, r + 7] * dz
    lz = shapes[i, r + 2] * dx + shapes[i, r + 5] * dy + shapes[i, r + 8] * dz
    hx, hy, hz = shapes[i, S_HALF], shapes[i, S_HALF + 1], shapes[i, S_HALF + 2]
    if shapes[i, S_KIND] == BOX:
        px = hx if lx >= 0.0 else -hx
        py = hy if ly >= 0.0 else -hy
    else:
        corner = math.floor(math.atan2(ly, lx) * _FACETS_PER_RAD + 0.5) % FACETS
        px = hx * _FACET_COS[corner]
        py = hx * _FACET_SIN[corner]
    pz = hz if lz >= 0.0 else -hz
    return (
        shapes[i, r] * px + shapes[i, r + 1] * py + shapes[i, r + 2] * pz,
        shapes[i, r + 3] * px + shapes[i, r + 4] * py + shapes[i, r + 5] * pz,
        shapes[i, r + 6] * px + shapes[i, r + 7] * py + shapes[i, r + 8] * pz,
    )


@kernel
def _dot(s, i, j):
    return s[i, 0] * s[j, 0] + s[i, 1] * s[j, 1] + s[i, 2] * s[j, 2]


@kernel
def _segment(s, i, j):
    """Weights of points i and j for the point of their segment closest to the origin."""
    dd = _dot(s, i, i) - 2.0 * _dot(s, i, j) + _dot(s, j, j)
    t = (_dot(s, i, i) - _dot(s, i, j)) / dd if dd > 0.0 else 0.0
    t = min(max(t, 0.0), 1.0)
    return 1.0 - t, t


@kernel
def _triangle(s, a, b, c):
    """Weights of three points for the point of their triangle closest to the origin."""
    aa, bb, cc = _dot(s, a, a), _dot(s, b, b), _dot(s, c, c)
    ab, ac, bc = _dot(s, a, b), _dot(s, a, c), _dot(s, b, c)
    d1, d2 = aa - ab, aa - ac
    if d1 <= 0.0 and d2 <= 0.0:
        return 1.0, 0.0, 0.0
    d3, d4 = ab - bb, ab - bc
    if d3 >= 0.0 and d4 <= d3:
        return 0.0, 1.0, 0.0
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        t = d1 / (d1 - d3)
        return 1.0 - t, t, 0.0
    d5, d6 = ac - bc, ac - cc
    if d6 >= 0.0 and d5 <= d6:
        return 0.0, 0.0, 1.0
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        t = d2 / (d2 - d6)
        return 1.0 - t, 0.0, t
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        t = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        return 0.0, 1.0 - t, t
    scale = 1.0 / (va + vb + vc)
    return 1.0 - (vb + vc) * scale, vb * scale, vc * scale


@kernel
def _outside(s, a, b, c, d):
    """True unless the origin lies strictly on d's side of the plane through a, b, c."""
    ux, uy, uz = s[b, 0] - s[a, 0], s[b, 1] - s[a, 1], s[b, 2] - s[a, 2]
    vx, vy, vz = s[c, 0] - s[a, 0], s[c, 1] - s[a, 1], s[c, 2] - s[a, 2]
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    origin = -(nx * s[a, 0] + ny * s[a, 1] + nz * s[a, 2])
    apex = origin + nx * s[d, 0] + ny * s[d, 1] + nz * s[d, 2]
    return origin * apex <= 0.0 or abs(apex) < 1e-18


@kernel
def _tetrahedron(s):
    """Weights of the four points; (-1, 0, 0, 0) when the origin is inside."""
    best = math.inf
    w0, w1, w2, w3 = -1.0, 0.0, 0.0, 0.0
    for face in range(4):
        a = np.int64(0 if face != 0 else 1)
        b = np.int64(1 if face > 1 else 2)
        c = np.int64(2 if face == 3 else 3)
        if not _outside(s, a, b, c, face):
            continue
        u, v, w = _triangle(s, a, b, c)
        x = u * s[a, 0] + v * s[b, 0] + w * s[c, 0]
        y = u * s[a, 1] + v * s[b, 1] + w * s[c, 1]
        z = u * s[a, 2] + v * s[b, 2] + w * s[c, 2]
        dd = x * x + y * y + z * z
        if dd < best:
            best = dd
            w0 = u if a == 0 else 0.0
            w1 = u if a == 1 else (v if b == 1 else 0.0)
            w2 = v if b == 2 else (w if c == 2 else 0.0)
            w3 = w if c == 3 else 0.0
    return w0, w1, w2, w3


@kernel
def distance(shapes_a, a, shapes_b, b, scratch, row):
    """Distance of the cores ``shapes_a[a]`` and ``shapes_b[b]``.

    ``scratch[row : row + SIMPLEX_ROWS]`` is overwritten.

    Returns
    -------
    distance m (0 when the cores overlap), unit vector from B to A in the world frame, and A's
    closest point relative to A's centre. Vector and point mean nothing at distance 0.
    """
    s = scratch[row : row + SIMPLEX_ROWS]
    # Centre of A as seen from B.
    cx = shapes_a[a, S_CENTRE] - shapes_b[b, S_CENTRE]
    cy = shapes_a[a, S_CENTRE + 1] - shapes_b[b, S_CENTRE + 1]
    cz = shapes_a[a, S_CENTRE + 2] - shapes_b[b, S_CENTRE + 2]
    vx, vy, vz = cx, cy, cz
    px, py, pz = 0.0, 0.0, 0.0
    length = math.sqrt(vx * vx + vy * vy + vz * vz)
    count = 0
    first, second, third = np.int64(0), np.int64(1), np.int64(2)  # not literals, see geometry.py
    for _ in range(_MAX_ITERATIONS):
        ax, ay, az = support(shapes_a, a, -vx, -vy, -vz)
        bx, by, bz = support(shapes_b, b, vx, vy, vz)
        wx, wy, wz = cx + ax - bx, cy + ay - by, cz + az - bz
        # v.w / |v| bounds the distance from below, |v| from above (once v is in the hull).
        if count > 0 and length * length - (vx * wx + vy * wy + vz * wz) <= TOLERANCE * length:
            break
        known = False
        for i in range(count):
            known |= s[i, _W] == wx and s[i, _W + 1] == wy and s[i, _W + 2] == wz
        if known:
            break
        s[count, _W], s[count, _W + 1], s[count, _W + 2] = wx, wy, wz
        s[count, _A], s[count, _A + 1], s[count, _A + 2] = ax, ay, az
        count += 1
        w0, w1, w2, w3 = 1.0, 0.0, 0.0, 0.0
        if count == 2:
            w0, w1 = _segment(s, first, second)
        elif count == 3:
            w0, w1, w2 = _triangle(s, first, second, third)
        elif count == 4:
            w0, w1, w2, w3 = _tetrahedron(s)
            if w0 < 0.0:
                return 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0
        vx, vy, vz = 0.0, 0.0, 0.0
        px, py, pz = 0.0, 0.0, 0.0
        kept = 0
        for i in range(count):
            weight = w0 if i == 0 else (w1 if i == 1 else (w2 if i == 2 else w3))
            if weight <= 0.0:
                continue
            for k in range(6):
                s[kept, k] = s[i, k]
            kept += 1
            vx += weight * s[kept - 1, _W]
            vy += weight * s[kept - 1, _W + 1]
            vz += weight * s[kept - 1, _W + 2]
            px += weight * s[kept - 1, _A]
            py += weight * s[kept - 1, _A + 1]
            pz += weight * s[kept - 1, _A + 2]
        count = kept
        length = math.sqrt(vx * vx + vy * vy + vz * vz)
        if length < TOLERANCE:
            return 0.0, 0.0, 0.0, 1.0, px, py, pz
    return length, vx / length, vy / length, vz / length, px, py, pz
