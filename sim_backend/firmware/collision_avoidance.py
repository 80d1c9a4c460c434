"""Collision avoidance between vehicles by buffered Voronoi cells.

Each vehicle keeps its setpoint inside the set of points that are nearer to itself than to any
peer, shrunk by an ellipsoid that stands for its downwash, so that peers that do the same never
meet (Zhou, Wang, Bandyopadhyay and Schwager, "Fast, on-line collision avoidance for dynamic
vehicles using buffered Voronoi cells", RA-L 2017). Goals outside the cell are projected into it
by Dykstra's algorithm (Boyle and Dykstra, 1986), with a step to the right to break deadlocks.

Both firmware generations compute the same.
"""

from __future__ import annotations

import math

import numpy as np

from crazyarena.jit import kernel
from crazyarena.sim_backend.firmware.layout import (
    M_X,
    MODE_ABS,
    MODE_VELOCITY,
    SP_POS,
    SP_VEL,
)
from crazyarena.sim_backend.firmware.parameters import Param

PARAMS = (
    Param("colAv.enable", 0, 0, "uint8"),
    Param("colAv.ellipsoidX", 0.3, 0.3),
    Param("colAv.ellipsoidY", 0.3, 0.3),
    Param("colAv.ellipsoidZ", 0.9, 0.9),
    Param("colAv.bboxMinX", -math.inf, -math.inf),
    Param("colAv.bboxMinY", -math.inf, -math.inf),
    Param("colAv.bboxMinZ", -math.inf, -math.inf),
    Param("colAv.bboxMaxX", math.inf, math.inf),
    Param("colAv.bboxMaxY", math.inf, math.inf),
    Param("colAv.bboxMaxZ", math.inf, math.inf),
    Param("colAv.horizon", 1.0, 1.0),
    Param("colAv.maxSpeed", 0.5, 0.5),
    Param("colAv.sidestepThrsh", 0.25, 0.25),
    Param("colAv.maxPeerLocAge", 5000, 5000, "int32"),
    Param("colAv.vorTol", 1e-5, 1e-5),
    Param("colAv.vorIters", 100, 100, "int32"),
)
P_ENABLE = 0
P_ELLIPSOID = 1  # m (3)
P_BOX_MIN = 4  # m (3)
P_BOX_MAX = 7  # m (3)
P_HORIZON = 10  # s
P_MAX_SPEED = 11  # m/s
P_SIDESTEP = 12  # m
P_MAX_AGE = 13  # ms
P_TOLERANCE = 14  # m
P_ITERATIONS = 15

# Memory row of a vehicle: the last feasible setpoint position, m; NaN before the first.
MEMORY_SIZE = 3

# The vehicle's own table of where its peers are.
PEER_ID, PEER_POS, PEER_TIME = 0, 1, 4  # time ms; id 0 is an empty row
PEER_SIZE = 5
MAX_PEERS = 10

# One face of the cell in the scratch rows: a . x <= b, and Dykstra's correction.
_B = 3
_CORRECTION = 4
FACE_SIZE = 7
BOX_FACES = 6


def new_memory() -> np.ndarray:
    """Memory row of a freshly booted vehicle."""
    return np.full(MEMORY_SIZE, math.nan)


def new_scratch(peers: int = MAX_PEERS) -> np.ndarray:
    """Scratch for up to ``peers`` peers; nothing in it lives from call to call."""
    return np.zeros((peers + BOX_FACES, FACE_SIZE))


@kernel
def note_peer(table, peer, x, y, z, now):
    """Remember where a peer (id 1..255) is; the table takes the first ten ids it hears of.

    Parameters
    ----------
    table: ``(MAX_PEERS, PEER_SIZE)``. x, y, z: m, world. now: ms.
    """
    for row in range(table.shape[0]):
        if table[row, PEER_ID] == peer or table[row, PEER_ID] == 0.0:
            table[row, PEER_ID] = peer
            table[row, PEER_POS] = x
            table[row, PEER_POS + 1] = y
            table[row, PEER_POS + 2] = z
            table[row, PEER_TIME] = now
            return


@kernel
def current_peers(table, now, max_age, peers):
    """Copy positions not older than ``max_age`` (ms) into ``peers`` and return their number."""
    count = 0
    for row in range(table.shape[0]):
        if table[row, PEER_ID] != 0.0 and now - table[row, PEER_TIME] <= max_age:
            for k in range(3):
                peers[count, k] = table[row, PEER_POS + k]
            count += 1
    return count


@kernel
def _make_cell(params, px, py, pz, peers, count, faces):
    """Faces of the cell in coordinates relative to the own position; returns their number."""
    rx = params[P_ELLIPSOID]
    ry = params[P_ELLIPSOID + 1]
    rz = params[P_ELLIPSOID + 2]
    for i in range(count):
        dx = (peers[i, 0] - px) / rx
        dy = (peers[i, 1] - py) / ry
        dz = (peers[i, 2] - pz) / rz
        if dx == 0.0 and dy == 0.0 and dz == 0.0:
            dx = 1e-9  # a peer at the own position has no direction: any will do
        n = math.sqrt(dx * dx + dy * dy + dz * dz)
        ax = dx / rx / n
        ay = dy / ry / n
        az = dz / rz / n
        scale = 1.0 / math.sqrt(ax * ax + ay * ay + az * az)
        faces[i, 0] = ax * scale
        faces[i, 1] = ay * scale
        faces[i, 2] = az * scale
        faces[i, _B] = (0.5 * n - 1.0) * scale
    reach = params[P_HORIZON] * params[P_MAX_SPEED]
    for k in range(3):
        own = px if k == 0 else (py if k == 1 else pz)
        for j in range(3):
            faces[count + k, j] = 1.0 if j == k else 0.0
            faces[count + 3 + k, j] = -1.0 if j == k else 0.0
        faces[count + k, _B] = min(reach, params[P_BOX_MAX + k] - own)
        faces[count + 3 + k, _B] = -max(-reach, params[P_BOX_MIN + k] - own)
    return count + BOX_FACES


@kernel
def _inside(faces, rows, x, y, z, tolerance):
    for i in range(rows):
        if faces[i, 0] * x + faces[i, 1] * y + faces[i, 2] * z > faces[i, _B] + tolerance:
            return False
    return True


@kernel
def _ray(faces, rows, x, y, z, vx, vy, vz):
    """Multiple of v at which the ray from (x, y, z) along v meets the first face."""
    nearest = math.inf
    for i in range(rows):
        speed = faces[i, 0] * vx + faces[i, 1] * vy + faces[i, 2] * vz
        if speed > 0.0:
            room = faces[i, _B] - (faces[i, 0] * x + faces[i, 1] * y + faces[i, 2] * z)
            nearest = min(nearest, room / speed)
    return nearest


@kernel
def _project(faces, rows, x, y, z, tolerance, iterations):
    """Nearest point of the cell by cyclic projections with Dykstra's corrections."""
    if _inside(faces, rows, x, y, z, tolerance):
        return x, y, z
    for i in range(rows):
        for k in range(3):
            faces[i, _CORRECTION + k] = 0.0
    enough = rows * tolerance * tolerance / 10.0
    for _ in range(iterations):
        change = 0.0
        for i in range(rows):
            # The point as it would be without what this face did in the last round.
            cx = x + faces[i, _CORRECTION]
            cy = y + faces[i, _CORRECTION + 1]
            cz = z + faces[i, _CORRECTION + 2]
            over = faces[i, 0] * cx + faces[i, 1] * cy + faces[i, 2] * cz - faces[i, _B]
            over = max(over, 0.0)
            x = cx - over * faces[i, 0]
            y = cy - over * faces[i, 1]
            z = cz - over * faces[i, 2]
            for k in range(3):
                correction = over * faces[i, k]
                step = correction - faces[i, _CORRECTION + k]
                change += step * step
                faces[i, _CORRECTION + k] = correction
        if change < enough:
            break
    return x, y, z


@kernel
def _sidestep(params, faces, rows, gx, gy, gz, keep_reachable):
    scale = _ray(faces, rows, 0.0, 0.0, 0.0, gx, gy, gz)
    if scale >= 1.0 and keep_reachable:
        return gx, gy, gz
    wall = scale * math.sqrt(gx * gx + gy * gy + gz * gz)
    threshold = params[P_SIDESTEP]
    x = gx
    y = gy
    if wall <= threshold:
        amount = 1.0 - wall / threshold
        amount *= amount
        x += amount * gy
        y -= amount * gx
    return _project(faces, rows, x, y, gz, params[P_TOLERANCE], int(params[P_ITERATIONS]))


@kernel
def avoid_collisions(params, mem, px, py, pz, peers, count, sp, faces):
    """Change a setpoint so that it stays within the vehicle's buffered Voronoi cell.

    Parameters
    ----------
    params: parameter row (``P_*``); ``colAv.enable`` is the caller's to look at.
    mem: memory row of :func:`new_memory`.
    px, py, pz: own position, m, world.
    peers, count: positions of the others in rows ``0..count-1``, m, world.
    sp: setpoint row; position and velocity (world) change if the x mode is absolute or velocity.
    faces: scratch of :func:`new_scratch` for at least ``count`` peers.
    """
    mode = sp[M_X]
    if mode != MODE_ABS and mode != MODE_VELOCITY:
        return
    rows = _make_cell(params, px, py, pz, peers, count, faces)
    slack = 10.0 * params[P_TOLERANCE]
    vx = sp[SP_VEL]
    vy = sp[SP_VEL + 1]
    vz = sp[SP_VEL + 2]
    if mode == MODE_VELOCITY:
        vx, vy, vz = _safe_velocity(params, faces, rows, vx, vy, vz, slack)
        mem[0] = px
        mem[1] = py
        mem[2] = pz
    else:
        gx = sp[SP_POS] - px
        gy = sp[SP_POS + 1] - py
        gz = sp[SP_POS + 2] - pz
        x, y, z = _sidestep(params, faces, rows, gx, gy, gz, True)
        if not _inside(faces, rows, x, y, z, slack):
            vx = vy = vz = 0.0
            if math.isnan(mem[0]):
                mem[0] = px
                mem[1] = py
                mem[2] = pz
        else:
            moving = vx != 0.0 or vy != 0.0 or vz != 0.0
            if moving and (x != gx or y != gy or z != gz):
                vx = vy = vz = 0.0
            elif moving:
                scale = min(1.0, _ray(faces, rows, gx, gy, gz, vx, vy, vz))
                vx *= scale
                vy *= scale
                vz *= scale
            mem[0] = px + x
            mem[1] = py + y
            mem[2] = pz + z
        for k in range(3):
            sp[SP_POS + k] = mem[k]
    sp[SP_VEL] = vx
    sp[SP_VEL + 1] = vy
    sp[SP_VEL + 2] = vz


@kernel
def _safe_velocity(params, faces, rows, vx, vy, vz, slack):
    if _inside(faces, rows, 0.0, 0.0, 0.0, slack):
        horizon = params[P_HORIZON]
        x, y, z = _sidestep(params, faces, rows, vx * horizon, vy * horizon, vz * horizon, False)
        scale = 1.0 / horizon
    else:
        x, y, z = _project(
            faces, rows, 0.0, 0.0, 0.0, params[P_TOLERANCE], int(params[P_ITERATIONS])
        )
        distance = math.sqrt(x * x + y * y + z * z)
        scale = min(1.0, params[P_MAX_SPEED] / distance) if distance > 0.0 else 1.0
    if not _inside(faces, rows, x, y, z, slack):
        return 0.0, 0.0, 0.0
    return x * scale, y * scale, z * scale
