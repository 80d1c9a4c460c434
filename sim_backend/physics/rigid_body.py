"""Free flight of a quadrotor under four rotor forces, for any plant and step size.

Newton-Euler equations of a rigid body with rotors fixed to it and linear rotor drag (Förster,
*System Identification of the Crazyflie 2.0 Nano Quadrocopter*, ETH Zurich 2015), integrated by
semi-implicit Euler: velocities first, then pose with the new velocities. Body rows are those of
``competition_step.py`` up to and including the rates; plant rows extend its plant rows.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from crazyarena.jit import kernel
from crazyarena.sim_backend.physics.competition_step import (
    B_OMEGA,
    B_QUAT,
    B_VEL,
    GRAVITY,
    KF,
    KM,
    P_INERTIA,
    P_MASS,
    PLANT_SIZE,
    ROTOR_OFFSET,
    advance_pose,
)

P_GRAVITY = PLANT_SIZE  # m/s2
P_ROTOR_X = PLANT_SIZE + 1  # m, rotors at (+-x, +-y) in the body frame
P_ROTOR_Y = PLANT_SIZE + 2
P_YAW = PLANT_SIZE + 3  # N m of yaw torque per N of rotor force
P_DRAG = PLANT_SIZE + 4  # N per m/s, along the three body axes
FULL_PLANT_SIZE = PLANT_SIZE + 7


def competition_plant() -> NDArray[np.float64]:
    """Nominal plant of the IROS 2022 competition."""
    return plant_row(
        0.03454,
        (1.4e-5, 1.4e-5, 2.17e-5),
        GRAVITY,
        (ROTOR_OFFSET, ROTOR_OFFSET),
        KM / KF,
        (0.0, 0.0, 0.0),
    )


def plant_row(
    mass: float,
    inertia: Sequence[float],
    gravity: float,
    arm: Sequence[float],
    yaw: float,
    drag: Sequence[float],
) -> NDArray[np.float64]:
    """Plant row: mass kg, inertia (3,) kg m^2, gravity m/s2, arm (2,) m of the rotors along x and
    y, yaw torque N m per N of thrust, drag (3,) N per m/s in body axes."""
    row = np.zeros(FULL_PLANT_SIZE)
    row[P_MASS] = mass
    row[P_INERTIA : P_INERTIA + 3] = inertia
    row[P_GRAVITY], row[P_YAW] = gravity, yaw
    row[P_ROTOR_X], row[P_ROTOR_Y] = arm
    row[P_DRAG : P_DRAG + 3] = drag
    return row


@kernel
def advance_velocity(body, plant, f0, f1, f2, f3, fx, fy, fz, tx, ty, tz, dt):
    """Advance velocity and rates by ``dt`` s.

    f0..f3: rotor forces (N): front-left, back-left, back-right, front-right. (fx, fy, fz):
    other force at the centre of mass, N, world frame. (tx, ty, tz): other torque, N m, body
    frame.
    """
    x, y, z, w = body[B_QUAT], body[B_QUAT + 1], body[B_QUAT + 2], body[B_QUAT + 3]
    r00, r01 = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z)
    r10, r11 = 2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z)
    r20, r21 = 2.0 * (x * z - w * y), 2.0 * (y * z + w * x)
    r02, r12 = 2.0 * (x * z + w * y), 2.0 * (y * z - w * x)
    r22 = 1.0 - 2.0 * (x * x + y * y)
    vx, vy, vz = body[B_VEL], body[B_VEL + 1], body[B_VEL + 2]
    # Forces in the body frame: drag and thrust.
    bx = -plant[P_DRAG] * (r00 * vx + r10 * vy + r20 * vz)
    by = -plant[P_DRAG + 1] * (r01 * vx + r11 * vy + r21 * vz)
    bz = f0 + f1 + f2 + f3 - plant[P_DRAG + 2] * (r02 * vx + r12 * vy + r22 * vz)
    scale = dt / plant[P_MASS]
    body[B_VEL] = vx + scale * (r00 * bx + r01 * by + r02 * bz + fx)
    body[B_VEL + 1] = vy + scale * (r10 * bx + r11 * by + r12 * bz + fy)
    body[B_VEL + 2] = vz + scale * (r20 * bx + r21 * by + r22 * bz + fz) - dt * plant[P_GRAVITY]
    tx += plant[P_ROTOR_Y] * (f0 + f1 - f2 - f3)
    ty -= plant[P_ROTOR_X] * (f0 - f1 - f2 + f3)
    tz += plant[P_YAW] * (f0 - f1 + f2 - f3)
    jx, jy, jz = plant[P_INERTIA], plant[P_INERTIA + 1], plant[P_INERTIA + 2]
    p, q, r = body[B_OMEGA], body[B_OMEGA + 1], body[B_OMEGA + 2]
    body[B_OMEGA] = p + dt * (tx - (jz - jy) * q * r) / jx
    body[B_OMEGA + 1] = q + dt * (ty - (jx - jz) * r * p) / jy
    body[B_OMEGA + 2] = r + dt * (tz - (jy - jx) * p * q) / jz


@kernel
def step(body, plant, f0, f1, f2, f3, fx, fy, fz, tx, ty, tz, dt):
    """Advance a body by ``dt`` s of free flight; arguments of :func:`advance_velocity`.

    Follow it with ``contact.resolve`` in a world with surfaces.
    """
    advance_velocity(body, plant, f0, f1, f2, f3, fx, fy, fz, tx, ty, tz, dt)
    advance_pose(body, dt)
