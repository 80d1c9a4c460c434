"""The plant of the ``arena`` profile: a small quadrotor with its battery and its motors.

A motor's steady thrust follows its voltage by a cubic; the speed of its rotor (the root of that
thrust) follows with a first-order lag, which may differ for speeding up and slowing down. Rotors
carry angular momentum: turning the body against it and changing it both give torques. Close to
the floor they lift more (G. Shi et al., "Neural Lander", ICRA 2019, and before them Cheeseman
and Bennett, 1955: the excess falls with the square of the height). The
battery sags with its inner resistance and empties along a table of open-circuit voltages. The
rest is the rigid body of ``rigid_body.py``, whose rows these rows extend. All numbers are the
vehicle's: ``sim_backend/vehicles``.
"""

from __future__ import annotations

import math

from crazyarena.jit import kernel
from crazyarena.sim_backend.firmware.power import FULL_SCALE
from crazyarena.sim_backend.physics.competition_step import (
    B_OMEGA,
    B_POS,
    B_QUAT,
    B_VEL,
    BODY_SIZE,
)
from crazyarena.sim_backend.physics.geometry import NO_CONTACT
from crazyarena.sim_backend.physics.rigid_body import (
    FULL_PLANT_SIZE,
    P_DRAG,
    step,
)

GRAVITY = 9.81

# Body row, after the competition plant's.
AB_ROTOR = BODY_SIZE  # speed of M1..M4 as the root of their nominal thrust, sqrt(N)
AB_FORCE = BODY_SIZE + 4  # N, thrust of M1..M4
AB_ACCELERATION = BODY_SIZE + 8  # m/s2, specific force, body axes
AB_CHARGE = BODY_SIZE + 11  # A s drawn from the battery so far
AB_VOLTS = BODY_SIZE + 12  # V, at the terminals
AB_CONTACT = BODY_SIZE + 13  # contact code of the last tick
AB_REST = BODY_SIZE + 14  # ticks that the vehicle has lain still
ARENA_BODY_SIZE = BODY_SIZE + 15

# Plant row, after the rigid body's.
OPEN_POINTS = 21  # equal steps of the share drawn, 0 to 1
AP_DRAG = P_DRAG  # kg/s, body x, y, z
AP_LAG_UP = FULL_PLANT_SIZE  # s, time constant of the rotor speed when it rises
AP_LAG_DOWN = FULL_PLANT_SIZE + 1  # s, and when it falls
AP_STRENGTH = FULL_PLANT_SIZE + 2  # thrust of M1..M4 relative to the nominal one
AP_THRUST = FULL_PLANT_SIZE + 6  # nominal thrust (N) over volts: c0 + c1 v + c2 v^2 + c3 v^3
DYING = 0.02  # share of the charge that a cell gives on its way from empty to nothing
AP_CAPACITY = FULL_PLANT_SIZE + 10  # A s
AP_RESISTANCE = FULL_PLANT_SIZE + 11  # Ohm
AP_CURRENT = FULL_PLANT_SIZE + 12  # A per N^1.5 of nominal thrust
AP_IDLE_CURRENT = FULL_PLANT_SIZE + 13  # A
AP_MOMENTUM = FULL_PLANT_SIZE + 14  # kg m2/s, of a rotor per sqrt(N) of its speed
AP_GROUND = FULL_PLANT_SIZE + 15  # m2, thrust grows by this over the squared height of rotors
AP_OPEN = FULL_PLANT_SIZE + 16  # V, without load, at OPEN_POINTS shares drawn
ARENA_PLANT_SIZE = FULL_PLANT_SIZE + 16 + OPEN_POINTS

_ROTOR_HEIGHT = 0.01  # m, above the centre of mass
_LOWEST = 0.0377  # m, of the rotors: below it their thrust grows no more
_REST_TICKS = 100.0
_REST_SPEED = 1e-4  # m/s, also sqrt(N) of a rotor
_REST_ARM = 0.06  # m, turns a rate into a speed


@kernel
def open_circuit_volts(plant, drawn):
    """Battery voltage without load after a share ``drawn`` of its charge; held before 0, and
    dying fast beyond 1, as a lithium cell does."""
    if drawn > 1.0:
        return max(0.0, plant[AP_OPEN + OPEN_POINTS - 1] * (1.0 - (drawn - 1.0) / DYING))
    at = min(max(drawn, 0.0), 1.0) * (OPEN_POINTS - 1.0)
    i = min(int(at), OPEN_POINTS - 2)
    low, high = plant[AP_OPEN + i], plant[AP_OPEN + i + 1]
    return low + (at - i) * (high - low)


@kernel
def thrust_of_volts(plant, volts):
    """Steady nominal thrust (N) of one motor."""
    c0, c1, c2 = plant[AP_THRUST], plant[AP_THRUST + 1], plant[AP_THRUST + 2]
    return max(0.0, c0 + volts * (c1 + volts * (c2 + volts * plant[AP_THRUST + 3])))


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
    up, down = plant[AP_LAG_UP], plant[AP_LAG_DOWN]
    rise = 1.0 - math.exp(-dt / up) if up > 0.0 else 1.0
    fall = rise
    if down != up:
        fall = 1.0 - math.exp(-dt / down) if down > 0.0 else 1.0
    current = plant[AP_IDLE_CURRENT]
    height = max(body[B_POS + 2] + _ROTOR_HEIGHT, _LOWEST)
    cushion = 1.0 + plant[AP_GROUND] / (height * height)
    spin, faster = 0.0, 0.0  # sqrt(N): sum of the speeds about +z, and of their changes
    for i in range(4):
        speed = body[AB_ROTOR + i]
        wanted = math.sqrt(thrust_of_volts(plant, motors[i] / FULL_SCALE * volts)) - speed
        change = (rise if wanted > 0.0 else fall) * wanted
        speed += change
        body[AB_ROTOR + i] = speed
        body[AB_FORCE + i] = plant[AP_STRENGTH + i] * cushion * speed * speed
        # A weak motor draws what a strong one does.
        current += plant[AP_CURRENT] * speed * speed * speed
        sense = 1.0 if i % 2 == 0 else -1.0
        spin += sense * speed
        faster += sense * change
    body[AB_CHARGE] += dt * current
    body[AB_VOLTS] = (
        open_circuit_volts(plant, body[AB_CHARGE] / plant[AP_CAPACITY])
        - plant[AP_RESISTANCE] * current
    )
    # What the rotors' momentum h about z does to the body: -w x h - dh/dt.
    momentum = plant[AP_MOMENTUM]
    tx = -momentum * spin * body[B_OMEGA + 1]
    ty = momentum * spin * body[B_OMEGA]
    tz = -momentum * faster / dt
    f1, f2, f3, f4 = (
        body[AB_FORCE],
        body[AB_FORCE + 1],
        body[AB_FORCE + 2],
        body[AB_FORCE + 3],
    )
    step(body, plant, f4, f3, f2, f1, fx, fy, fz, tx, ty, tz, dt)


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
