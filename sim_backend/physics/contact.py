"""Contact response: what keeps a vehicle on the ground and out of gates and obstacles.

:func:`resolve` runs after any plant step. Away from everything it costs a distance check. Near
a surface it takes the step's pose change back, finds the contact points, solves for impulses
with projected Gauss-Seidel (Catto 2005; no restitution, Coulomb friction cone), and advances
the pose again with the corrected velocities. Contacts are speculative: a point may approach a
surface no faster than its gap allows in one step, so that nothing flies through a beam.
"""

from __future__ import annotations

import math

import numpy as np

from crazyarena.jit import kernel
from crazyarena.sim_backend.physics.competition_step import (
    B_OMEGA,
    B_POS,
    B_QUAT,
    B_VEL,
    P_INERTIA,
    P_MASS,
    advance_pose,
)
from crazyarena.sim_backend.physics.geometry import (
    CONTACT_GAP,
    MAX_CONTACTS,
    NO_CONTACT,
    VEHICLE_REACH,
    W_CACHE,
    W_CONTACTS,
    W_LAST_CONTACTS,
    W_SIMPLEX,
    W_VEHICLE,
    boxes_overlap,
    clear_of,
    place_vehicle,
    point_distance,
    still_clear,
    touches_ground,
)
from crazyarena.sim_backend.physics.gjk import distance
from crazyarena.sim_backend.physics.scene import (
    GROUP,
    MARGIN,
    S_CENTRE,
    S_CODE,
    S_HALF,
    S_KIND,
    S_ROTATION,
)
from crazyarena.sim_backend.physics.sizes import (
    VEHICLE_HALF_LENGTH,
    VEHICLE_RADIUS,
)

FRICTION_GROUND = 0.5  # PyBullet: product of the plane's 1.0 and the vehicle's 0.5
FRICTION_OBJECT = 0.25  # 0.5 each
CORRECTION = 0.08  # share of a penetration undone per step, Bullet's contact ERP
ITERATIONS = 20
SETTLED = 1e-6  # m/s; the iteration ends when it changes velocities by less

# Columns of one contact row, in the body frame.
_N = 0  # unit normal, into the vehicle
_R = 3  # m, contact point from the centre of mass
_GAP = 6  # m, surface to surface
_MU = 7
_T = 8  # first tangent
_IMPULSE = 11  # N s: normal, tangents
_MASS = 14  # kg, effective, along the normal and the tangents

# Sine of the tilt to a face below which the vehicle counts as lying flat on it.
_FLAT = 0.005
# The vehicle shrunk by this much is used once the whole one overlaps an object.
_SHRINK = 0.011


@kernel
def _inverse_mass(plant, rx, ry, rz, dx, dy, dz):
    """Velocity along d at point r per unit of impulse along d (body frame)."""
    ax, ay, az = ry * dz - rz * dy, rz * dx - rx * dz, rx * dy - ry * dx
    return (
        1.0 / plant[P_MASS]
        + ax * ax / plant[P_INERTIA]
        + ay * ay / plant[P_INERTIA + 1]
        + az * az / plant[P_INERTIA + 2]
    )


@kernel
def _add(work, plant, count, nx, ny, nz, rx, ry, rz, gap, mu):
    """Append a contact given in the body frame; returns the new number of contacts."""
    if count >= MAX_CONTACTS:
        return count
    i = W_CONTACTS + count
    work[i, _N], work[i, _N + 1], work[i, _N + 2] = nx, ny, nz
    work[i, _R], work[i, _R + 1], work[i, _R + 2] = rx, ry, rz
    work[i, _GAP], work[i, _MU] = gap, mu
    # Any tangent: cross with the axis the normal is least along.
    ax, ay, az = abs(nx), abs(ny), abs(nz)
    if ax <= ay and ax <= az:
        tx, ty, tz = 0.0, nz, -ny
    elif ay <= az:
        tx, ty, tz = -nz, 0.0, nx
    else:
        tx, ty, tz = ny, -nx, 0.0
    scale = 1.0 / math.sqrt(tx * tx + ty * ty + tz * tz)
    tx, ty, tz = tx * scale, ty * scale, tz * scale
    work[i, _T], work[i, _T + 1], work[i, _T + 2] = tx, ty, tz
    ux, uy, uz = ny * tz - nz * ty, nz * tx - nx * tz, nx * ty - ny * tx
    work[i, _MASS] = 1.0 / _inverse_mass(plant, rx, ry, rz, nx, ny, nz)
    work[i, _MASS + 1] = 1.0 / _inverse_mass(plant, rx, ry, rz, tx, ty, tz)
    work[i, _MASS + 2] = 1.0 / _inverse_mass(plant, rx, ry, rz, ux, uy, uz)
    return count + 1


@kernel
def _add_face(work, plant, count, nx, ny, nz, level, reach, mu, scene, i):
    """Contacts of the vehicle's rims with a plane n.x = level (world frame).

    With ``i`` >= 0 the plane is only as large as that primitive of the scene.
    """
    v, r = W_VEHICLE, S_ROTATION
    # The plane's normal in the body frame.
    bx = work[v, r] * nx + work[v, r + 3] * ny + work[v, r + 6] * nz
    by = work[v, r + 1] * nx + work[v, r + 4] * ny + work[v, r + 7] * nz
    bz = work[v, r + 2] * nx + work[v, r + 5] * ny + work[v, r + 8] * nz
    cx, cy, cz = work[v, S_CENTRE], work[v, S_CENTRE + 1], work[v, S_CENTRE + 2]
    height = nx * cx + ny * cy + nz * cz - level
    flat = math.sqrt(bx * bx + by * by)
    # Lying flat, points fixed to the body let the solver start from the last step's impulses.
    ux, uy = (-bx / flat, -by / flat) if flat > _FLAT else (1.0, 0.0)
    for k in range(5):
        # Four points of the cap that faces the plane, the nearest first, and one of the other.
        turn_x = 1.0 if k == 0 or k == 4 else (-1.0 if k == 2 else 0.0)
        turn_y = 1.0 if k == 1 else (-1.0 if k == 3 else 0.0)
        px = VEHICLE_RADIUS * (turn_x * ux - turn_y * uy)
        py = VEHICLE_RADIUS * (turn_x * uy + turn_y * ux)
        pz = VEHICLE_HALF_LENGTH if (bz < 0.0) != (k == 4) else -VEHICLE_HALF_LENGTH
        gap = height + bx * px + by * py + bz * pz - MARGIN
        if gap > reach:
            continue
        if i >= 0:
            wx = cx + work[v, r] * px + work[v, r + 1] * py + work[v, r + 2] * pz
            wy = cy + work[v, r + 3] * px + work[v, r + 4] * py + work[v, r + 5] * pz
            wz = cz + work[v, r + 6] * px + work[v, r + 7] * py + work[v, r + 8] * pz
            if abs(point_distance(scene, i, wx, wy, wz) - MARGIN - gap) > 2e-4:
                continue
        # The rounded edge meets the plane MARGIN below the core's corner.
        px, py, pz = px - MARGIN * bx, py - MARGIN * by, pz - MARGIN * bz
        count = _add(work, plant, count, bx, by, bz, px, py, pz, gap, mu)
    return count


@kernel
def _add_primitive(work, plant, count, scene, i, reach):
    """Contacts of the placed vehicle with one primitive; returns their new number and the gap."""
    v, r = W_VEHICLE, S_ROTATION
    margin = 2.0 * MARGIN
    d, nx, ny, nz, px, py, pz = distance(work, v, scene, i, work, W_SIMPLEX)
    if d <= 0.0:
        work[v, S_HALF] = work[v, S_HALF + 1] = VEHICLE_RADIUS - _SHRINK
        work[v, S_HALF + 2] = VEHICLE_HALF_LENGTH - _SHRINK
        margin += _SHRINK
        d, nx, ny, nz, px, py, pz = distance(work, v, scene, i, work, W_SIMPLEX)
        work[v, S_HALF] = work[v, S_HALF + 1] = VEHICLE_RADIUS
        work[v, S_HALF + 2] = VEHICLE_HALF_LENGTH
    if d <= 0.0:
        # Deep inside, as after a bad initial pose: out sideways, away from the primitive's axis.
        nx = work[v, S_CENTRE] - scene[i, S_CENTRE]
        ny = work[v, S_CENTRE + 1] - scene[i, S_CENTRE + 1]
        length = math.sqrt(nx * nx + ny * ny)
        nx, ny, nz = (nx / length, ny / length, 0.0) if length > 1e-9 else (1.0, 0.0, 0.0)
        px, py, pz = 0.0, 0.0, 0.0
    gap = d - margin
    if gap > reach:
        return count, gap
    outer = margin - MARGIN  # of the vehicle
    px, py, pz = px - outer * nx, py - outer * ny, pz - outer * nz
    level = nx * (work[v, S_CENTRE] + px) + ny * (work[v, S_CENTRE + 1] + py)
    level += nz * (work[v, S_CENTRE + 2] + pz) - gap
    before = count
    count = _add_face(work, plant, count, nx, ny, nz, level, reach, FRICTION_OBJECT, scene, i)
    if count > before:
        return count, gap
    bx = work[v, r] * nx + work[v, r + 3] * ny + work[v, r + 6] * nz
    by = work[v, r + 1] * nx + work[v, r + 4] * ny + work[v, r + 7] * nz
    bz = work[v, r + 2] * nx + work[v, r + 5] * ny + work[v, r + 8] * nz
    qx = work[v, r] * px + work[v, r + 3] * py + work[v, r + 6] * pz
    qy = work[v, r + 1] * px + work[v, r + 4] * py + work[v, r + 7] * pz
    qz = work[v, r + 2] * px + work[v, r + 5] * py + work[v, r + 8] * pz
    count = _add(work, plant, count, bx, by, bz, qx, qy, qz, gap, FRICTION_OBJECT)
    return count, gap


@kernel
def _solve(work, plant, count, vx, vy, vz, wx, wy, wz, dt):
    """Velocities (body frame) that keep all contacts apart."""
    inverse = 1.0 / plant[P_MASS]
    jx, jy, jz = plant[P_INERTIA], plant[P_INERTIA + 1], plant[P_INERTIA + 2]
    # The normal impulses of the step before are a good start if the same contacts go on.
    keep = 1.0 if work[W_CACHE, W_LAST_CONTACTS] == count else 0.0
    work[W_CACHE, W_LAST_CONTACTS] = count
    for sweep in range(-1, ITERATIONS):
        change = 0.0
        for c in range(count):
            i = W_CONTACTS + c
            rx, ry, rz = work[i, _R], work[i, _R + 1], work[i, _R + 2]
            nx, ny, nz = work[i, _N], work[i, _N + 1], work[i, _N + 2]
            tx, ty, tz = work[i, _T], work[i, _T + 1], work[i, _T + 2]
            ux, uy, uz = ny * tz - nz * ty, nz * tx - nx * tz, nx * ty - ny * tx
            gap = work[i, _GAP]
            allowed = -gap / dt if gap > 0.0 else -CORRECTION * gap / dt
            if sweep < 0:
                push = keep * work[i, _IMPULSE]
                work[i, _IMPULSE], work[i, _IMPULSE + 1], work[i, _IMPULSE + 2] = push, 0.0, 0.0
                fx, fy, fz = push * nx, push * ny, push * nz
                vx, vy, vz = vx + inverse * fx, vy + inverse * fy, vz + inverse * fz
                wx += (ry * fz - rz * fy) / jx
                wy += (rz * fx - rx * fz) / jy
                wz += (rx * fy - ry * fx) / jz
                continue
            for friction in range(2):
                px, py, pz = vx + wy * rz - wz * ry, vy + wz * rx - wx * rz, vz + wx * ry - wy * rx
                if friction == 0:
                    old = work[i, _IMPULSE]
                    push = (allowed - (px * nx + py * ny + pz * nz)) * work[i, _MASS]
                    push = max(old + push, 0.0) - old
                    work[i, _IMPULSE] = old + push
                    fx, fy, fz = push * nx, push * ny, push * nz
                else:
                    old_t, old_u = work[i, _IMPULSE + 1], work[i, _IMPULSE + 2]
                    new_t = old_t - (px * tx + py * ty + pz * tz) * work[i, _MASS + 1]
                    new_u = old_u - (px * ux + py * uy + pz * uz) * work[i, _MASS + 2]
                    bound = work[i, _MU] * work[i, _IMPULSE]
                    size = math.sqrt(new_t * new_t + new_u * new_u)
                    if size > bound:
                        new_t, new_u = new_t * bound / size, new_u * bound / size
                    work[i, _IMPULSE + 1], work[i, _IMPULSE + 2] = new_t, new_u
                    push_t, push_u = new_t - old_t, new_u - old_u
                    fx, fy = push_t * tx + push_u * ux, push_t * ty + push_u * uy
                    fz = push_t * tz + push_u * uz
                change += abs(fx) + abs(fy) + abs(fz)
                vx, vy, vz = vx + inverse * fx, vy + inverse * fy, vz + inverse * fz
                wx += (ry * fz - rz * fy) / jx
                wy += (rz * fx - rx * fz) / jy
                wz += (rx * fy - ry * fx) / jz
        if sweep >= 0 and change * inverse < SETTLED:
            break
    return vx, vy, vz, wx, wy, wz


@kernel
def _respond(body, plant, scene, ground, dt, reach, work):
    """Contact search and solution at the pose before the step; see :func:`resolve`."""
    advance_pose(body, -dt)
    x, y, z = body[B_POS], body[B_POS + 1], body[B_POS + 2]
    place_vehicle(work, x, y, z, body[B_QUAT], body[B_QUAT + 1], body[B_QUAT + 2], body[B_QUAT + 3])
    touched = NO_CONTACT
    count = np.int64(0)
    header = np.int64(0)
    for i in range(scene.shape[0]):
        if scene[i, S_KIND] == GROUP:
            header = np.int64(i)
        elif point_distance(scene, i, x, y, z) < VEHICLE_REACH + reach:
            count, gap = _add_primitive(work, plant, count, scene, i, reach)
            if touched < 0 and gap < CONTACT_GAP and boxes_overlap(scene, header, i, work):
                touched = int(scene[i, S_CODE])
    if ground >= 0 and z < VEHICLE_REACH + reach:
        count = _add_face(
            work, plant, count, 0.0, 0.0, 1.0, 0.0, reach, FRICTION_GROUND, scene, np.int64(-1)
        )
        if touched < 0 and touches_ground(work):
            touched = ground
    if count == 0:
        work[W_CACHE, W_LAST_CONTACTS] = 0.0
    else:
        v, r = W_VEHICLE, S_ROTATION
        ux, uy, uz = body[B_VEL], body[B_VEL + 1], body[B_VEL + 2]
        vx = work[v, r] * ux + work[v, r + 3] * uy + work[v, r + 6] * uz
        vy = work[v, r + 1] * ux + work[v, r + 4] * uy + work[v, r + 7] * uz
        vz = work[v, r + 2] * ux + work[v, r + 5] * uy + work[v, r + 8] * uz
        wx, wy, wz = body[B_OMEGA], body[B_OMEGA + 1], body[B_OMEGA + 2]
        vx, vy, vz, wx, wy, wz = _solve(work, plant, count, vx, vy, vz, wx, wy, wz, dt)
        body[B_VEL] = work[v, r] * vx + work[v, r + 1] * vy + work[v, r + 2] * vz
        body[B_VEL + 1] = work[v, r + 3] * vx + work[v, r + 4] * vy + work[v, r + 5] * vz
        body[B_VEL + 2] = work[v, r + 6] * vx + work[v, r + 7] * vy + work[v, r + 8] * vz
        body[B_OMEGA], body[B_OMEGA + 1], body[B_OMEGA + 2] = wx, wy, wz
    advance_pose(body, dt)
    return touched


@kernel
def resolve(body, plant, scene, ground, dt, work):
    """Correct a plant step of ``dt`` s for contacts with the scene and the ground.

    Call it after the step has advanced velocities and then pose (semi-implicit Euler, attitude
    by the exponential of the new rates). Velocity and pose of ``body`` are changed only near a
    surface.

    Returns
    -------
    Contact code of the step, or NO_CONTACT. As in Bullet, it belongs to the pose *before* the
    step: contacts are found first, velocities solved and the pose advanced afterwards.
    """
    speed_x, speed_y, speed_z = body[B_VEL], body[B_VEL + 1], body[B_VEL + 2]
    speed = abs(speed_x) + abs(speed_y) + abs(speed_z)
    spin = abs(body[B_OMEGA]) + abs(body[B_OMEGA + 1]) + abs(body[B_OMEGA + 2])
    # Everything the step could have met, seen from its end.
    reach = CONTACT_GAP + dt * (speed + VEHICLE_REACH * spin)
    sphere = VEHICLE_REACH + reach + dt * speed
    x, y, z = body[B_POS], body[B_POS + 1], body[B_POS + 2]
    if ground < 0 or z >= sphere:
        work[W_CACHE, W_LAST_CONTACTS] = 0.0
        if still_clear(x, y, z, sphere, work):
            return NO_CONTACT
        if clear_of(scene, x, y, z, sphere, work):
            return NO_CONTACT
    return _respond(body, plant, scene, ground, dt, reach, work)
