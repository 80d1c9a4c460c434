"""First-principles plant of lsy_drone_racing's simulation: one row a vehicle, float64.

Newton-Euler equations of a rigid body with four rotors whose speeds lag behind their commands,
quadratic thrust and torque curves, linear drag along the body's axes and the rotors' gyroscopic
torque, after C. D. McKinnon and A. P. Schoellig, "Estimating and reacting to forces and torques
resulting from common aerodynamic disturbances acting on quadrotors", RAS 2020. Explicit Euler, as
published, with its signs as published (the gyroscopic torque about y has that of x).
"""

from __future__ import annotations

import math

import numpy as np

from crazyarena.jit import kernel

# State row.
SS_POS = 0  # m, world
SS_VEL = 3  # m/s, world
SS_QUAT = 6  # x, y, z, w
SS_RATE = 10  # rad/s, body
SS_ROTOR = 13  # rpm, four rotors
PLANT_STATE_SIZE = 17

# Parameter row.
PP_MASS = 0
PP_ARM = 1
PP_THRUST = 2  # N over rpm, 3 coefficients
PP_TORQUE = 5  # N m over rpm, 3 coefficients
PP_LAG = 8  # speeding up 2, slowing down 2
PP_PROP = 12  # kg m^2
PP_DRAG = 13  # 3, negative
PP_INERTIA = 16  # 9, row by row
PP_INVERSE = 25  # 9
PLANT_PARAM_SIZE = 34

_GRAVITY = 9.81
_FLOOR = -0.001  # m
_RPM = 2.0 * math.pi / 60.0


@kernel
def plant_step(state, par, command, force, dt):
    """Advance by ``dt`` s.

    Parameters
    ----------
    state, par: rows as above; command: (4,) rpm asked of the rotors; force: (3,) N, world.
    """
    qx, qy, qz, qw = state[SS_QUAT], state[SS_QUAT + 1], state[SS_QUAT + 2], state[SS_QUAT + 3]
    r00, r01, r02 = (
        1.0 - 2.0 * (qy * qy + qz * qz), 2.0 * (qx * qy - qw * qz), 2.0 * (qx * qz + qw * qy)
    )  # fmt: skip
    r10, r11, r12 = (
        2.0 * (qx * qy + qw * qz), 1.0 - 2.0 * (qx * qx + qz * qz), 2.0 * (qy * qz - qw * qx)
    )  # fmt: skip
    r20, r21, r22 = (
        2.0 * (qx * qz - qw * qy), 2.0 * (qy * qz + qw * qx), 1.0 - 2.0 * (qx * qx + qy * qy)
    )  # fmt: skip
    p, q, r = state[SS_RATE], state[SS_RATE + 1], state[SS_RATE + 2]
    thrust, roll, pitch, yaw, spin = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(4):
        rpm = state[SS_ROTOR + i]
        want = command[i]
        up = PP_LAG if want > rpm else PP_LAG + 2
        change = par[up] * (want - rpm) + par[up + 1] * (want * want - rpm * rpm)
        lift = par[PP_THRUST] + rpm * (par[PP_THRUST + 1] + rpm * par[PP_THRUST + 2])
        twist = par[PP_TORQUE] + rpm * (par[PP_TORQUE + 1] + rpm * par[PP_TORQUE + 2])
        sx = -1.0 if i < 2 else 1.0
        sy = 1.0 if i == 1 or i == 2 else -1.0
        sz = -1.0 if i == 0 or i == 2 else 1.0
        thrust += lift
        roll += sx * lift
        pitch += sy * lift
        yaw += sz * (twist + par[PP_PROP] * _RPM * change)
        spin += sz * rpm
        state[SS_ROTOR + i] = rpm + dt * change
    spin *= par[PP_PROP] * _RPM
    tx = par[PP_ARM] * roll - q * spin
    ty = par[PP_ARM] * pitch - p * spin
    tz = yaw
    j = par[PP_INERTIA:PP_INVERSE]
    hx = j[0] * p + j[1] * q + j[2] * r
    hy = j[3] * p + j[4] * q + j[5] * r
    hz = j[6] * p + j[7] * q + j[8] * r
    tx -= q * hz - r * hy
    ty -= r * hx - p * hz
    tz -= p * hy - q * hx
    k = par[PP_INVERSE:PLANT_PARAM_SIZE]
    dp = k[0] * tx + k[1] * ty + k[2] * tz
    dq = k[3] * tx + k[4] * ty + k[5] * tz
    dr = k[6] * tx + k[7] * ty + k[8] * tz

    vx, vy, vz = state[SS_VEL], state[SS_VEL + 1], state[SS_VEL + 2]
    bx = par[PP_DRAG] * (r00 * vx + r10 * vy + r20 * vz)
    by = par[PP_DRAG + 1] * (r01 * vx + r11 * vy + r21 * vz)
    bz = par[PP_DRAG + 2] * (r02 * vx + r12 * vy + r22 * vz) + thrust
    scale = dt / par[PP_MASS]
    state[SS_POS] += dt * vx
    state[SS_POS + 1] += dt * vy
    state[SS_POS + 2] += dt * vz
    state[SS_VEL] = vx + scale * (r00 * bx + r01 * by + r02 * bz + force[0])
    state[SS_VEL + 1] = vy + scale * (r10 * bx + r11 * by + r12 * bz + force[1])
    state[SS_VEL + 2] = vz + scale * (r20 * bx + r21 * by + r22 * bz + force[2]) - dt * _GRAVITY
    state[SS_RATE] = p + dt * dp
    state[SS_RATE + 1] = q + dt * dq
    state[SS_RATE + 2] = r + dt * dr
    _turn(state, p * dt, q * dt, r * dt)
    # The floor holds the drone where it is: 1 mm below, so that a sign tells of it.
    if state[SS_POS + 2] < _FLOOR:
        state[SS_POS + 2] = _FLOOR
        for i in range(3):
            state[SS_VEL + i] = 0.0


@kernel
def _turn(state, ax, ay, az):
    """Turn the attitude by a rotation vector, rad, body axes."""
    angle = math.sqrt(ax * ax + ay * ay + az * az)
    s = 0.5 if angle < 1e-9 else math.sin(0.5 * angle) / angle
    bx, by, bz, bw = ax * s, ay * s, az * s, math.cos(0.5 * angle)
    x, y, z, w = state[SS_QUAT], state[SS_QUAT + 1], state[SS_QUAT + 2], state[SS_QUAT + 3]
    nx = w * bx + x * bw + y * bz - z * by
    ny = w * by - x * bz + y * bw + z * bx
    nz = w * bz + x * by - y * bx + z * bw
    nw = w * bw - x * bx - y * by - z * bz
    inv = 1.0 / math.sqrt(nx * nx + ny * ny + nz * nz + nw * nw)
    state[SS_QUAT], state[SS_QUAT + 1] = nx * inv, ny * inv
    state[SS_QUAT + 2], state[SS_QUAT + 3] = nz * inv, nw * inv


def parameter_row(
    mass: float,
    inertia: np.ndarray,
    arm: float,
    thrust: tuple[float, ...],
    torque: tuple[float, ...],
    lag: tuple[float, ...],
    prop_inertia: float,
    drag: tuple[float, ...],
) -> np.ndarray:
    """Parameters of a vehicle as a row; inertia (3, 3) kg m^2, the rest as in the layout."""
    row = np.zeros(PLANT_PARAM_SIZE)
    row[PP_MASS], row[PP_ARM], row[PP_PROP] = mass, arm, prop_inertia
    row[PP_THRUST:PP_TORQUE] = thrust
    row[PP_TORQUE:PP_LAG] = torque
    row[PP_LAG:PP_PROP] = lag
    row[PP_DRAG:PP_INERTIA] = drag
    row[PP_INERTIA:PP_INVERSE] = np.ravel(inertia)
    row[PP_INVERSE:] = np.ravel(np.linalg.inv(inertia))
    return row
