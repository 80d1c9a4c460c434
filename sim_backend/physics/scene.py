"""Collision scene: the gates and obstacles of a track as rows of primitives.

Each object is one header row (``GROUP``: its frame and bounding sphere) followed by its
primitives; gates come first, then obstacles, so that the rows of gate g are
``GATE_ROWS * g ... GATE_ROWS * (g + 1)``. The ground (z = 0) has no row: kernels take its code.

Shapes follow Bullet, whose contacts the competition judges by: a surface is a convex *core*
with :data:`MARGIN` around it. Boxes hide the margin inside their nominal size, cylinders (a
core prism of :data:`FACETS` sides) carry it on the outside.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from crazyarena.errors import InputError
from crazyarena.jit import kernel
from crazyarena.sim_backend.physics.sizes import (
    BASE_DROP,
    BASE_HEIGHT,
    BASE_WIDTH,
    BEAM_LENGTH,
    BEAM_OFFSET,
    BEAM_WIDTH,
    GATE_CENTRE_Z,
    LOW,
    OBSTACLE_CENTRE_Z,
    OBSTACLE_LENGTH,
    OBSTACLE_RADIUS,
    POST_DROP,
    POST_LENGTH,
    POST_RADIUS,
    TALL,
)

# Row of one primitive, or of an object's header.
S_KIND = 0  # BOX, CYLINDER (axis along local z) or GROUP
S_CODE = 1  # contact code of the object, see sim_backend/trace.py
S_CENTRE = 2  # m, world; of a header: centre of the bounding sphere
S_ROTATION = 5  # local to world, row-major
S_HALF = 14  # m, half extents of the core; a cylinder has radius, radius, half length
S_RADIUS = 17  # m, bounding sphere
ROW_SIZE = 18

# A header uses S_HALF for something else.
S_COUNT = S_HALF  # how many primitive rows follow
S_FRAME_UP = S_HALF + 1  # m, from the bounding sphere's centre to the object's frame along z

BOX = 0.0
CYLINDER = 1.0
GROUP = 2.0

MARGIN = 0.001  # m, Bullet's collision margin, as PyBullet sets it
FACETS = 32  # PyBullet turns a cylinder into a prism; the radius is that of the corners

GATE_PRIMITIVES = 5
OBSTACLE_PRIMITIVES = 2
GATE_ROWS = 1 + GATE_PRIMITIVES
OBSTACLE_ROWS = 1 + OBSTACLE_PRIMITIVES

# Spheres (radius, height of the centre above the object's frame) around everything above.
_TALL_SPHERE = (0.655, -0.35)
_LOW_SPHERE = (0.441, -0.11)
_OBSTACLE_SPHERE = (0.478, -0.06)


@kernel
def put_rotation(row, roll, pitch, yaw):
    """Write Rz(yaw) Ry(pitch) Rx(roll) into a row."""
    cr, sr = math.cos(roll), math.sin(roll)
    cp, sp = math.cos(pitch), math.sin(pitch)
    cy, sy = math.cos(yaw), math.sin(yaw)
    row[S_ROTATION] = cy * cp
    row[S_ROTATION + 1] = cy * sp * sr - sy * cr
    row[S_ROTATION + 2] = cy * sp * cr + sy * sr
    row[S_ROTATION + 3] = sy * cp
    row[S_ROTATION + 4] = sy * sp * sr + cy * cr
    row[S_ROTATION + 5] = sy * sp * cr - cy * sr
    row[S_ROTATION + 6] = -sp
    row[S_ROTATION + 7] = cp * sr
    row[S_ROTATION + 8] = cp * cr


@kernel
def _put_primitive(row, frame, kind, fx, fy, fz, ox, oy, oz, hx, hy, hz):
    """One primitive of nominal half extents h at offset o of an object whose origin is f."""
    for i in range(S_ROTATION, S_ROTATION + 9):
        row[i] = frame[i]
    row[S_KIND] = kind
    row[S_CODE] = frame[S_CODE]
    r = S_ROTATION
    row[S_CENTRE] = fx + row[r] * ox + row[r + 1] * oy + row[r + 2] * oz
    row[S_CENTRE + 1] = fy + row[r + 3] * ox + row[r + 4] * oy + row[r + 5] * oz
    row[S_CENTRE + 2] = fz + row[r + 6] * ox + row[r + 7] * oy + row[r + 8] * oz
    if kind == BOX:
        row[S_RADIUS] = math.sqrt(hx * hx + hy * hy + hz * hz)
        hx, hy, hz = hx - MARGIN, hy - MARGIN, hz - MARGIN
    else:
        row[S_RADIUS] = math.sqrt(hx * hx + hz * hz) + MARGIN
    row[S_HALF], row[S_HALF + 1], row[S_HALF + 2] = hx, hy, hz


@kernel
def _put_header(row, code, count, x, y, z, roll, pitch, yaw, radius, up):
    row[S_KIND] = GROUP
    row[S_CODE] = code
    put_rotation(row, roll, pitch, yaw)
    row[S_CENTRE] = x + row[S_ROTATION + 2] * up
    row[S_CENTRE + 1] = y + row[S_ROTATION + 5] * up
    row[S_CENTRE + 2] = z + row[S_ROTATION + 8] * up
    row[S_COUNT] = count
    row[S_FRAME_UP] = -up
    row[S_HALF + 2] = 0.0
    row[S_RADIUS] = radius


@kernel
def fill_scene(gates, obstacles, scene):
    """Write the rows of all objects; shapes as in :func:`build_scene`, nothing is checked."""
    for g in range(gates.shape[0]):
        i = GATE_ROWS * g
        tall = gates[g, 6] == TALL
        x, y = gates[g, 0], gates[g, 1]
        z = GATE_CENTRE_Z[0] if tall else GATE_CENTRE_Z[1]
        radius, up = _TALL_SPHERE if tall else _LOW_SPHERE
        roll, pitch, yaw = gates[g, 3], gates[g, 4], gates[g, 5]
        parts = float(GATE_PRIMITIVES)
        _put_header(scene[i], g, parts, x, y, z, roll, pitch, yaw, radius, up)
        w, h, o = BEAM_WIDTH / 2, BEAM_LENGTH / 2, BEAM_OFFSET
        _put_primitive(scene[i + 1], scene[i], BOX, x, y, z, 0.0, 0.0, o, h, w, w)
        _put_primitive(scene[i + 2], scene[i], BOX, x, y, z, 0.0, 0.0, -o, h, w, w)
        _put_primitive(scene[i + 3], scene[i], BOX, x, y, z, o, 0.0, 0.0, w, w, h)
        _put_primitive(scene[i + 4], scene[i], BOX, x, y, z, -o, 0.0, 0.0, w, w, h)
        if tall:
            r, h, drop = POST_RADIUS, POST_LENGTH / 2, -POST_DROP
            _put_primitive(scene[i + 5], scene[i], CYLINDER, x, y, z, 0.0, 0.0, drop, r, r, h)
        else:
            w, h, drop = BASE_WIDTH / 2, BASE_HEIGHT / 2, -BASE_DROP
            _put_primitive(scene[i + 5], scene[i], BOX, x, y, z, 0.0, 0.0, drop, w, w, h)
    first = GATE_ROWS * gates.shape[0]
    for k in range(obstacles.shape[0]):
        i = first + OBSTACLE_ROWS * k
        code = gates.shape[0] + k
        x, y, z = obstacles[k, 0], obstacles[k, 1], OBSTACLE_CENTRE_Z
        roll, pitch, yaw = obstacles[k, 3], obstacles[k, 4], obstacles[k, 5]
        radius, up = _OBSTACLE_SPHERE
        _put_header(
            scene[i], code, float(OBSTACLE_PRIMITIVES), x, y, z, roll, pitch, yaw, radius, up
        )
        r, h = OBSTACLE_RADIUS, OBSTACLE_LENGTH / 2
        _put_primitive(scene[i + 1], scene[i], CYLINDER, x, y, z, 0.0, 0.0, 0.0, r, r, h)
        w, h, drop = BASE_WIDTH / 2, BASE_HEIGHT / 2, -BASE_DROP
        _put_primitive(scene[i + 2], scene[i], BOX, x, y, z, 0.0, 0.0, drop, w, w, h)


def _table(name: str, rows: ArrayLike, columns: str) -> NDArray[np.float64]:
    width = len(columns.split(", "))
    try:
        table = np.array(rows, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: expected rows of numbers [{columns}], {error}") from None
    table = table.reshape(0, width) if table.size == 0 else table
    if table.ndim != 2 or table.shape[1] != width:
        raise InputError(f"{name}: expected rows [{columns}], found shape {table.shape}")
    if not np.isfinite(table).all():
        raise InputError(f"{name}: every number must be finite, found {table.tolist()}")
    return table


def build_scene(gates: ArrayLike, obstacles: ArrayLike) -> NDArray[np.float64]:
    """Rows of all gates and obstacles at their true poses.

    Parameters
    ----------
    gates: rows [x, y, z, roll, pitch, yaw, type] in m and rad; z is ignored, the type
        (0 tall, 1 low) decides the height.
    obstacles: rows [x, y, z, roll, pitch, yaw]; z is ignored.

    Returns
    -------
    (GATE_ROWS * gates + OBSTACLE_ROWS * obstacles, ROW_SIZE) array.

    Raises
    ------
    InputError: a row of the wrong length, a number that is not finite, an unknown gate type.
    """
    gate_table = _table("gates", gates, "x, y, z, roll, pitch, yaw, type")
    obstacle_table = _table("obstacles", obstacles, "x, y, z, roll, pitch, yaw")
    for i, kind in enumerate(gate_table[:, 6]):
        if kind not in (TALL, LOW):
            raise InputError(f"gates[{i}][6]: type must be 0 (tall) or 1 (low), found {kind:g}")
    rows = GATE_ROWS * len(gate_table) + OBSTACLE_ROWS * len(obstacle_table)
    scene = np.zeros((rows, ROW_SIZE))
    fill_scene(gate_table, obstacle_table, scene)
    return scene


def ground_code(scene: NDArray[np.float64]) -> int:
    """Contact code of the ground: one past the last object."""
    return int(np.count_nonzero(scene[:, S_KIND] == GROUP))


def gate_rows(gate: int) -> slice:
    """Rows of one gate: its header, then its primitives."""
    return slice(GATE_ROWS * gate, GATE_ROWS * (gate + 1))
