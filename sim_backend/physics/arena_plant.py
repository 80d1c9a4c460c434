"""The plant of the ``arena`` profile: a Crazyflie 2.1 with its battery and brushed motors.

A motor's steady thrust follows its voltage by the same cubic that the 2026 firmware inverts to
compensate the battery; its speed (the root of its thrust) follows with a first-order lag.
Rotor drag is linear in the body-frame velocity (Foerster, "System identification of the
Crazyflie 2.0 nano quadrocopter", ETH Zurich 2015, also the inertia). The battery sags with its
inner resistance and empties along a line with a knee.

Rows begin like those of the competition plant, so that contacts and traces work on both.
"""

from __future__ import annotations

import math

import numpy as np

from crazyarena.sim_backend.firmware.power import (
    ARM_LENGTH,
    FULL_SCALE,
    THRUST_TO_TORQUE,
)
from crazyarena.sim_backend.jit import kernel
from crazyarena.sim_backend.physics.competition_step import (
    B_OMEGA,
    B_QUAT,
    B_VEL,
    BODY_SIZE,
    P_INERTIA,
    P_MASS,
    PLANT_SIZE,
)
from crazyarena.sim_backend.physics.contact import advance_pose

GRAVITY = 9.81

# Body row, after the competition plant's.
AB_ROTOR = BODY_SIZE  # root of the thrust of M1..M4, sqrt(N)
AB_ACCELERATION = BODY_SIZE + 4  # m/s2, specific force, body axes
AB_CHARGE = BODY_SIZE + 7  # A s drawn from the battery so far
AB_VOLTS = BODY_SIZE + 8  # V, at the terminals
ARENA_BODY_SIZE = BODY_SIZE + 9

# Plant row, after the competition plant's.
AP_DRAG = PLANT_SIZE  # kg/s, body x, y, z
AP_LAG = PLANT_SIZE + 3  # s, time constant of the rotor speed
AP_STRENGTH = PLANT_SIZE + 4  # thrust of M1..M4 relative to the nominal one
AP_CAPACITY = PLANT_SIZE + 8  # A s
AP_RESISTANCE = PLANT_SIZE + 9  # Ohm
AP_CURRENT = PLANT_SIZE + 10  # A per N^1.5 of thrust
AP_IDLE_CURRENT = PLANT_SIZE + 11  # A
ARENA_PLANT_SIZE = PLANT_SIZE + 12

# Steady thrust (N) of one motor over its voltage, ascending powers: what 2.1+ propellers do, and
# what the firmware's compensation assumes; AP_STRENGTH sets them apart.
_THRUST = (-0.024765379, 0.065237935, -0.026792505, 0.0067767893)

_FULL_VOLTS, _KNEE_VOLTS, _EMPTY_VOLTS = 4.2, 3.7, 3.0
_KNEE = 0.85  # share of the charge drawn at the knee


def default_plant() -> np.ndarray:
    """Plant row of a Crazyflie 2.1 with markers, 31.9 g, and a fresh 250 mAh battery."""
    plant = np.zeros(ARENA_PLANT_SIZE)
    plant[P_MASS] = 0.0319
    plant[P_INERTIA : P_INERTIA + 3] = 16.57e-6, 16.66e-6, 29.26e-6
    plant[AP_DRAG : AP_DRAG + 3] = 0.0065, 0.0065, 0.0073
    plant[AP_LAG] = 0.03
    plant[AP_STRENGTH : AP_STRENGTH + 4] = 1.0
    plant[AP_CAPACITY] = 0.25 * 3600.0
    plant[AP_RESISTANCE] = 0.12
    plant[AP_CURRENT] = 21.0
    plant[AP_IDLE_CURRENT] = 0.1
    return plant


@kernel(_nrt=False)
def open_circuit_volts(drawn):
    """Battery voltage without load after a share ``drawn`` of its charge."""
    if drawn < _KNEE:
        return _FULL_VOLTS + (_KNEE_VOLTS - _FULL_VOLTS) * drawn / _KNEE
    rest = min((drawn - _KNEE) / (1.0 - _KNEE), 1.0)
    return _KNEE_VOLTS + (_EMPTY_VOLTS - _KNEE_VOLTS) * rest


@kernel(_nrt=False)
def thrust_of_volts(volts):
    """Steady thrust (N) of one motor."""
    return max(0.0, _THRUST[0] + volts * (_THRUST[1] + volts * (_THRUST[2] + volts * _THRUST[3])))


@kernel(_nrt=False)
def arena_step(body, plant, motors, fx, fy, fz, dt):
    """Advance one vehicle by ``dt`` s, without contacts.

    Parameters
    ----------
    body, plant: rows of ARENA_BODY_SIZE and ARENA_PLANT_SIZE.
    motors: commands of M1..M4, 0..65535.
    fx, fy, fz: N, world, a disturbance force at the centre of mass.
    """
    volts = body[AB_VOLTS]
    follow = 1.0 - math.exp(-dt / plant[AP_LAG]) if plant[AP_LAG] > 0.0 else 1.0
    current = plant[AP_IDLE_CURRENT]
    for i in range(4):
        target = plant[AP_STRENGTH + i] * thrust_of_volts(motors[i] / FULL_SCALE * volts)
        speed = body[AB_ROTOR + i]
        speed += follow * (math.sqrt(target) - speed)
        body[AB_ROTOR + i] = speed
        current += plant[AP_CURRENT] * speed * speed * speed
    body[AB_CHARGE] += dt * current
    body[AB_VOLTS] = (
        open_circuit_volts(body[AB_CHARGE] / plant[AP_CAPACITY]) - plant[AP_RESISTANCE] * current
    )

    f1 = body[AB_ROTOR] * body[AB_ROTOR]
    f2 = body[AB_ROTOR + 1] * body[AB_ROTOR + 1]
    f3 = body[AB_ROTOR + 2] * body[AB_ROTOR + 2]
    f4 = body[AB_ROTOR + 3] * body[AB_ROTOR + 3]
    torque_x = ARM_LENGTH * (f3 + f4 - f1 - f2)
    torque_y = ARM_LENGTH * (f2 + f3 - f1 - f4)
    torque_z = THRUST_TO_TORQUE * (f2 + f4 - f1 - f3)
    jx, jy, jz = plant[P_INERTIA], plant[P_INERTIA + 1], plant[P_INERTIA + 2]
    p, q, r = body[B_OMEGA], body[B_OMEGA + 1], body[B_OMEGA + 2]
    body[B_OMEGA] += dt * (torque_x - (jz - jy) * q * r) / jx
    body[B_OMEGA + 1] += dt * (torque_y - (jx - jz) * r * p) / jy
    body[B_OMEGA + 2] += dt * (torque_z - (jy - jx) * p * q) / jz

    x, y, z, w = body[B_QUAT], body[B_QUAT + 1], body[B_QUAT + 2], body[B_QUAT + 3]
    r00, r01, r02 = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)
    r10, r11, r12 = 2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)
    r20, r21, r22 = 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)
    vx, vy, vz = body[B_VEL], body[B_VEL + 1], body[B_VEL + 2]
    bx = -plant[AP_DRAG] * (r00 * vx + r10 * vy + r20 * vz)
    by = -plant[AP_DRAG + 1] * (r01 * vx + r11 * vy + r21 * vz)
    bz = f1 + f2 + f3 + f4 - plant[AP_DRAG + 2] * (r02 * vx + r12 * vy + r22 * vz)
    scale = dt / plant[P_MASS]
    body[B_VEL] += scale * (fx + r00 * bx + r01 * by + r02 * bz)
    body[B_VEL + 1] += scale * (fy + r10 * bx + r11 * by + r12 * bz)
    body[B_VEL + 2] += scale * (fz + r20 * bx + r21 * by + r22 * bz) - dt * GRAVITY
    advance_pose(body, dt)


@kernel(_nrt=False)
def note_acceleration(body, vx, vy, vz, dt):
    """Write AB_ACCELERATION from the velocity (m/s, world) ``dt`` s ago, contacts included."""
    ax = (body[B_VEL] - vx) / dt
    ay = (body[B_VEL + 1] - vy) / dt
    az = (body[B_VEL + 2] - vz) / dt + GRAVITY
    x, y, z, w = body[B_QUAT], body[B_QUAT + 1], body[B_QUAT + 2], body[B_QUAT + 3]
    body[AB_ACCELERATION] = (
        (1.0 - 2.0 * (y * y + z * z)) * ax + 2.0 * (x * y + w * z) * ay + 2.0 * (x * z - w * y) * az
    )
    body[AB_ACCELERATION + 1] = (
        2.0 * (x * y - w * z) * ax + (1.0 - 2.0 * (x * x + z * z)) * ay + 2.0 * (y * z + w * x) * az
    )
    body[AB_ACCELERATION + 2] = (
        2.0 * (x * z + w * y) * ax + 2.0 * (y * z - w * x) * ay + (1.0 - 2.0 * (x * x + y * y)) * az
    )
