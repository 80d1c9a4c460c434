"""Cascaded PID controller of the Crazyflie, 2022 and 2026 firmware.

Position and velocity loops (100 Hz) give attitude targets and a thrust, angle and rate loops
(500 Hz) give motor units. Angles are degrees, pitch has the legacy sign.

A kernel is called in every 1000 Hz loop with that loop's tick and divides by itself.
"""

from __future__ import annotations

import math

import numpy as np

from crazyarena.jit import kernel
from crazyarena.sim_backend.firmware import lowpass
from crazyarena.sim_backend.firmware.arithmetic import clip, to_int16
from crazyarena.sim_backend.firmware.layout import (
    CT_PITCH,
    CT_ROLL,
    CT_THRUST,
    CT_YAW,
    M_QUAT,
    M_ROLL,
    M_X,
    M_Y,
    M_YAW,
    M_Z,
    MODE_ABS,
    MODE_DISABLE,
    MODE_VELOCITY,
    SP_ATT,
    SP_BODY,
    SP_MODE,
    SP_POS,
    SP_QUAT,
    SP_RATE,
    SP_THRUST,
    SP_VEL,
    ST_ATT,
    ST_GYRO,
    ST_POS,
    ST_VEL,
)
from crazyarena.sim_backend.firmware.parameters import Param

# The twelve loops, in the order of their gains and of their memories.
X, Y, Z, VX, VY, VZ, ROLL, PITCH, YAW, ROLL_RATE, PITCH_RATE, YAW_RATE = range(12)
LOOPS = 12

_KP, _KI, _KD, _KFF = range(4)
_GAINS = 4


def _gains(stem: str, suffixes: tuple[str, ...], values: tuple[float, ...]) -> tuple[Param, ...]:
    proportional, integral, derivative, forward = suffixes
    kp, ki, kd = values
    return (
        Param(stem + proportional, kp, kp),
        Param(stem + integral, ki, ki),
        Param(stem + derivative, kd, kd),
        Param(stem + forward, None, 0.0),
    )


_POS_NAMES = ("Kp", "Ki", "Kd", "Kff")
_VEL_NAMES = ("Kp", "Ki", "Kd", "KFF")
_ATT_NAMES = ("_kp", "_ki", "_kd", "_kff")

PARAMS = (
    *_gains("posCtlPid.x", _POS_NAMES, (2.0, 0.0, 0.0)),
    *_gains("posCtlPid.y", _POS_NAMES, (2.0, 0.0, 0.0)),
    *_gains("posCtlPid.z", _POS_NAMES, (2.0, 0.5, 0.0)),
    *_gains("velCtlPid.vx", _VEL_NAMES, (25.0, 1.0, 0.0)),
    *_gains("velCtlPid.vy", _VEL_NAMES, (25.0, 1.0, 0.0)),
    *_gains("velCtlPid.vz", _VEL_NAMES, (25.0, 15.0, 0.0)),
    *_gains("pid_attitude.roll", _ATT_NAMES, (6.0, 3.0, 0.0)),
    *_gains("pid_attitude.pitch", _ATT_NAMES, (6.0, 3.0, 0.0)),
    *_gains("pid_attitude.yaw", _ATT_NAMES, (6.0, 1.0, 0.35)),
    *_gains("pid_rate.roll", _ATT_NAMES, (250.0, 500.0, 2.5)),
    *_gains("pid_rate.pitch", _ATT_NAMES, (250.0, 500.0, 2.5)),
    *_gains("pid_rate.yaw", _ATT_NAMES, (120.0, 16.7, 0.0)),
    Param("posCtlPid.thrustBase", 36000.0, 36000.0, "uint16"),
    Param("posCtlPid.thrustMin", 20000.0, 20000.0, "uint16"),
    Param("posCtlPid.rpLimit", 20.0, None),
    Param("posCtlPid.rLimit", None, 20.0),
    Param("posCtlPid.pLimit", None, 20.0),
    Param("posCtlPid.xyVelMax", 1.0, None),
    Param("posCtlPid.xVelMax", None, 1.0),
    Param("posCtlPid.yVelMax", None, 1.0),
    Param("posCtlPid.zVelMax", 1.0, 1.0),
    Param("pid_attitude.yawMaxDelta", None, 0.0),
)
(
    _THRUST_BASE,
    _THRUST_MIN,
    _RP_LIMIT,
    _R_LIMIT,
    _P_LIMIT,
    _XY_VEL_MAX,
    _X_VEL_MAX,
    _Y_VEL_MAX,
    _Z_VEL_MAX,
    _YAW_MAX_DELTA,
) = range(LOOPS * _GAINS, len(PARAMS))

# Memory row. Per loop: integral, previous error (2022) or measurement (2026), filter delays.
_INTEGRAL, _PREVIOUS, _DELAY = range(3)
_LOOP_SIZE = 4
MEM_LOOPS = 0
MEM_ATTITUDE = MEM_LOOPS + LOOPS * _LOOP_SIZE  # deg, attitude targets (legacy pitch)
MEM_RATE = MEM_ATTITUDE + 3  # deg/s, rate targets (legacy pitch)
MEM_THRUST = MEM_RATE + 3  # actuator thrust
MEM_VEL = MEM_THRUST + 1  # m/s, velocity targets: world (2022), yaw-aligned body (2026)
MEM_MODES = MEM_VEL + 3  # setpoint modes of the previous call (2026)
MEM_SIZE = MEM_MODES + 7

_RAD = math.pi / 180.0
_ATTITUDE_DT = 0.002
_POSITION_DT = 0.01
_OVERHEAD = 1.1  # room above the limits of targets for the outputs of the loops
_POSITION_INTEGRAL = 5000.0
_VZ_OUTPUT = 32.767
_THRUST_SCALE = 1000.0
_THRUST_MAX = 65535.0
_INT16_MAX = 32767.0
_INTEGRAL_RATE_RP = 33.3
_INTEGRAL_RATE_YAW = 166.7
_INTEGRAL_RP = 20.0
_INTEGRAL_YAW = 360.0

# Low-pass of the derivatives in the position and velocity loops.
_filter = np.zeros(lowpass.COEF_SIZE)
lowpass.coefficients.py_func(100.0, 20.0, _filter)
_FB0, _FB1, _FB2, _FA1, _FA2 = (float(c) for c in _filter)


@kernel
def _wrap_once(angle: float) -> float:
    if angle > 180.0:
        return angle - 360.0
    if angle < -180.0:
        return angle + 360.0
    return angle


@kernel
def _wrap(angle: float) -> float:
    """Bring an angle into +-180 degrees."""
    return angle - 360.0 * np.rint(angle / 360.0) if math.fabs(angle) > 180.0 else angle


@kernel
def _step(
    par: np.ndarray,
    mem: np.ndarray,
    modern: bool,
    loop: int,
    target: float,
    measured: float,
    dt: float,
    integral_limit: float,
) -> float:
    """Run one loop; its output without a limit.

    The derivative is of the error in 2022, of the measurement in 2026 (``modern``).
    """
    at = MEM_LOOPS + loop * _LOOP_SIZE
    gain = loop * _GAINS
    error = target - measured
    if loop == YAW:
        error = _wrap_once(error)
    if modern:
        change = mem[at + _PREVIOUS] - measured
        if loop == YAW:
            change = _wrap_once(change)
        mem[at + _PREVIOUS] = measured
    else:
        change = error - mem[at + _PREVIOUS]
        mem[at + _PREVIOUS] = error
    derivative = change / dt
    if loop < ROLL:
        d1, d2 = mem[at + _DELAY], mem[at + _DELAY + 1]
        d0 = derivative - _FA1 * d1 - _FA2 * d2
        mem[at + _DELAY] = d0
        mem[at + _DELAY + 1] = d1
        derivative = _FB0 * d0 + _FB1 * d1 + _FB2 * d2
    integral = clip(mem[at + _INTEGRAL] + error * dt, integral_limit)
    mem[at + _INTEGRAL] = integral
    return (
        par[gain + _KP] * error
        + par[gain + _KI] * integral
        + par[gain + _KD] * derivative
        + par[gain + _KFF] * target
    )


@kernel
def _reset_loop(mem: np.ndarray, loop: int, previous: float) -> None:
    at = MEM_LOOPS + loop * _LOOP_SIZE
    mem[at + _INTEGRAL] = 0.0
    mem[at + _PREVIOUS] = previous
    mem[at + _DELAY] = 0.0
    mem[at + _DELAY + 1] = 0.0


@kernel
def _reset(mem: np.ndarray, modern: bool, state: np.ndarray) -> None:
    """Restart all loops; in 2026 from the current state, which also becomes the roll and pitch
    target."""
    for loop in range(LOOPS):
        _reset_loop(mem, loop, 0.0)
    if modern:
        yaw = state[ST_ATT + 2] * _RAD
        c, s = math.cos(yaw), math.sin(yaw)
        x, y = state[ST_POS], state[ST_POS + 1]
        _reset_loop(mem, X, x * c + y * s)
        _reset_loop(mem, Y, y * c - x * s)
        _reset_loop(mem, Z, state[ST_POS + 2])
        for i in range(3):
            _reset_loop(mem, ROLL + i, state[ST_ATT + i])
        mem[MEM_ATTITUDE] = state[ST_ATT]
        mem[MEM_ATTITUDE + 1] = state[ST_ATT + 1]


@kernel
def _yaw_target(
    par: np.ndarray, mem: np.ndarray, modern: bool, state: np.ndarray, sp: np.ndarray
) -> None:
    target = mem[MEM_ATTITUDE + 2]
    if sp[M_YAW] == MODE_VELOCITY:
        # Single precision: thousands of small steps add up to a visible difference.
        change = np.float32(sp[SP_RATE + 2]) * np.float32(_ATTITUDE_DT)
        target = _wrap(float(np.float32(target) + change))
        widest = par[_YAW_MAX_DELTA]
        if modern and widest != 0.0:
            target = state[ST_ATT + 2] + clip(_wrap(target - state[ST_ATT + 2]), widest)
    elif sp[M_YAW] == MODE_ABS or not modern:
        target = sp[SP_ATT + 2]
    elif sp[M_QUAT] == MODE_ABS:
        qx, qy, qz, qw = sp[SP_QUAT], sp[SP_QUAT + 1], sp[SP_QUAT + 2], sp[SP_QUAT + 3]
        target = math.atan2(2.0 * (qw * qz + qx * qy), 1.0 - 2.0 * (qy * qy + qz * qz)) / _RAD
    mem[MEM_ATTITUDE + 2] = _wrap(target)


@kernel
def _position_part(
    par: np.ndarray, mem: np.ndarray, modern: bool, state: np.ndarray, sp: np.ndarray
) -> None:
    """Position and velocity loops: attitude targets and thrust.

    They work in world axes in 2022, in the yaw-aligned body frame in 2026.
    """
    yaw = state[ST_ATT + 2] * _RAD
    c, s = math.cos(yaw), math.sin(yaw)
    # World to the frame of the loops.
    fc, fs = (c, s) if modern else (1.0, 0.0)
    mem[MEM_VEL] = sp[SP_VEL]
    mem[MEM_VEL + 1] = sp[SP_VEL + 1]
    mem[MEM_VEL + 2] = sp[SP_VEL + 2]
    in_body = sp[SP_BODY] != 0.0
    if in_body != modern:
        # Body to world in 2022, world to body in 2026.
        turn = -s if modern else s
        mem[MEM_VEL] = sp[SP_VEL] * c - sp[SP_VEL + 1] * turn
        mem[MEM_VEL + 1] = sp[SP_VEL + 1] * c + sp[SP_VEL] * turn

    for i in range(3):
        if sp[M_X + i] == MODE_ABS:
            if i == 0:
                target = sp[SP_POS] * fc + sp[SP_POS + 1] * fs
                measured = state[ST_POS] * fc + state[ST_POS + 1] * fs
            elif i == 1:
                target = sp[SP_POS + 1] * fc - sp[SP_POS] * fs
                measured = state[ST_POS + 1] * fc - state[ST_POS] * fs
            else:
                target = sp[SP_POS + 2]
                measured = state[ST_POS + 2]
            velocity = _step(
                par, mem, modern, X + i, target, measured, _POSITION_DT, _POSITION_INTEGRAL
            )
            at = _X_VEL_MAX + i if modern or i == 2 else _XY_VEL_MAX
            mem[MEM_VEL + i] = clip(velocity, par[at] * _OVERHEAD)

    roll_limit = par[_R_LIMIT] if modern else par[_RP_LIMIT]
    pitch_limit = par[_P_LIMIT] if modern else par[_RP_LIMIT]
    a = 0.0
    b = 0.0
    lift = 0.0
    for i in range(3):
        if i == 0:
            measured = state[ST_VEL] * fc + state[ST_VEL + 1] * fs
        elif i == 1:
            measured = state[ST_VEL + 1] * fc - state[ST_VEL] * fs
        else:
            measured = state[ST_VEL + 2]
        value = _step(
            par,
            mem,
            modern,
            VX + i,
            mem[MEM_VEL + i],
            measured,
            _POSITION_DT,
            _POSITION_INTEGRAL,
        )
        if i == 0:
            a = clip(value, pitch_limit * _OVERHEAD)
        elif i == 1:
            b = clip(value, roll_limit * _OVERHEAD)
        else:
            lift = clip(value, _VZ_OUTPUT)
    if not modern:
        a, b = a * c + b * s, b * c - a * s
    mem[MEM_ATTITUDE] = clip(-b, roll_limit)
    mem[MEM_ATTITUDE + 1] = clip(-a, pitch_limit)
    thrust = max(lift * _THRUST_SCALE + par[_THRUST_BASE], par[_THRUST_MIN])
    mem[MEM_THRUST] = min(thrust, _THRUST_MAX) if modern else thrust


@kernel
def _attitude_part(
    par: np.ndarray,
    mem: np.ndarray,
    modern: bool,
    state: np.ndarray,
    sp: np.ndarray,
    out: np.ndarray,
) -> None:
    """Angle and rate loops."""
    if sp[M_Z] == MODE_DISABLE:
        mem[MEM_THRUST] = sp[SP_THRUST]
    if sp[M_X] == MODE_DISABLE or sp[M_Y] == MODE_DISABLE:
        mem[MEM_ATTITUDE] = sp[SP_ATT]
        mem[MEM_ATTITUDE + 1] = sp[SP_ATT + 1]
    for i in range(3):
        limit = _INTEGRAL_YAW if i == 2 else _INTEGRAL_RP
        rate = _step(
            par,
            mem,
            modern,
            ROLL + i,
            mem[MEM_ATTITUDE + i],
            state[ST_ATT + i],
            _ATTITUDE_DT,
            limit,
        )
        if i < 2 and sp[M_ROLL + i] == MODE_VELOCITY:
            rate = sp[SP_RATE + i]
            if not modern:
                _reset_loop(mem, ROLL + i, 0.0)
        mem[MEM_RATE + i] = rate
        measured = -state[ST_GYRO + 1] if i == 1 else state[ST_GYRO + i]
        limit = _INTEGRAL_RATE_YAW if i == 2 else _INTEGRAL_RATE_RP
        value = _step(par, mem, modern, ROLL_RATE + i, rate, measured, _ATTITUDE_DT, limit)
        out[CT_ROLL + i] = to_int16(value, _INT16_MAX)
    out[CT_YAW] = -out[CT_YAW]


@kernel
def _control(
    par: np.ndarray,
    mem: np.ndarray,
    modern: bool,
    state: np.ndarray,
    sp: np.ndarray,
    tick: int,
    out: np.ndarray,
) -> None:
    if tick % 2 == 0:
        _yaw_target(par, mem, modern, state, sp)
        if tick % 10 == 0:
            _position_part(par, mem, modern, state, sp)
        _attitude_part(par, mem, modern, state, sp, out)
    out[CT_THRUST] = mem[MEM_THRUST]
    if out[CT_THRUST] == 0.0:
        out[CT_ROLL] = 0.0
        out[CT_PITCH] = 0.0
        out[CT_YAW] = 0.0
        _reset(mem, modern, state)
        mem[MEM_ATTITUDE + 2] = state[ST_ATT + 2]


@kernel
def pid_2022(
    par: np.ndarray,
    mem: np.ndarray,
    state: np.ndarray,
    sp: np.ndarray,
    tick: int,
    out: np.ndarray,
) -> None:
    """One 1000 Hz call of the 2022 controller.

    Parameters
    ----------
    par, mem
        Rows in the order of :data:`PARAMS` and of ``MEM_*`` (``MEM_SIZE``, zeros at boot).
    state, sp, out
        State, setpoint and control rows, see :mod:`.layout`. Unlike the original, which
        overwrites the setpoint's velocity, the world velocity target goes to ``MEM_VEL``.
    tick
        Loop counter: even ticks run the attitude part, multiples of ten the position part.
    """
    _control(par, mem, False, state, sp, tick, out)


@kernel
def pid_2026(
    par: np.ndarray,
    mem: np.ndarray,
    state: np.ndarray,
    sp: np.ndarray,
    tick: int,
    out: np.ndarray,
) -> None:
    """One 1000 Hz call of the 2026 controller; arguments as in 2022.

    A change of any setpoint mode restarts the loops. ``MEM_VEL`` holds the velocity target in
    the yaw-aligned body frame.
    """
    changed = False
    for i in range(7):
        if mem[MEM_MODES + i] != sp[SP_MODE + i]:
            changed = True
            mem[MEM_MODES + i] = sp[SP_MODE + i]
    if changed:
        _reset(mem, True, state)
    _control(par, mem, True, state, sp, tick, out)
