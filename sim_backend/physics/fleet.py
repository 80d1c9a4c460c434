"""What vehicles do to each other: contacts and downwash. Rows: one body or plant a vehicle."""

from __future__ import annotations

import math

from crazyarena.sim_backend.jit import kernel
from crazyarena.sim_backend.physics.competition_step import (
    B_OMEGA,
    B_POS,
    B_QUAT,
    B_VEL,
    P_INERTIA,
    P_MASS,
)
from crazyarena.sim_backend.physics.contact import CORRECTION
from crazyarena.sim_backend.physics.geometry import (
    CONTACT_GAP,
    VEHICLE_REACH,
    W_OTHER,
    W_SIMPLEX,
    W_VEHICLE,
    place,
)
from crazyarena.sim_backend.physics.gjk import distance
from crazyarena.sim_backend.physics.scene import (
    MARGIN,
    S_CENTRE,
    S_ROTATION,
    VEHICLE_HALF_LENGTH,
    VEHICLE_RADIUS,
)

# Downwash coefficients of a Crazyflie (Panerati et al. 2021, after Shi et al. 2020).
DOWNWASH_GAIN = 2267.18
DOWNWASH_SLOPE = 0.16  # of the wake's width over the distance below
DOWNWASH_OFFSET = -0.11  # m
PROPELLER_RADIUS = 0.0231348  # m
# The fit has a pole at zero distance and a wake of no width at 0.69 m: it was made further away.
DOWNWASH_NEAREST = 0.5  # m
DOWNWASH_NARROWEST = 0.05  # m


@kernel
def _place(work, row, bodies, i):
    place(
        work,
        row,
        VEHICLE_RADIUS,
        VEHICLE_HALF_LENGTH,
        bodies[i, B_POS],
        bodies[i, B_POS + 1],
        bodies[i, B_POS + 2],
        bodies[i, B_QUAT],
        bodies[i, B_QUAT + 1],
        bodies[i, B_QUAT + 2],
        bodies[i, B_QUAT + 3],
    )


@kernel
def _arm(work, row, px, py, pz, nx, ny, nz):
    """Body-frame r x n of a world point p (from the centre) and a world direction n."""
    cx, cy, cz = py * nz - pz * ny, pz * nx - px * nz, px * ny - py * nx
    r = S_ROTATION
    return (
        work[row, r] * cx + work[row, r + 3] * cy + work[row, r + 6] * cz,
        work[row, r + 1] * cx + work[row, r + 4] * cy + work[row, r + 7] * cz,
        work[row, r + 2] * cx + work[row, r + 5] * cy + work[row, r + 8] * cz,
    )


@kernel
def _separate(bodies, plants, i, j, dt, work):
    """Push two vehicles apart if they are about to meet; True when they touch."""
    _place(work, W_VEHICLE, bodies, i)
    _place(work, W_OTHER, bodies, j)
    d, nx, ny, nz, px, py, pz = distance(work, W_VEHICLE, work, W_OTHER, work, W_SIMPLEX)
    dx = work[W_VEHICLE, S_CENTRE] - work[W_OTHER, S_CENTRE]
    dy = work[W_VEHICLE, S_CENTRE + 1] - work[W_OTHER, S_CENTRE + 1]
    dz = work[W_VEHICLE, S_CENTRE + 2] - work[W_OTHER, S_CENTRE + 2]
    if d <= 0.0:
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        nx, ny, nz = (dx / length, dy / length, dz / length) if length > 1e-9 else (0.0, 0.0, 1.0)
        px, py, pz = -0.5 * dx, -0.5 * dy, -0.5 * dz
    gap = d - 2.0 * MARGIN
    # The other's closest point, from the other's centre.
    qx, qy, qz = px + dx - d * nx, py + dy - d * ny, pz + dz - d * nz
    ax, ay, az = _arm(work, W_VEHICLE, px, py, pz, nx, ny, nz)
    bx, by, bz = _arm(work, W_OTHER, qx, qy, qz, nx, ny, nz)
    approach = (
        (bodies[i, B_VEL] - bodies[j, B_VEL]) * nx
        + (bodies[i, B_VEL + 1] - bodies[j, B_VEL + 1]) * ny
        + (bodies[i, B_VEL + 2] - bodies[j, B_VEL + 2]) * nz
        + bodies[i, B_OMEGA] * ax
        + bodies[i, B_OMEGA + 1] * ay
        + bodies[i, B_OMEGA + 2] * az
        - bodies[j, B_OMEGA] * bx
        - bodies[j, B_OMEGA + 1] * by
        - bodies[j, B_OMEGA + 2] * bz
    )
    allowed = -gap / dt if gap > 0.0 else -CORRECTION * gap / dt
    if approach < allowed:
        compliance = 1.0 / plants[i, P_MASS] + 1.0 / plants[j, P_MASS]
        compliance += ax * ax / plants[i, P_INERTIA] + bx * bx / plants[j, P_INERTIA]
        compliance += ay * ay / plants[i, P_INERTIA + 1] + by * by / plants[j, P_INERTIA + 1]
        compliance += az * az / plants[i, P_INERTIA + 2] + bz * bz / plants[j, P_INERTIA + 2]
        push = (allowed - approach) / compliance
        bodies[i, B_VEL] += push * nx / plants[i, P_MASS]
        bodies[i, B_VEL + 1] += push * ny / plants[i, P_MASS]
        bodies[i, B_VEL + 2] += push * nz / plants[i, P_MASS]
        bodies[i, B_OMEGA] += push * ax / plants[i, P_INERTIA]
        bodies[i, B_OMEGA + 1] += push * ay / plants[i, P_INERTIA + 1]
        bodies[i, B_OMEGA + 2] += push * az / plants[i, P_INERTIA + 2]
        bodies[j, B_VEL] -= push * nx / plants[j, P_MASS]
        bodies[j, B_VEL + 1] -= push * ny / plants[j, P_MASS]
        bodies[j, B_VEL + 2] -= push * nz / plants[j, P_MASS]
        bodies[j, B_OMEGA] -= push * bx / plants[j, P_INERTIA]
        bodies[j, B_OMEGA + 1] -= push * by / plants[j, P_INERTIA + 1]
        bodies[j, B_OMEGA + 2] -= push * bz / plants[j, P_INERTIA + 2]
    return gap < CONTACT_GAP


@kernel
def vehicle_contacts(bodies, plants, dt, partner, work):
    """Keep the vehicles of a fleet from flying through each other.

    Call it after a step of ``dt`` s: it limits the velocities with which the next step begins.
    Contacts are smooth (no friction) and inelastic.

    Parameters
    ----------
    bodies, plants: (n, ...) rows; velocities and rates are changed.
    partner: (n,) receives the lowest index of a vehicle in contact with each, or -1.
    work: workspace of any vehicle.

    Returns
    -------
    Number of pairs in contact.
    """
    n = bodies.shape[0]
    for i in range(n):
        partner[i] = -1
    pairs = 0
    for i in range(n):
        speed = abs(bodies[i, B_VEL]) + abs(bodies[i, B_VEL + 1]) + abs(bodies[i, B_VEL + 2])
        for j in range(i + 1, n):
            dx = bodies[i, B_POS] - bodies[j, B_POS]
            reach = 2.0 * VEHICLE_REACH + CONTACT_GAP + dt * speed
            if abs(dx) > reach + 0.5:
                continue
            reach += dt * (
                abs(bodies[j, B_VEL]) + abs(bodies[j, B_VEL + 1]) + abs(bodies[j, B_VEL + 2])
            )
            dy = bodies[i, B_POS + 1] - bodies[j, B_POS + 1]
            dz = bodies[i, B_POS + 2] - bodies[j, B_POS + 2]
            if dx * dx + dy * dy + dz * dz < reach * reach and _separate(
                bodies, plants, i, j, dt, work
            ):
                pairs += 1
                if partner[i] < 0:
                    partner[i] = j
                if partner[j] < 0:
                    partner[j] = i
    return pairs


@kernel
def downwash(bodies, forces):
    """Add to ``forces`` (n, 3) (N, world) what the wakes of higher vehicles push down with.

    A Gaussian wake whose strength falls with the square of the distance below; held at its value
    at DOWNWASH_NEAREST closer in, where the fit does not reach.
    """
    n = bodies.shape[0]
    for i in range(n):
        for j in range(n):
            below = bodies[j, B_POS + 2] - bodies[i, B_POS + 2]
            if below <= 0.0:
                continue
            dx = bodies[j, B_POS] - bodies[i, B_POS]
            dy = bodies[j, B_POS + 1] - bodies[i, B_POS + 1]
            width = max(DOWNWASH_SLOPE * below + DOWNWASH_OFFSET, DOWNWASH_NARROWEST)
            spread = (dx * dx + dy * dy) / (width * width)
            if spread > 36.0:
                continue
            ratio = PROPELLER_RADIUS / (4.0 * max(below, DOWNWASH_NEAREST))
            forces[i, 2] -= DOWNWASH_GAIN * ratio * ratio * math.exp(-0.5 * spread)
