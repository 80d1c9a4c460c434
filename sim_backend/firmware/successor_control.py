"""The controller of lsy_drone_racing's simulation: Mellinger's, cut in two.

After D. Mellinger and V. Kumar, ICRA 2011, with the gains of the Crazyflie's firmware: a position
part that yields an attitude and a thrust (at the environment's rate), and an attitude part that
yields motor forces (at its own rate). In between a command is what contestants send in attitude
mode: roll, pitch, yaw (rad) and collective thrust (N).
"""

from __future__ import annotations

import math

import numpy as np

from crazyarena.jit import kernel
from crazyarena.sim_backend.physics.successor_plant import SS_POS, SS_QUAT, SS_RATE, SS_VEL

# Memory row.
CM_I_POS = 0  # m s
CM_I_ATT = 3
CM_RATE = 6  # rad/s, of the call before
CM_COMMAND = 9  # roll, pitch, yaw, thrust that the attitude part follows
CONTROL_MEM_SIZE = 13

# Parameter row.
CP_MASS = 0  # kg, what the controller takes the vehicle for
CP_THRUST_MIN = 1  # N a motor
CP_THRUST_MAX = 2
CP_PWM_MIN = 3
CP_PWM_MAX = 4
CP_CURVE = 5  # N over rpm, 3 coefficients
CONTROL_PARAM_SIZE = 8

_GRAVITY = 9.81
_MASS_THRUST = 132000.0
_KP = (0.4, 0.4, 1.25)
_KD = (0.2, 0.2, 0.5)
_KI = (0.05, 0.05, 0.05)
_I_RANGE = (2.0, 2.0, 0.4)
_KR = (70000.0, 70000.0, 60000.0)
_KW = (20000.0, 20000.0, 12000.0)
_KI_M_Z = 500.0
_KD_OMEGA = 200.0
_I_RANGE_M = (1.0, 1.0, 1500.0)
_TORQUE_LIMIT = 32000.0


@kernel
def _limit(value, bound):
    return min(max(value, -bound), bound)


@kernel
def position_part(par, mem, state, setpoint, dt):
    """Attitude and thrust for a full-state setpoint (13,), written to the memory's command.

    Without a desired force (which no attitude has) the last command stays.
    """
    f0, f1, f2 = 0.0, 0.0, 0.0
    for i in range(3):
        error = setpoint[i] - state[SS_POS + i]
        mem[CM_I_POS + i] = _limit(mem[CM_I_POS + i] + error * dt, _I_RANGE[i])
        acceleration = setpoint[6 + i] + (_GRAVITY if i == 2 else 0.0)
        force = (
            par[CP_MASS] * acceleration
            + _KP[i] * error
            + _KD[i] * (setpoint[3 + i] - state[SS_VEL + i])
            + _KI[i] * mem[CM_I_POS + i]
        )
        if i == 0:
            f0 = force
        elif i == 1:
            f1 = force
        else:
            f2 = force
    norm = math.sqrt(f0 * f0 + f1 * f1 + f2 * f2)
    if not norm > 0.0:
        return
    zx, zy, zz = f0 / norm, f1 / norm, f2 / norm
    c, s = math.cos(setpoint[9]), math.sin(setpoint[9])
    yx, yy, yz = -zz * s, zz * c, zx * s - zy * c
    norm = math.sqrt(yx * yx + yy * yy + yz * yz)
    if not norm > 0.0:
        return
    yx, yy, yz = yx / norm, yy / norm, yz / norm
    xx, xy, xz = yy * zz - yz * zy, yz * zx - yx * zz, yx * zy - yy * zx
    mem[CM_COMMAND] = math.atan2(yz, zz)
    mem[CM_COMMAND + 1] = -math.asin(min(max(xz, -1.0), 1.0))
    mem[CM_COMMAND + 2] = math.atan2(xy, xx)
    x, y, z, w = state[SS_QUAT], state[SS_QUAT + 1], state[SS_QUAT + 2], state[SS_QUAT + 3]
    along = (
        2.0 * (x * z + w * y) * f0 + 2.0 * (y * z - w * x) * f1 + (1.0 - 2.0 * (x * x + y * y)) * f2
    )
    # By way of motor units, whose scale is fixed whatever the vehicle weighs.
    mem[CM_COMMAND + 3] = _MASS_THRUST * along / par[CP_PWM_MAX] * par[CP_THRUST_MAX] * 4.0


@kernel
def attitude_part(par, mem, state, motors, dt):
    """Rotor speeds (4,) rpm for the memory's command."""
    roll, pitch, yaw = mem[CM_COMMAND], mem[CM_COMMAND + 1], mem[CM_COMMAND + 2]
    thrust = mem[CM_COMMAND + 3]
    cr, sr = math.cos(roll), math.sin(roll)
    cp, sp = math.cos(pitch), math.sin(pitch)
    cy, sy = math.cos(yaw), math.sin(yaw)
    d00, d01, d02 = cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr
    d10, d11, d12 = sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr
    d20, d21, d22 = -sp, cp * sr, cp * cr
    x, y, z, w = state[SS_QUAT], state[SS_QUAT + 1], state[SS_QUAT + 2], state[SS_QUAT + 3]
    r00, r01, r02 = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)
    r10, r11, r12 = 2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)
    r20, r21, r22 = 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)
    # Vee map of Rd^T R - R^T Rd, without the paper's factor 1/2, as in the firmware.
    e0 = (d02 * r01 + d12 * r11 + d22 * r21) - (d01 * r02 + d11 * r12 + d21 * r22)
    e1 = (d00 * r02 + d10 * r12 + d20 * r22) - (d02 * r00 + d12 * r10 + d22 * r20)
    e2 = (d01 * r00 + d11 * r10 + d21 * r20) - (d00 * r01 + d10 * r11 + d20 * r21)
    pwm_scale = par[CP_PWM_MAX] / par[CP_THRUST_MAX]
    t0, t1, t2 = 0.0, 0.0, 0.0
    for i in range(3):
        error = e0 if i == 0 else (e1 if i == 1 else e2)
        rate = state[SS_RATE + i]
        kick = (mem[CM_RATE + i] - rate) / dt
        mem[CM_RATE + i] = rate
        mem[CM_I_ATT + i] = _limit(mem[CM_I_ATT + i] - error * dt, _I_RANGE_M[i])
        torque = -_KR[i] * error - _KW[i] * rate
        torque += _KI_M_Z * mem[CM_I_ATT + i] if i == 2 else _KD_OMEGA * kick
        torque = _limit(torque, _TORQUE_LIMIT) if thrust > 0.0 else 0.0
        if i == 0:
            t0 = 0.5 * torque
        elif i == 1:
            t1 = 0.5 * torque
        else:
            t2 = torque
    base = thrust * 0.25 * pwm_scale
    p0, p1, p2, p3 = (
        base - t0 - t1 - t2,
        base - t0 + t1 + t2,
        base + t0 + t1 - t2,
        base + t0 - t1 + t2,
    )
    still = p0 == 0.0 and p1 == 0.0 and p2 == 0.0 and p3 == 0.0
    for i in range(4):
        pwm = p0 if i == 0 else (p1 if i == 1 else (p2 if i == 2 else p3))
        force = 0.0
        if not still:
            force = min(max(pwm, par[CP_PWM_MIN]), par[CP_PWM_MAX]) / pwm_scale
            force = min(max(force, par[CP_THRUST_MIN]), par[CP_THRUST_MAX])
        a, b, c = par[CP_CURVE], par[CP_CURVE + 1], par[CP_CURVE + 2]
        motors[i] = (-b + math.sqrt(b * b - 4.0 * c * (a - force))) / (2.0 * c)


def control_row(
    mass: float,
    thrust_min: float,
    thrust_max: float,
    pwm_min: float,
    pwm_max: float,
    curve: tuple[float, ...],
) -> np.ndarray:
    """Parameters of a vehicle's controller as a row."""
    return np.array([mass, thrust_min, thrust_max, pwm_min, pwm_max, *curve])
