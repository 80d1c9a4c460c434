"""The plant of the ``arena`` profile: a Crazyflie 2.1 with its battery and brushed motors.

A motor's steady thrust follows its voltage by the same cubic that the 2026 firmware inverts to
compensate the battery; its speed (the root of its thrust) follows with a first-order lag. The
battery sags with its inner resistance and empties along a line with a knee. The rest is the
rigid body of ``rigid_body.py``, whose rows these rows extend.
"""

from __future__ import annotations

import math

import numpy as np

from crazyarena.sim_backend.firmware.power import FULL_SCALE
from crazyarena.sim_backend.jit import kernel
from crazyarena.sim_backend.physics.competition_step import B_OMEGA, B_QUAT, B_VEL, BODY_SIZE
from crazyarena.sim_backend.physics.geometry import NO_CONTACT
from crazyarena.sim_backend.physics.rigid_body import (
    FULL_PLANT_SIZE,
    P_DRAG,
    arena_plant,
    step,
)

GRAVITY = 9.81

# Body row, after the competition plant's.
AB_ROTOR = BODY_SIZE  # root of the thrust of M1..M4, sqrt(N)
AB_ACCELERATION = BODY_SIZE + 4  # m/s2, specific force, body axes
AB_CHARGE = BODY_SIZE + 7  # A s drawn from the battery so far
AB_VOLTS = BODY_SIZE + 8  # V, at the terminals
AB_CONTACT = BODY_SIZE + 9  # contact code of the last tick
AB_REST = BODY_SIZE + 10  # ticks that the vehicle has lain still
ARENA_BODY_SIZE = BODY_SIZE + 11

# Plant row, after the rigid body's.
AP_DRAG = P_DRAG  # kg/s, body x, y, z
AP_LAG = FULL_PLANT_SIZE  # s, time constant of the rotor speed
AP_STRENGTH = FULL_PLANT_SIZE + 1  # thrust of M1..M4 relative to the nominal one
AP_CAPACITY = FULL_PLANT_SIZE + 5  # A s
AP_RESISTANCE = FULL_PLANT_SIZE + 6  # Ohm
AP_CURRENT = FULL_PLANT_SIZE + 7  # A per N^1.5 of thrust
AP_IDLE_CURRENT = FULL_PLANT_SIZE + 8  # A
ARENA_PLANT_SIZE = FULL_PLANT_SIZE + 9

# Steady thrust (N) of one motor over its voltage, ascending powers: what 2.1+ propellers do, and
# what the firmware's compensation assumes; AP_STRENGTH sets them apart.
_THRUST = (-0.024765379, 0.065237935, -0.026792505, 0.0067767893)

_REST_TICKS = 100.0
_REST_SPEED = 1e-4  # m/s, also sqrt(N) of a rotor
_REST_ARM = 0.06  # m, turns a rate into a speed
_FULL_VOLTS, _KNEE_VOLTS, _EMPTY_VOLTS = 4.2, 3.7, 3.0
_KNEE = 0.85  # share of the charge drawn at the knee


def default_plant() -> np.ndarray:
    """Plant row of a Crazyflie 2.1 with markers, 31.9 g, and a fresh 250 mAh battery."""
    plant = np.zeros(ARENA_PLANT_SIZE)
    plant[:FULL_PLANT_SIZE] = arena_plant()
    plant[AP_LAG] = 0.03
    plant[AP_STRENGTH : AP_STRENGTH + 4] = 1.0
    plant[AP_CAPACITY] = 0.25 * 3600.0
    plant[AP_RESISTANCE] = 0.12
    plant[AP_CURRENT] = 21.0
    plant[AP_IDLE_CURRENT] = 0.1
    return plant


@kernel
def open_circuit_volts(drawn):
    """Battery voltage without load after a share ``drawn`` of its charge."""
    if drawn < _KNEE:
        return _FULL_VOLTS + (_KNEE_VOLTS - _FULL_VOLTS) * drawn / _KNEE
    rest = min((drawn - _KNEE) / (1.0 - _KNEE), 1.0)
    return _KNEE_VOLTS + (_EMPTY_VOLTS - _KNEE_VOLTS) * rest


@kernel
def thrust_of_volts(volts):
    """Steady thrust (N) of one motor."""
    return max(0.0, _THRUST[0] + volts * (_THRUST[1] + volts * (_THRUST[2] + volts * _THRUST[3])))


@kernel
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
    step(body, plant, f4, f3, f2, f1, fx, fy, fz, 0.0, 0.0, 0.0, dt)


@kernel
def is_asleep(body, motors, fx, fy, fz):
    """True for a vehicle that has come to rest on something: nothing moves it until a motor
    turns or a force (N) acts, and a parked fleet then costs next to nothing."""
    return (
        body[AB_REST] >= _REST_TICKS
        and motors[0] + motors[1] + motors[2] + motors[3] == 0.0
        and fx == 0.0
        and fy == 0.0
        and fz == 0.0
    )


@kernel
def note_contact(body, contact):
    """Remember the contact code of a tick and whether the vehicle lay still in it."""
    body[AB_CONTACT] = contact
    moving = _motion(body)
    for i in range(4):
        moving = max(moving, body[AB_ROTOR + i])
    if contact != NO_CONTACT and moving < _REST_SPEED:
        body[AB_REST] += 1.0
    else:
        body[AB_REST] = 0.0


@kernel
def _motion(body):
    moving = 0.0
    for i in range(3):
        moving = max(moving, abs(body[B_VEL + i]), _REST_ARM * abs(body[B_OMEGA + i]))
    return moving


@kernel
def wake_up(body):
    """End the rest of a vehicle that something has set in motion; True if it did."""
    if body[AB_REST] == 0.0 or _motion(body) < _REST_SPEED:
        return False
    body[AB_REST] = 0.0
    return True


@kernel
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
