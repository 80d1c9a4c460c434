"""Contact, visibility and ray tests of one vehicle against a scene.

The vehicle is PyBullet's cylinder: a prism core with a margin, see ``scene.py``. The rules of
contact and of gate passing are those of the competition (competition simulator under
PyBullet 3.2, checked in the tests): Bullet reports a contact when the surfaces are closer than
its contact breaking threshold *and* the axis-aligned boxes around both shapes overlap.

Every kernel takes the pose as scalars (position m, quaternion x, y, z, w) and a ``work`` array
from :func:`make_workspace`, which belongs to one vehicle in one scene.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from crazyarena.jit import kernel
from crazyarena.sim_backend.physics.gjk import SIMPLEX_ROWS, distance, support
from crazyarena.sim_backend.physics.scene import (
    BOX,
    CYLINDER,
    GATE_ROWS,
    GROUP,
    MARGIN,
    ROW_SIZE,
    S_CENTRE,
    S_CODE,
    S_COUNT,
    S_FRAME_UP,
    S_HALF,
    S_KIND,
    S_RADIUS,
    S_ROTATION,
)
from crazyarena.sim_backend.physics.sizes import (
    VEHICLE_HALF_LENGTH,
    VEHICLE_RADIUS,
)

NO_CONTACT = -1
NO_GROUND = -1  # ground code of a world without ground

# Rows of the workspace. Not plain ints: Numba would compile every kernel they are passed to
# once for each literal value.
W_VEHICLE = np.int64(0)  # the vehicle as a shape
W_OTHER = np.int64(1)  # a ray, or another vehicle, as a shape
W_SIMPLEX = np.int64(2)
W_CACHE = W_SIMPLEX + SIMPLEX_ROWS  # where clearance was last computed, and its value
W_LAST_CONTACTS = 4  # column of W_CACHE: how many contacts the last step had
W_CONTACTS = W_CACHE + 1
MAX_CONTACTS = 12
WORK_ROWS = W_CONTACTS + MAX_CONTACTS

# Centre of the vehicle to its farthest surface point.
VEHICLE_REACH = math.hypot(VEHICLE_RADIUS, VEHICLE_HALF_LENGTH) + MARGIN

# Bullet's box around a hull counts the margin twice; so does its bounding sphere, of whose
# radius the contact breaking threshold is 2 %.
_HULL_BOX = VEHICLE_RADIUS + MARGIN
_HULL_BOX_Z = VEHICLE_HALF_LENGTH + MARGIN
CONTACT_GAP = 0.02 * math.sqrt(2 * (_HULL_BOX + MARGIN) ** 2 + (_HULL_BOX_Z + MARGIN) ** 2)

RAY_OFFSETS = (-0.15, -0.10, -0.05, 0.0, 0.05, 0.10, 0.15)  # m, sideways in the gate's plane
RAY_HALF_LENGTH = 0.1875  # m, the rays run upwards
RAY_END = 0.9999  # hits beyond this fraction of the ray do not count
# Bullet's ray cast ends its iteration early and so accepts a little more than the margin
# sideways (1.1 to 1.8 mm from the core), but not at the ray's end. Nothing is hit by a ray that
# starts somewhere within the margin: half of it is the middle of that band.
_RAY_MARGIN = 0.0014


def make_workspace() -> NDArray[np.float64]:
    """Scratch rows of one vehicle, (WORK_ROWS, ROW_SIZE)."""
    work = np.zeros((WORK_ROWS, ROW_SIZE))
    for i in (W_VEHICLE, W_OTHER):
        work[i, S_ROTATION : S_ROTATION + 9] = np.eye(3).ravel()
    forget(work)
    return work


@kernel
def forget(work):
    """Drop what ``work`` remembers; call it after a change of the scene and at every reset."""
    work[W_CACHE, 3] = -1.0
    work[W_CACHE, W_LAST_CONTACTS] = 0.0


@kernel
def place(shapes, i, radius, half_length, px, py, pz, qx, qy, qz, qw):
    """Write a cylinder at a pose into ``shapes[i]``."""
    shapes[i, S_KIND] = CYLINDER
    shapes[i, S_CENTRE], shapes[i, S_CENTRE + 1], shapes[i, S_CENTRE + 2] = px, py, pz
    r = S_ROTATION
    shapes[i, r] = 1.0 - 2.0 * (qy * qy + qz * qz)
    shapes[i, r + 1] = 2.0 * (qx * qy - qw * qz)
    shapes[i, r + 2] = 2.0 * (qx * qz + qw * qy)
    shapes[i, r + 3] = 2.0 * (qx * qy + qw * qz)
    shapes[i, r + 4] = 1.0 - 2.0 * (qx * qx + qz * qz)
    shapes[i, r + 5] = 2.0 * (qy * qz - qw * qx)
    shapes[i, r + 6] = 2.0 * (qx * qz - qw * qy)
    shapes[i, r + 7] = 2.0 * (qy * qz + qw * qx)
    shapes[i, r + 8] = 1.0 - 2.0 * (qx * qx + qy * qy)
    shapes[i, S_HALF], shapes[i, S_HALF + 1], shapes[i, S_HALF + 2] = radius, radius, half_length
    shapes[i, S_RADIUS] = math.sqrt(radius * radius + half_length * half_length) + MARGIN


@kernel
def place_vehicle(work, px, py, pz, qx, qy, qz, qw):
    """Write the vehicle at a pose into the workspace."""
    place(work, W_VEHICLE, VEHICLE_RADIUS, VEHICLE_HALF_LENGTH, px, py, pz, qx, qy, qz, qw)


@kernel
def point_distance(scene, i, px, py, pz):
    """Distance (m) of a point to the surface of a primitive; negative inside."""
    r = S_ROTATION
    dx, dy, dz = px - scene[i, S_CENTRE], py - scene[i, S_CENTRE + 1], pz - scene[i, S_CENTRE + 2]
    lx = scene[i, r] * dx + scene[i, r + 3] * dy + scene[i, r + 6] * dz
    ly = scene[i, r + 1] * dx + scene[i, r + 4] * dy + scene[i, r + 7] * dz
    lz = scene[i, r + 2] * dx + scene[i, r + 5] * dy + scene[i, r + 8] * dz
    ez = abs(lz) - scene[i, S_HALF + 2]
    if scene[i, S_KIND] == BOX:
        ex, ey = abs(lx) - scene[i, S_HALF], abs(ly) - scene[i, S_HALF + 1]
    else:
        ex, ey = math.sqrt(lx * lx + ly * ly) - scene[i, S_HALF], -math.inf
    inside = max(ex, max(ey, ez))
    if inside <= 0.0:
        return inside - MARGIN
    ex, ey, ez = max(ex, 0.0), max(ey, 0.0), max(ez, 0.0)
    return math.sqrt(ex * ex + ey * ey + ez * ez) - MARGIN


@kernel
def clearance(scene, px, py, pz):
    """Lower bound (m) of the distance from a point to any object of the scene."""
    least = math.inf
    i = np.int64(0)
    while i < scene.shape[0]:
        count = int(scene[i, S_COUNT])
        dx, dy = px - scene[i, S_CENTRE], py - scene[i, S_CENTRE + 1]
        dz = pz - scene[i, S_CENTRE + 2]
        reach = scene[i, S_RADIUS] + least
        dd = dx * dx + dy * dy + dz * dz
        if reach > 0.0 and dd < reach * reach:
            bound = math.sqrt(dd) - scene[i, S_RADIUS]
            if bound > 0.05:
                least = bound
            else:
                for j in range(i + 1, i + 1 + count):
                    least = min(least, point_distance(scene, j, px, py, pz))
        i += 1 + count
    return least


@kernel
def still_clear(px, py, pz, reach, work):
    """True when the clearance found last proves that nothing is within ``reach`` (m)."""
    dx = px - work[W_CACHE, 0]
    dy = py - work[W_CACHE, 1]
    dz = pz - work[W_CACHE, 2]
    room = work[W_CACHE, 3] - reach
    return room > 0.0 and dx * dx + dy * dy + dz * dz < room * room


@kernel
def clear_of(scene, px, py, pz, reach, work):
    """True when no object is within ``reach`` (m) of a point; remembers the clearance found.

    Ask :func:`still_clear` first: it is nearly free.
    """
    free = clearance(scene, px, py, pz)
    work[W_CACHE, 0], work[W_CACHE, 1], work[W_CACHE, 2] = px, py, pz
    work[W_CACHE, 3] = free
    return free > reach


@kernel
def ground_gap(work):
    """Distance (m) of the placed vehicle's surface to the ground; negative when it is below."""
    _, _, low = support(work, W_VEHICLE, 0.0, 0.0, -1.0)
    return work[W_VEHICLE, S_CENTRE + 2] + low - MARGIN


@kernel
def gap(scene, i, work):
    """Distance (m) of the placed vehicle to a primitive, surface to surface.

    Exact while the cores are apart; ``-2 * MARGIN`` when they overlap.
    """
    d, _, _, _, _, _, _ = distance(work, W_VEHICLE, scene, i, work, W_SIMPLEX)
    return d - 2.0 * MARGIN


@kernel
def _extent(shapes, i, ux, uy, uz, hx, hy, hz):
    """Half size, along a direction u, of a box of half sizes h turned like shape i."""
    r = S_ROTATION
    return (
        abs(ux * shapes[i, r] + uy * shapes[i, r + 3] + uz * shapes[i, r + 6]) * hx
        + abs(ux * shapes[i, r + 1] + uy * shapes[i, r + 4] + uz * shapes[i, r + 7]) * hy
        + abs(ux * shapes[i, r + 2] + uy * shapes[i, r + 5] + uz * shapes[i, r + 8]) * hz
    )


@kernel
def _vehicle_extent(work, ux, uy, uz):
    """Half size of Bullet's box around the placed vehicle, along an axis of the box."""
    return _extent(work, W_VEHICLE, ux, uy, uz, _HULL_BOX, _HULL_BOX, _HULL_BOX_Z) + MARGIN


@kernel
def boxes_overlap(scene, header, i, work):
    """True when Bullet's boxes around vehicle and primitive overlap.

    Tried along the axes of the object's frame and along those of the world.
    """
    dx = work[W_VEHICLE, S_CENTRE] - scene[i, S_CENTRE]
    dy = work[W_VEHICLE, S_CENTRE + 1] - scene[i, S_CENTRE + 1]
    dz = work[W_VEHICLE, S_CENTRE + 2] - scene[i, S_CENTRE + 2]
    # A box is turned first and gets its margin afterwards, a hull before and after.
    inner = 0.0 if scene[i, S_KIND] == BOX else MARGIN
    hx, hy = scene[i, S_HALF] + inner, scene[i, S_HALF + 1] + inner
    hz = scene[i, S_HALF + 2] + inner
    for axis in range(6):
        if axis < 3:
            r = S_ROTATION + axis
            ux, uy, uz = scene[header, r], scene[header, r + 3], scene[header, r + 6]
        else:
            ux = 1.0 if axis == 3 else 0.0
            uy = 1.0 if axis == 4 else 0.0
            uz = 1.0 if axis == 5 else 0.0
        reach = _extent(scene, i, ux, uy, uz, hx, hy, hz) + MARGIN
        if abs(ux * dx + uy * dy + uz * dz) > reach + _vehicle_extent(work, ux, uy, uz):
            return False
    return True


@kernel
def touches_ground(work):
    """True when Bullet would report a contact of the placed vehicle with the ground."""
    z = work[W_VEHICLE, S_CENTRE + 2]
    if z > VEHICLE_REACH + CONTACT_GAP:
        return False
    return z <= _vehicle_extent(work, 0.0, 0.0, 1.0) and ground_gap(work) < CONTACT_GAP


@kernel
def touches(scene, header, i, work):
    """True when Bullet would report a contact of the placed vehicle with primitive i."""
    x, y = work[W_VEHICLE, S_CENTRE], work[W_VEHICLE, S_CENTRE + 1]
    z = work[W_VEHICLE, S_CENTRE + 2]
    return (
        point_distance(scene, i, x, y, z) < VEHICLE_REACH + CONTACT_GAP
        and boxes_overlap(scene, header, i, work)
        and gap(scene, i, work) < CONTACT_GAP
    )


@kernel
def _search_contact(scene, ground, px, py, pz, qx, qy, qz, qw, work):
    reach = VEHICLE_REACH + CONTACT_GAP
    clear = clear_of(scene, px, py, pz, reach, work)
    if clear and (ground < 0 or pz > reach):
        return NO_CONTACT
    place_vehicle(work, px, py, pz, qx, qy, qz, qw)
    header = np.int64(0)
    for i in range(0 if clear else scene.shape[0]):
        if scene[i, S_KIND] == GROUP:
            header = np.int64(i)
        elif touches(scene, header, i, work):
            return int(scene[i, S_CODE])
    return ground if ground >= 0 and touches_ground(work) else NO_CONTACT


@kernel
def first_contact(scene, ground, px, py, pz, qx, qy, qz, qw, work):
    """Code of the first object in contact, in the order gates, obstacles, ground.

    ``ground`` is the ground's code, :data:`NO_GROUND` without one. Returns NO_CONTACT if none.
    """
    reach = VEHICLE_REACH + CONTACT_GAP
    if (ground < 0 or pz > reach) and still_clear(px, py, pz, reach, work):
        return NO_CONTACT
    return _search_contact(scene, ground, px, py, pz, qx, qy, qz, qw, work)


@kernel
def gate_distance(scene, gate, limit, px, py, pz, qx, qy, qz, qw, work):
    """Surface distance (m) of the vehicle to a gate with its post or base; at most ``limit``.

    Nothing is computed exactly that is certain to lie beyond the limit.
    """
    header = GATE_ROWS * gate
    dx, dy = px - scene[header, S_CENTRE], py - scene[header, S_CENTRE + 1]
    dz = pz - scene[header, S_CENTRE + 2]
    reach = scene[header, S_RADIUS] + VEHICLE_REACH + limit
    if dx * dx + dy * dy + dz * dz >= reach * reach:
        return limit
    placed = False
    least = limit
    for i in range(header + 1, header + GATE_ROWS):
        if point_distance(scene, i, px, py, pz) - VEHICLE_REACH >= least:
            continue
        if not placed:
            place_vehicle(work, px, py, pz, qx, qy, qz, qw)
            placed = True
        least = min(least, gap(scene, i, work))
    return least


@kernel
def within_sphere(scene, header, extra, px, py, pz):
    """True when a point is closer than ``extra`` (m) to an object's bounding sphere."""
    dx, dy = px - scene[header, S_CENTRE], py - scene[header, S_CENTRE + 1]
    dz = pz - scene[header, S_CENTRE + 2]
    reach = scene[header, S_RADIUS] + extra
    return dx * dx + dy * dy + dz * dz < reach * reach


@kernel
def _decide_range(scene, gate, limit, px, py, pz, qx, qy, qz, qw, work):
    header = GATE_ROWS * gate
    doubtful = False
    for i in range(header + 1, header + GATE_ROWS):
        d = point_distance(scene, i, px, py, pz)
        # The facets of a cylinder cut at most 0.3 mm off its surface.
        if d - VEHICLE_HALF_LENGTH + 0.001 < limit:
            return True
        doubtful |= d - VEHICLE_REACH < limit
    if not doubtful:
        return False
    return gate_distance(scene, gate, limit, px, py, pz, qx, qy, qz, qw, work) < limit


@kernel
def gate_in_range(scene, gate, limit, px, py, pz, qx, qy, qz, qw, work):
    """True when the vehicle's surface is closer than ``limit`` (m) to any part of a gate."""
    if not within_sphere(scene, GATE_ROWS * gate, VEHICLE_REACH + limit, px, py, pz):
        return False
    return _decide_range(scene, gate, limit, px, py, pz, qx, qy, qz, qw, work)


@kernel
def _place_ray(scene, gate, offset, work):
    """Write one ray of a gate, up to RAY_END, as a shape; returns its start."""
    header = GATE_ROWS * gate
    r = S_ROTATION
    up = scene[header, S_FRAME_UP]
    x = scene[header, S_CENTRE] + scene[header, r + 2] * up
    y = scene[header, S_CENTRE + 1] + scene[header, r + 5] * up
    z = scene[header, S_CENTRE + 2] + scene[header, r + 8] * up
    # The rays stand upright and spread along the yaw direction, whatever roll and pitch.
    ux, uy = scene[header, r], scene[header, r + 3]
    length = math.sqrt(ux * ux + uy * uy)
    ux, uy = (ux / length, uy / length) if length > 0.0 else (1.0, 0.0)
    # What the wider margin adds at the end is cut off here.
    half = RAY_HALF_LENGTH * RAY_END - 0.5 * (_RAY_MARGIN - MARGIN)
    work[W_OTHER, S_KIND] = BOX
    work[W_OTHER, S_CENTRE] = x + ux * offset
    work[W_OTHER, S_CENTRE + 1] = y + uy * offset
    work[W_OTHER, S_CENTRE + 2] = z - RAY_HALF_LENGTH + half
    for k in range(9):
        work[W_OTHER, r + k] = 1.0 if k % 4 == 0 else 0.0
    work[W_OTHER, S_HALF], work[W_OTHER, S_HALF + 1] = 0.0, 0.0
    work[W_OTHER, S_HALF + 2] = half
    work[W_OTHER, S_RADIUS] = half
    return x + ux * offset, y + uy * offset, z - RAY_HALF_LENGTH


@kernel
def _cast_gate_rays(scene, gate, px, py, pz, qx, qy, qz, qw, work):
    near = VEHICLE_REACH + _RAY_MARGIN
    placed = False
    for offset in RAY_OFFSETS:
        sx, sy, sz = _place_ray(scene, gate, offset, work)
        rise = min(max(pz - sz, 0.0), 2.0 * RAY_HALF_LENGTH)
        ex, ey, ez = px - sx, py - sy, pz - sz - rise
        if ex * ex + ey * ey + ez * ez >= near * near:
            continue
        if not placed:
            place_vehicle(work, px, py, pz, qx, qy, qz, qw)
            placed = True
        if point_distance(work, W_VEHICLE, sx, sy, sz) < -0.5 * MARGIN:
            continue
        d, _, _, _, _, _, _ = distance(work, W_VEHICLE, work, W_OTHER, work, W_SIMPLEX)
        if d <= _RAY_MARGIN:
            return True
    return False


@kernel
def gate_ray_hit(scene, gate, px, py, pz, qx, qy, qz, qw, work):
    """True when one of a gate's seven upward rays hits the vehicle.

    A ray that starts inside the vehicle hits nothing; a hit counts up to RAY_END.
    """
    header = GATE_ROWS * gate
    if not within_sphere(scene, header, VEHICLE_REACH, px, py, pz):
        return False
    r = S_ROTATION
    # Distance to the plane that all rays lie in: upright, along the gate's yaw direction.
    dx, dy = px - scene[header, S_CENTRE], py - scene[header, S_CENTRE + 1]
    lean = abs(scene[header, S_FRAME_UP]) * math.sqrt(
        scene[header, r + 2] * scene[header, r + 2] + scene[header, r + 5] * scene[header, r + 5]
    )
    apart = abs(scene[header, r] * dy - scene[header, r + 3] * dx)
    level = math.sqrt(
        scene[header, r] * scene[header, r] + scene[header, r + 3] * scene[header, r + 3]
    )
    if apart > (VEHICLE_REACH + _RAY_MARGIN + lean) * level and level > 0.0:
        return False
    return _cast_gate_rays(scene, gate, px, py, pz, qx, qy, qz, qw, work)


@kernel
def gate_rays_blocked(scene, gate, work):
    """True when one of a gate's rays hits an object of the scene.

    The competition then counts the gate as passed whatever the vehicle does. Objects do not
    move: once an episode is enough.
    """
    for offset in RAY_OFFSETS:
        sx, sy, sz = _place_ray(scene, gate, offset, work)
        for i in range(scene.shape[0]):
            if scene[i, S_KIND] == GROUP:
                continue
            if point_distance(scene, i, sx, sy, sz) < 0.0:
                continue
            d, _, _, _, _, _, _ = distance(scene, i, work, W_OTHER, work, W_SIMPLEX)
            if d <= _RAY_MARGIN:
                return True
    return False
