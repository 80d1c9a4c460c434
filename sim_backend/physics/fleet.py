"""What vehicles do to each other: contacts and downwash. Rows: one body or plant a vehicle."""

from __future__ import annotations

import math

from crazyarena.jit import kernel
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
)
from crazyarena.sim_backend.physics.sizes import (
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
WAKE_EDGE = 6.0  # in standard deviations: there is nothing beyond

# Change of velocity, m/s, that a vehicle stays below within some hundredths of a second: its own
# thrust makes 0.2 in 10 ms, and no contact leaves it faster than it came by more than this.
SURGE = 10.0


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
def separate(bodies, plants, i, j, dt, work):
    """Push two vehicles apart if they would meet within ``dt`` s; without friction, inelastic.

    Returns
    -------
    gap: m, between their surfaces; below CONTACT_GAP they touch.
    speed: m/s, at which their closest points approached each other before the push.
    pushed: True when it was needed.
    """
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
    pushed = approach < allowed
    if pushed:
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
    return gap, -approach, pushed


@kernel
def may_meet(bodies, i, j, dt):
    """False for two vehicles that cannot touch within ``dt`` s at their present velocities."""
    dx = bodies[i, B_POS] - bodies[j, B_POS]
    dy = bodies[i, B_POS + 1] - bodies[j, B_POS + 1]
    dz = bodies[i, B_POS + 2] - bodies[j, B_POS + 2]
    reach = 2.0 * VEHICLE_REACH + CONTACT_GAP + dt * (_speed(bodies, i) + _speed(bodies, j))
    return dx * dx + dy * dy + dz * dz < reach * reach


@kernel
def _speed(bodies, i):
    """At least the speed of a vehicle, m/s."""
    return abs(bodies[i, B_VEL]) + abs(bodies[i, B_VEL + 1]) + abs(bodies[i, B_VEL + 2])


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
        for j in range(i + 1, n):
            if not may_meet(bodies, i, j, dt):
                continue
            gap, _, _ = separate(bodies, plants, i, j, dt, work)
            if gap < CONTACT_GAP:
                pairs += 1
                if partner[i] < 0:
                    partner[i] = j
                if partner[j] < 0:
                    partner[j] = i
    return pairs


@kernel
def wake_width(below):
    """Standard deviation (m) of a wake ``below`` m under its vehicle."""
    return max(DOWNWASH_SLOPE * below + DOWNWASH_OFFSET, DOWNWASH_NARROWEST)


@kernel
def wake_force(bodies, i, j):
    """What the wake of vehicle ``j``, hovering, pushes vehicle ``i`` down with, N.

    A Gaussian wake whose strength falls with the square of the distance below; held at its value
    at DOWNWASH_NEAREST closer in, where the fit does not reach.
    """
    below = bodies[j, B_POS + 2] - bodies[i, B_POS + 2]
    if below <= 0.0:
        return 0.0
    dx = bodies[j, B_POS] - bodies[i, B_POS]
    dy = bodies[j, B_POS + 1] - bodies[i, B_POS + 1]
    width = wake_width(below)
    spread = (dx * dx + dy * dy) / (width * width)
    if spread > WAKE_EDGE * WAKE_EDGE:
        return 0.0
    ratio = PROPELLER_RADIUS / (4.0 * max(below, DOWNWASH_NEAREST))
    return DOWNWASH_GAIN * ratio * ratio * math.exp(-0.5 * spread)


@kernel
def downwash(bodies, lifts, forces):
    """Add to ``forces`` (n, 3) (N, world) what the wakes of higher vehicles push down with.

    lifts: (n,) thrust of each vehicle over its weight; its wake is that much stronger.
    """
    n = bodies.shape[0]
    for i in range(n):
        for j in range(n):
            forces[i, 2] -= lifts[j] * wake_force(bodies, i, j)


@kernel
def find_near(bodies, span, wakes, near, members):
    """Tell the vehicles that others might act on during the next ``span`` s from the rest.

    The rest can be moved through that time on their own, with the same result. Nothing may
    change a vehicle's velocity by more than SURGE meanwhile.

    Parameters
    ----------
    wakes: True if downwash counts, not only contact.
    near: (n,) receives 1 for such vehicles, else 0.
    members: (n,) their indices, ascending.

    Returns
    -------
    Number of members.
    """
    n = bodies.shape[0]
    for i in range(n):
        near[i] = 0
    for i in range(n):
        speed = _speed(bodies, i)
        for j in range(i + 1, n):
            travel = span * (speed + _speed(bodies, j) + 2.0 * SURGE)
            dx = bodies[i, B_POS] - bodies[j, B_POS]
            dy = bodies[i, B_POS + 1] - bodies[j, B_POS + 1]
            dz = abs(bodies[i, B_POS + 2] - bodies[j, B_POS + 2])
            beside = dx * dx + dy * dy
            reach = 2.0 * VEHICLE_REACH + CONTACT_GAP + travel
            close = beside + dz * dz < reach * reach
            if wakes and not close:
                edge = WAKE_EDGE * wake_width(dz + travel) + travel
                close = beside < edge * edge
            if close:
                near[i], near[j] = 1, 1
    count = 0
    for i in range(n):
        if near[i]:
            members[count] = i
            count += 1
    return count
