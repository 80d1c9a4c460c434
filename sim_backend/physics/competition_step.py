"""One 2 ms step of the IROS 2022 competition plant in free flight.

The published simulator applies rotor forces in link frames that are one step old. Written in
the body frame of the present step k, with u the body z axis of step k-1:

    force = u * sum(f),  torque = sum(r_i x u f_i) + u * tau_z + R_k^T ((p_k - p_{k-1}) x d)

where d is a world-frame disturbance force. Rates and velocities are then advanced first and
pose second (semi-implicit Euler), the attitude by the exponential of the new rates. There is no
drag, motor lag, ground effect or damping. Checked against recorded flights: the prediction of
one step agrees to the precision of the recording.
"""

from __future__ import annotations

import math

import numpy as np

from crazyarena.jit import kernel

DT = 0.002
GRAVITY = 9.8

# Rows of one vehicle's body.
B_POS = 0  # m, world
B_VEL = 3  # m/s, world
B_QUAT = 6  # x, y, z, w, body to world
B_OMEGA = 10  # rad/s, body
B_PREVIOUS_POS = 13  # m, one step ago
B_PREVIOUS_Z = 16  # body z axis in the world, one step ago
B_RPY = 19  # rad, fixed-axis XYZ, of B_QUAT
BODY_SIZE = 22

# Rows of one vehicle's plant.
P_MASS = 0  # kg
P_INERTIA = 1  # kg m2, principal: x, y, z
PLANT_SIZE = 4

# Rotors in the order of the action: front-left, back-left, back-right, front-right.
ROTOR_OFFSET = 0.028  # m, along x and y
KF = 3.16e-10  # N / rpm2
KM = 7.94e-12  # N m / rpm2
RPM_PER_PWM = 0.2685
RPM_AT_ZERO = 4070.3
PWM_MIN = 20000.0
PWM_MAX = 65535.0
# The environment keeps its action bounds in single precision.
FORCE_MIN = float(np.float32(KF * (RPM_PER_PWM * PWM_MIN + RPM_AT_ZERO) ** 2))
FORCE_MAX = float(np.float32(KF * (RPM_PER_PWM * PWM_MAX + RPM_AT_ZERO) ** 2))


@kernel
def rotor_rpm(force, noise):
    """Speed (rpm) of a rotor asked for ``force`` N, with ``noise`` N added after clipping."""
    wanted = min(max(force, FORCE_MIN), FORCE_MAX) + noise
    pwm = (math.sqrt(max(wanted, 0.0) / KF) - RPM_AT_ZERO) / RPM_PER_PWM
    return RPM_PER_PWM * min(max(pwm, PWM_MIN), PWM_MAX) + RPM_AT_ZERO


@kernel
def euler_from_quaternion(x, y, z, w):
    """Roll, pitch, yaw (rad) with R = Rz(yaw) Ry(pitch) Rx(roll)."""
    sin_pitch = 2.0 * (w * y - z * x)
    roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = math.asin(min(1.0, max(-1.0, sin_pitch)))
    yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return roll, pitch, yaw


@kernel
def update_rpy(body):
    """Bring B_RPY up to date with B_QUAT, once everything has moved the body."""
    body[B_RPY], body[B_RPY + 1], body[B_RPY + 2] = euler_from_quaternion(
        body[B_QUAT], body[B_QUAT + 1], body[B_QUAT + 2], body[B_QUAT + 3]
    )


@kernel
def set_pose(body, px, py, pz, roll, pitch, yaw):
    """Place the body at rest, as after a reset: the step-old frames equal the present ones."""
    cr, sr = math.cos(roll / 2), math.sin(roll / 2)
    cp, sp = math.cos(pitch / 2), math.sin(pitch / 2)
    cy, sy = math.cos(yaw / 2), math.sin(yaw / 2)
    for i in range(BODY_SIZE):
        body[i] = 0.0
    body[B_POS], body[B_POS + 1], body[B_POS + 2] = px, py, pz
    body[B_QUAT] = sr * cp * cy - cr * sp * sy
    body[B_QUAT + 1] = cr * sp * cy + sr * cp * sy
    body[B_QUAT + 2] = cr * cp * sy - sr * sp * cy
    body[B_QUAT + 3] = cr * cp * cy + sr * sp * sy
    body[B_RPY], body[B_RPY + 1], body[B_RPY + 2] = roll, pitch, yaw
    body[B_PREVIOUS_POS], body[B_PREVIOUS_POS + 1], body[B_PREVIOUS_POS + 2] = px, py, pz
    x, y, z, w = body[B_QUAT], body[B_QUAT + 1], body[B_QUAT + 2], body[B_QUAT + 3]
    body[B_PREVIOUS_Z] = 2.0 * (x * z + w * y)
    body[B_PREVIOUS_Z + 1] = 2.0 * (y * z - w * x)
    body[B_PREVIOUS_Z + 2] = 1.0 - 2.0 * (x * x + y * y)


@kernel
def advance_pose(body, dt):
    """Advance position and attitude by ``dt`` s under the row's velocities (dt may be negative).

    The attitude moves by the exponential of the body rates.
    """
    for i in range(3):
        body[B_POS + i] += dt * body[B_VEL + i]
    wx, wy, wz = body[B_OMEGA], body[B_OMEGA + 1], body[B_OMEGA + 2]
    half = 0.5 * dt
    h2 = half * half * (wx * wx + wy * wy + wz * wz)
    if h2 < 0.01:  # series: exact to double precision below 0.1 rad
        s = half * (1.0 - h2 / 6.0 * (1.0 - h2 / 20.0 * (1.0 - h2 / 42.0 * (1.0 - h2 / 72.0))))
        c = 1.0 - h2 / 2.0 * (1.0 - h2 / 12.0 * (1.0 - h2 / 30.0 * (1.0 - h2 / 56.0)))
    else:
        h = math.sqrt(h2)
        s = half * math.sin(h) / h
        c = math.cos(h)
    ex, ey, ez = s * wx, s * wy, s * wz
    x, y, z, w = body[B_QUAT], body[B_QUAT + 1], body[B_QUAT + 2], body[B_QUAT + 3]
    nx = w * ex + x * c + y * ez - z * ey
    ny = w * ey + y * c + z * ex - x * ez
    nz = w * ez + z * c + x * ey - y * ex
    nw = w * c - x * ex - y * ey - z * ez
    norm = 1.0 / math.sqrt(nx * nx + ny * ny + nz * nz + nw * nw)
    body[B_QUAT], body[B_QUAT + 1] = nx * norm, ny * norm
    body[B_QUAT + 2], body[B_QUAT + 3] = nz * norm, nw * norm


@kernel
def step(body, plant, rpm0, rpm1, rpm2, rpm3, dx, dy, dz):
    """Advance ``body`` by :data:`DT` under four rotor speeds (rpm) and a world force d (N).

    B_RPY is left behind, see :func:`update_rpy`.
    """
    x, y, z, w = body[B_QUAT], body[B_QUAT + 1], body[B_QUAT + 2], body[B_QUAT + 3]
    r00 = 1.0 - 2.0 * (y * y + z * z)
    r01 = 2.0 * (x * y - w * z)
    r02 = 2.0 * (x * z + w * y)
    r10 = 2.0 * (x * y + w * z)
    r11 = 1.0 - 2.0 * (x * x + z * z)
    r12 = 2.0 * (y * z - w * x)
    r20 = 2.0 * (x * z - w * y)
    r21 = 2.0 * (y * z + w * x)
    r22 = 1.0 - 2.0 * (x * x + y * y)

    zx, zy, zz = body[B_PREVIOUS_Z], body[B_PREVIOUS_Z + 1], body[B_PREVIOUS_Z + 2]
    ux = r00 * zx + r10 * zy + r20 * zz
    uy = r01 * zx + r11 * zy + r21 * zz
    uz = r02 * zx + r12 * zy + r22 * zz

    s0, s1, s2, s3 = rpm0 * rpm0, rpm1 * rpm1, rpm2 * rpm2, rpm3 * rpm3
    thrust = KF * (s0 + s1 + s2 + s3)
    torque_z = KM * (s0 - s1 + s2 - s3)
    # sum(r_i f_i): the rotors' moment arms weighted by their forces.
    arm_x = ROTOR_OFFSET * KF * (s0 - s1 - s2 + s3)
    arm_y = ROTOR_OFFSET * KF * (s0 + s1 - s2 - s3)
    lag_x = body[B_POS] - body[B_PREVIOUS_POS]
    lag_y = body[B_POS + 1] - body[B_PREVIOUS_POS + 1]
    lag_z = body[B_POS + 2] - body[B_PREVIOUS_POS + 2]
    wind_x = lag_y * dz - lag_z * dy
    wind_y = lag_z * dx - lag_x * dz
    wind_z = lag_x * dy - lag_y * dx
    tx = arm_y * uz + ux * torque_z + r00 * wind_x + r10 * wind_y + r20 * wind_z
    ty = -arm_x * uz + uy * torque_z + r01 * wind_x + r11 * wind_y + r21 * wind_z
    tz = arm_x * uy - arm_y * ux + uz * torque_z + r02 * wind_x + r12 * wind_y + r22 * wind_z

    mass = plant[P_MASS]
    jx, jy, jz = plant[P_INERTIA], plant[P_INERTIA + 1], plant[P_INERTIA + 2]
    p, q, r = body[B_OMEGA], body[B_OMEGA + 1], body[B_OMEGA + 2]
    wx = p + DT * (tx - (jz - jy) * q * r) / jx
    wy = q + DT * (ty - (jx - jz) * r * p) / jy
    wz = r + DT * (tz - (jy - jx) * p * q) / jz

    for i in range(3):
        body[B_PREVIOUS_POS + i] = body[B_POS + i]
    body[B_PREVIOUS_Z], body[B_PREVIOUS_Z + 1], body[B_PREVIOUS_Z + 2] = r02, r12, r22

    scale = DT / mass
    # Total force direction u, turned back to the world by the present attitude, is the
    # step-old body z axis itself.
    body[B_VEL] += scale * (thrust * zx + dx)
    body[B_VEL + 1] += scale * (thrust * zy + dy)
    body[B_VEL + 2] += scale * (thrust * zz + dz) - DT * GRAVITY
    body[B_OMEGA], body[B_OMEGA + 1], body[B_OMEGA + 2] = wx, wy, wz
    advance_pose(body, DT)
