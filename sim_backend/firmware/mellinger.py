"""Geometric tracking controller of the Crazyflie, 2022 and 2026 firmware.

After D. Mellinger and V. Kumar, "Minimum snap trajectory generation and control for
quadrotors", ICRA 2011, with the integral terms, the fixed time step and the sign habits of the
firmware: degrees in, motor units out, pitch axis negated.

A kernel call is one *executed* call; dividing the 1000 Hz loop down to 500 Hz is the caller's
job, and on the skipped calls the outputs stay as they are.
"""

from __future__ import annotations

import math

import numpy as np

from crazyarena.jit import kernel
from crazyarena.sim_backend.firmware.arithmetic import clip, to_int16
from crazyarena.sim_backend.firmware.layout import (
    CT_PITCH,
    CT_ROLL,
    CT_THRUST,
    CT_YAW,
    M_PITCH,
    M_QUAT,
    M_ROLL,
    M_X,
    M_YAW,
    M_Z,
    MODE_ABS,
    MODE_DISABLE,
    MODE_VELOCITY,
    SP_ACC,
    SP_ATT,
    SP_POS,
    SP_QUAT,
    SP_RATE,
    SP_THRUST,
    SP_VEL,
    ST_ATT,
    ST_GYRO,
    ST_POS,
    ST_QUAT,
    ST_VEL,
)
from crazyarena.sim_backend.firmware.parameters import Param

PARAMS = (
    Param("ctrlMel.kp_xy", 0.4, 0.4),
    Param("ctrlMel.kd_xy", 0.2, 0.2),
    Param("ctrlMel.ki_xy", 0.05, 0.05),
    Param("ctrlMel.i_range_xy", 2.0, 2.0),
    Param("ctrlMel.kp_z", 1.25, 1.25),
    Param("ctrlMel.kd_z", 0.4, 0.4),
    Param("ctrlMel.ki_z", 0.05, 0.05),
    Param("ctrlMel.i_range_z", 0.4, 0.4),
    Param("ctrlMel.mass", 0.027, 0.029),
    Param("ctrlMel.massThrust", 132000.0, 132000.0),
    Param("ctrlMel.kR_xy", 70000.0, 70000.0),
    Param("ctrlMel.kR_z", 60000.0, 60000.0),
    Param("ctrlMel.kw_xy", 20000.0, 20000.0),
    Param("ctrlMel.kw_z", 12000.0, 12000.0),
    Param("ctrlMel.ki_m_xy", 0.0, 0.0),
    Param("ctrlMel.ki_m_z", 500.0, 500.0),
    Param("ctrlMel.kd_omega_rp", 200.0, 200.0),
    Param("ctrlMel.i_range_m_xy", 1.0, 1.0),
    Param("ctrlMel.i_range_m_z", 1500.0, 1500.0),
)
(
    _KP_XY,
    _KD_XY,
    _KI_XY,
    _I_RANGE_XY,
    _KP_Z,
    _KD_Z,
    _KI_Z,
    _I_RANGE_Z,
    _MASS,
    _MASS_THRUST,
    _KR_XY,
    _KR_Z,
    _KW_XY,
    _KW_Z,
    _KI_M_XY,
    _KI_M_Z,
    _KD_OMEGA_RP,
    _I_RANGE_M_XY,
    _I_RANGE_M_Z,
) = range(len(PARAMS))

# Memory row.
MEM_I_POS = 0  # m s, integrated position error x, y, z
MEM_I_ATT = 3  # integrated attitude error x, y (legacy), z
MEM_RATE = 6  # rad/s, previous body rate: roll, pitch (legacy)
MEM_RATE_SP = 8  # rad/s, previous rate setpoint: roll, pitch (legacy)
MEM_Z_DESIRED = 10  # unit vector, last desired body z axis, world
MEM_SIZE = 13

_DT = 0.002
_EXECUTION_RATE = 500.0  # 1 / _DT
_GRAVITY = 9.81
_LIMIT = 32000.0
_RAD = math.pi / 180.0


@kernel
def reset(mem: np.ndarray) -> None:
    """Clear the six integrals; the remembered rates survive, as in the firmware."""
    for i in range(6):
        mem[MEM_I_POS + i] = 0.0


@kernel
def _integrate(par: np.ndarray, mem: np.ndarray, state: np.ndarray, sp: np.ndarray) -> None:
    """Integrate the position error (in every mode)."""
    for i in range(3):
        limit = par[_I_RANGE_Z] if i == 2 else par[_I_RANGE_XY]
        error = sp[SP_POS + i] - state[ST_POS + i]
        mem[MEM_I_POS + i] = clip(mem[MEM_I_POS + i] + error * _DT, limit)


@kernel
def _force(
    par: np.ndarray,
    mem: np.ndarray,
    state: np.ndarray,
    sp: np.ndarray,
    axis: int,
    acceleration: float,
) -> float:
    """Desired force along one world axis, newton: feedback plus mass times ``acceleration``."""
    kp, kd, ki = par[_KP_XY], par[_KD_XY], par[_KI_XY]
    if axis == 2:
        kp, kd, ki = par[_KP_Z], par[_KD_Z], par[_KI_Z]
    return (
        par[_MASS] * acceleration
        + kp * (sp[SP_POS + axis] - state[ST_POS + axis])
        + kd * (sp[SP_VEL + axis] - state[ST_VEL + axis])
        + ki * mem[MEM_I_POS + axis]
    )


@kernel
def _heading(state: np.ndarray, sp: np.ndarray) -> tuple[float, float]:
    """Cosine and sine of the desired yaw."""
    if sp[M_YAW] == MODE_VELOCITY:
        yaw = (state[ST_ATT + 2] + sp[SP_RATE + 2] * _DT) * _RAD
        return math.cos(yaw), math.sin(yaw)
    if sp[M_YAW] == MODE_ABS:
        yaw = sp[SP_ATT + 2] * _RAD
        return math.cos(yaw), math.sin(yaw)
    if sp[M_QUAT] == MODE_ABS:
        # Yaw of a quaternion is an atan2 of these two: normalising them spares the trigonometry.
        qx, qy, qz, qw = sp[SP_QUAT], sp[SP_QUAT + 1], sp[SP_QUAT + 2], sp[SP_QUAT + 3]
        c = 1.0 - 2.0 * (qy * qy + qz * qz)
        s = 2.0 * (qw * qz + qx * qy)
        n = c * c + s * s
        if n > 0.0:
            inv = 1.0 / math.sqrt(n)
            return c * inv, s * inv
    return 1.0, 0.0


@kernel
def _rotation(
    state: np.ndarray,
) -> tuple[float, float, float, float, float, float, float, float, float]:
    """Body-to-world rotation matrix of the state, row by row."""
    x, y, z, w = state[ST_QUAT], state[ST_QUAT + 1], state[ST_QUAT + 2], state[ST_QUAT + 3]
    return (
        1.0 - 2.0 * (y * y + z * z),
        2.0 * (x * y - z * w),
        2.0 * (x * z + y * w),
        2.0 * (x * y + z * w),
        1.0 - 2.0 * (x * x + z * z),
        2.0 * (y * z - x * w),
        2.0 * (x * z - y * w),
        2.0 * (y * z + x * w),
        1.0 - 2.0 * (x * x + y * y),
    )


@kernel
def _frame_from_force(
    fx: float, fy: float, fz: float, cos_yaw: float, sin_yaw: float
) -> tuple[float, float, float, float, float, float, float, float, float]:
    """Desired axes x, y, z (one after the other): z along the force, x towards the heading."""
    inv = 1.0 / math.sqrt(fx * fx + fy * fy + fz * fz)
    zx, zy, zz = fx * inv, fy * inv, fz * inv
    # z cross (cos yaw, sin yaw, 0)
    yx = -zz * sin_yaw
    yy = zz * cos_yaw
    yz = zx * sin_yaw - zy * cos_yaw
    inv = 1.0 / math.sqrt(yx * yx + yy * yy + yz * yz)
    yx, yy, yz = yx * inv, yy * inv, yz * inv
    return (
        yy * zz - yz * zy,
        yz * zx - yx * zz,
        yx * zy - yy * zx,
        yx,
        yy,
        yz,
        zx,
        zy,
        zz,
    )


@kernel
def _frame_from_angles(
    roll: float, pitch: float, cos_yaw: float, sin_yaw: float
) -> tuple[float, float, float, float, float, float, float, float, float]:
    """Desired axes x, y, z (one after the other) of a ZYX attitude, radians."""
    cr, sr, cp, sp = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch)
    return (
        cos_yaw * cp,
        sin_yaw * cp,
        -sp,
        cos_yaw * sp * sr - sin_yaw * cr,
        sin_yaw * sp * sr + cos_yaw * cr,
        cp * sr,
        cos_yaw * sp * cr + sin_yaw * sr,
        sin_yaw * sp * cr - cos_yaw * sr,
        cp * cr,
    )


@kernel
def _collective(
    par: np.ndarray, state: np.ndarray, sp: np.ndarray, fx: float, fy: float, fz: float
) -> float:
    """Thrust command: the force along the body z axis, or the setpoint's own thrust."""
    if sp[M_Z] == MODE_DISABLE:
        return sp[SP_THRUST]
    x, y, z, w = state[ST_QUAT], state[ST_QUAT + 1], state[ST_QUAT + 2], state[ST_QUAT + 3]
    along = 2.0 * (fx * (x * z + y * w) + fy * (y * z - x * w)) + fz * (1.0 - 2.0 * (x * x + y * y))
    return par[_MASS_THRUST] * along


@kernel
def _attitude_control(
    par: np.ndarray,
    mem: np.ndarray,
    state: np.ndarray,
    sp: np.ndarray,
    thrust: float,
    desired: tuple[float, float, float, float, float, float, float, float, float],
    out: np.ndarray,
) -> None:
    """Moments that turn the body towards the desired axes (x, y, z one after the other)."""
    r11, r12, r13, r21, r22, r23, r31, r32, r33 = _rotation(state)
    xx, xy, xz, yx, yy, yz, zx, zy, zz = desired
    mem[MEM_Z_DESIRED] = zx
    mem[MEM_Z_DESIRED + 1] = zy
    mem[MEM_Z_DESIRED + 2] = zz
    # Vee map of Rd^T R - R^T Rd, without the usual factor 1/2 and with y negated.
    error_x = (zx * r12 + zy * r22 + zz * r32) - (yx * r13 + yy * r23 + yz * r33)
    error_y = (zx * r11 + zy * r21 + zz * r31) - (xx * r13 + xy * r23 + xz * r33)
    error_z = (yx * r11 + yy * r21 + yz * r31) - (xx * r12 + xy * r22 + xz * r32)

    rate_x = state[ST_GYRO] * _RAD
    rate_y = -state[ST_GYRO + 1] * _RAD
    want_x = sp[SP_RATE] * _RAD
    want_y = -sp[SP_RATE + 1] * _RAD
    rate_error_x = want_x - rate_x
    rate_error_y = want_y - rate_y
    rate_error_z = (sp[SP_RATE + 2] - state[ST_GYRO + 2]) * _RAD
    kick_x = ((want_x - mem[MEM_RATE_SP]) - (rate_x - mem[MEM_RATE])) * _EXECUTION_RATE
    kick_y = ((want_y - mem[MEM_RATE_SP + 1]) - (rate_y - mem[MEM_RATE + 1])) * _EXECUTION_RATE
    mem[MEM_RATE] = rate_x
    mem[MEM_RATE + 1] = rate_y
    mem[MEM_RATE_SP] = want_x
    mem[MEM_RATE_SP + 1] = want_y

    i_x = clip(mem[MEM_I_ATT] - error_x * _DT, par[_I_RANGE_M_XY])
    i_y = clip(mem[MEM_I_ATT + 1] - error_y * _DT, par[_I_RANGE_M_XY])
    i_z = clip(mem[MEM_I_ATT + 2] - error_z * _DT, par[_I_RANGE_M_Z])
    mem[MEM_I_ATT] = i_x
    mem[MEM_I_ATT + 1] = i_y
    mem[MEM_I_ATT + 2] = i_z

    out[CT_THRUST] = thrust
    if thrust > 0.0:
        kr, kw, ki, kd = par[_KR_XY], par[_KW_XY], par[_KI_M_XY], par[_KD_OMEGA_RP]
        out[CT_ROLL] = to_int16(-kr * error_x + kw * rate_error_x + ki * i_x + kd * kick_x, _LIMIT)
        out[CT_PITCH] = to_int16(-kr * error_y + kw * rate_error_y + ki * i_y + kd * kick_y, _LIMIT)
        moment_z = -par[_KR_Z] * error_z + par[_KW_Z] * rate_error_z + par[_KI_M_Z] * i_z
        out[CT_YAW] = to_int16(-moment_z, _LIMIT)
    else:
        out[CT_ROLL] = 0.0
        out[CT_PITCH] = 0.0
        out[CT_YAW] = 0.0
        reset(mem)


@kernel
def mellinger_2022(
    par: np.ndarray, mem: np.ndarray, state: np.ndarray, sp: np.ndarray, out: np.ndarray
) -> None:
    """One executed call of the 2022 controller (500 Hz).

    Parameters
    ----------
    par, mem
        Rows in the order of :data:`PARAMS` and of ``MEM_*`` (``MEM_SIZE``, zeros at boot).
    state, sp, out
        State, setpoint and control rows, see :mod:`.layout`. With an undefined attitude
        (no force, force along the heading, nose straight up in attitude mode) roll, pitch and
        yaw are 0.
    """
    _integrate(par, mem, state, sp)
    cos_yaw, sin_yaw = _heading(state, sp)
    if sp[M_X] == MODE_ABS:
        fx = _force(par, mem, state, sp, 0, sp[SP_ACC])
        fy = _force(par, mem, state, sp, 1, sp[SP_ACC + 1])
        fz = _force(par, mem, state, sp, 2, sp[SP_ACC + 2] + _GRAVITY)
    else:
        ahead = -math.sin(sp[SP_ATT + 1] * _RAD)
        left = -math.sin(sp[SP_ATT] * _RAD)
        fz = _force(par, mem, state, sp, 2, _GRAVITY) if sp[M_Z] == MODE_ABS else 1.0
        r11, _, _, r21, _, _, _, _, _ = _rotation(state)
        n = math.sqrt(r11 * r11 + r21 * r21)
        c, s = r11 / n, r21 / n
        fx = ahead * c - left * s
        fy = ahead * s + left * c
    desired = _frame_from_force(fx, fy, fz, cos_yaw, sin_yaw)
    _attitude_control(par, mem, state, sp, _collective(par, state, sp, fx, fy, fz), desired, out)


@kernel
def mellinger_2026(
    par: np.ndarray, mem: np.ndarray, state: np.ndarray, sp: np.ndarray, out: np.ndarray
) -> None:
    """One executed call of the 2026 controller (every even tick); rows as in 2022."""
    _integrate(par, mem, state, sp)
    if sp[M_X] == MODE_ABS:
        cos_yaw, sin_yaw = _heading(state, sp)
        fx = _force(par, mem, state, sp, 0, sp[SP_ACC])
        fy = _force(par, mem, state, sp, 1, sp[SP_ACC + 1])
        fz = _force(par, mem, state, sp, 2, sp[SP_ACC + 2] + _GRAVITY)
    elif sp[M_ROLL] == MODE_ABS and sp[M_PITCH] == MODE_ABS and sp[M_Z] == MODE_DISABLE:
        cos_yaw, sin_yaw = _heading(state, sp)
        desired = _frame_from_angles(sp[SP_ATT] * _RAD, -sp[SP_ATT + 1] * _RAD, cos_yaw, sin_yaw)
        _attitude_control(par, mem, state, sp, sp[SP_THRUST], desired, out)
        return
    else:
        yaw = state[ST_ATT + 2] * _RAD
        cos_yaw, sin_yaw = math.cos(yaw), math.sin(yaw)
        fx = 0.0
        fy = 0.0
        fz = _force(par, mem, state, sp, 2, _GRAVITY)
    desired = _frame_from_force(fx, fy, fz, cos_yaw, sin_yaw)
    _attitude_control(par, mem, state, sp, _collective(par, state, sp, fx, fy, fz), desired, out)
