"""Gates and poles of lsy_drone_racing as solids, and the test whether the drone touches one.

The drone is a box. A gate is a square frame of four bars on a stand; its pose is that of its
opening's centre. A pole is a capsule that hangs from its top. Boxes are told apart by separating
axes (S. Gottschalk, M. C. Lin, D. Manocha, SIGGRAPH 1996); a capsule's distance to a box is convex
along its axis.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from crazyarena.jit import kernel

GATE_OUTSIDE = 0.72  # m
GATE_OPENING = 0.40  # m
GATE_DEPTH = 0.02  # m
STAND = (0.10, 0.10, 1.00)  # m
STAND_BELOW = 0.86  # m, from the opening's centre to that of the stand
POLE_RADIUS = 0.015  # m
POLE_LENGTH = 1.6  # m, without its caps
DRONE_HALF = (0.07, 0.07, 0.02)  # m

# Row of a solid.
SO_CODE = 0  # gate g is g, pole o is n_gates + o
SO_CENTRE = 1
SO_ROTATION = 4  # 9, body to world, row by row
SO_HALF = 13  # m, 3; a capsule: 0, 0, half its length
SO_RADIUS = 16  # m, of a capsule; 0 for a box
SO_REACH = 17  # m, centre to the farthest point
SOLID_SIZE = 18

NO_CONTACT = -1.0
_DRONE_REACH = math.sqrt(sum(half * half for half in DRONE_HALF))
_SEARCH = 40  # halvings by thirds: a capsule's nearest point to 1e-7 of its length


def gate_boxes() -> list[tuple[tuple[float, float, float], tuple[float, float, float]]]:
    """Centre and half sizes (m) of a gate's boxes in its own frame."""
    bar = (GATE_OUTSIDE - GATE_OPENING) / 2.0
    off = (GATE_OUTSIDE - bar) / 2.0
    depth, wide, thin = GATE_DEPTH / 2.0, GATE_OUTSIDE / 2.0, bar / 2.0
    return [
        ((0.0, 0.0, off), (depth, wide, thin)),
        ((0.0, 0.0, -off), (depth, wide, thin)),
        ((0.0, off, 0.0), (depth, thin, wide)),
        ((0.0, -off, 0.0), (depth, thin, wide)),
        ((0.0, 0.0, -STAND_BELOW), (STAND[0] / 2.0, STAND[1] / 2.0, STAND[2] / 2.0)),
    ]


def build_solids(gates: NDArray[np.float64], poles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Solids of gates (n, 7: position, quaternion x, y, z, w) and poles (m, 3: their tops)."""
    rows = []
    for code, gate in enumerate(gates):
        turn = Rotation.from_quat(gate[3:7])
        for centre, half in gate_boxes():
            place = gate[:3] + turn.apply(centre)
            rows.append([code, *place, *turn.as_matrix().ravel(), *half, 0.0, math.hypot(*half)])
    for index, top in enumerate(poles):
        place = top - [0.0, 0.0, POLE_LENGTH / 2.0]
        long = POLE_LENGTH / 2.0
        rows.append(
            [len(gates) + index, *place, *np.eye(3).ravel(), 0.0, 0.0, long, POLE_RADIUS,
             long + POLE_RADIUS]
        )  # fmt: skip
    return np.array(rows, dtype=np.float64).reshape(-1, SOLID_SIZE)


@kernel
def _rotation_entry(x, y, z, w, i, j):
    """Entry of the rotation matrix of a quaternion."""
    if i == 0:
        if j == 0:
            return 1.0 - 2.0 * (y * y + z * z)
        return 2.0 * (x * y - w * z) if j == 1 else 2.0 * (x * z + w * y)
    if i == 1:
        if j == 0:
            return 2.0 * (x * y + w * z)
        return 1.0 - 2.0 * (x * x + z * z) if j == 1 else 2.0 * (y * z - w * x)
    if j == 0:
        return 2.0 * (x * z - w * y)
    return 2.0 * (y * z + w * x) if j == 1 else 1.0 - 2.0 * (x * x + y * y)


@kernel
def place_drone(drone, px, py, pz, qx, qy, qz, qw):
    """Write the drone at a pose into ``drone`` (SOLID_SIZE,)."""
    drone[SO_CENTRE], drone[SO_CENTRE + 1], drone[SO_CENTRE + 2] = px, py, pz
    for i in range(3):
        for j in range(3):
            drone[SO_ROTATION + 3 * i + j] = _rotation_entry(qx, qy, qz, qw, i, j)
        drone[SO_HALF + i] = DRONE_HALF[i]
    drone[SO_REACH] = _DRONE_REACH


@kernel
def _apart(a, b, lx, ly, lz):
    """Whether the projections of two boxes on an axis leave a gap (or touch)."""
    if lx * lx + ly * ly + lz * lz < 1e-12:
        return False
    dx = b[SO_CENTRE] - a[SO_CENTRE]
    dy = b[SO_CENTRE + 1] - a[SO_CENTRE + 1]
    dz = b[SO_CENTRE + 2] - a[SO_CENTRE + 2]
    reach = 0.0
    for k in range(3):
        r = SO_ROTATION + k
        reach += a[SO_HALF + k] * abs(a[r] * lx + a[r + 3] * ly + a[r + 6] * lz)
        reach += b[SO_HALF + k] * abs(b[r] * lx + b[r + 3] * ly + b[r + 6] * lz)
    return abs(dx * lx + dy * ly + dz * lz) >= reach


@kernel
def boxes_overlap(a, b):
    """Whether two boxes interpenetrate."""
    for k in range(3):
        r = SO_ROTATION + k
        if _apart(a, b, a[r], a[r + 3], a[r + 6]) or _apart(a, b, b[r], b[r + 3], b[r + 6]):
            return False
    for i in range(3):
        ax, ay, az = a[SO_ROTATION + i], a[SO_ROTATION + 3 + i], a[SO_ROTATION + 6 + i]
        for j in range(3):
            bx, by, bz = b[SO_ROTATION + j], b[SO_ROTATION + 3 + j], b[SO_ROTATION + 6 + j]
            if _apart(a, b, ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx):
                return False
    return True


@kernel
def _distance2(box, px, py, pz):
    """Squared distance of a point to a box, 0 inside."""
    dx, dy, dz = px - box[SO_CENTRE], py - box[SO_CENTRE + 1], pz - box[SO_CENTRE + 2]
    total = 0.0
    for k in range(3):
        r = SO_ROTATION + k
        out = abs(box[r] * dx + box[r + 3] * dy + box[r + 6] * dz) - box[SO_HALF + k]
        if out > 0.0:
            total += out * out
    return total


@kernel
def capsule_overlaps(box, capsule):
    """Whether a box and an upright capsule interpenetrate."""
    px, py, pz = capsule[SO_CENTRE], capsule[SO_CENTRE + 1], capsule[SO_CENTRE + 2]
    low, high = pz - capsule[SO_HALF + 2], pz + capsule[SO_HALF + 2]
    for _ in range(_SEARCH):
        a, b = low + (high - low) / 3.0, high - (high - low) / 3.0
        if _distance2(box, px, py, a) <= _distance2(box, px, py, b):
            high = b
        else:
            low = a
    near = _distance2(box, px, py, 0.5 * (low + high))
    return near < capsule[SO_RADIUS] * capsule[SO_RADIUS]


@kernel
def touched(solids, drone):
    """Code of the first solid that the drone (see :func:`place_drone`) touches, or NO_CONTACT."""
    for i in range(solids.shape[0]):
        solid = solids[i]
        dx = solid[SO_CENTRE] - drone[SO_CENTRE]
        dy = solid[SO_CENTRE + 1] - drone[SO_CENTRE + 1]
        dz = solid[SO_CENTRE + 2] - drone[SO_CENTRE + 2]
        reach = solid[SO_REACH] + drone[SO_REACH]
        if dx * dx + dy * dy + dz * dz > reach * reach:
            continue
        if solid[SO_RADIUS] > 0.0:
            if dx * dx + dy * dy < 0.04 and capsule_overlaps(drone, solid):
                return solid[SO_CODE]
        elif boxes_overlap(drone, solid):
            return solid[SO_CODE]
    return NO_CONTACT
