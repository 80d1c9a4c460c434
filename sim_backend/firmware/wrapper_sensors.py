"""Sensors and timing of the 2022 competition software around the firmware.

The competition fed the firmware from the simulator's exact state: body rates are differences of
Euler angles (a yaw wrap gives a spike), accelerations are velocity differences, and the two
low-pass cut-offs are swapped. Its controller ran on a rule of thumb in floating point, so that
rounding decides which steps execute.
"""

from __future__ import annotations

import math

import numpy as np

from crazyarena.jit import kernel
from crazyarena.sim_backend.firmware import lowpass
from crazyarena.sim_backend.firmware.layout import (
    ST_ACC,
    ST_ACCEL,
    ST_ATT,
    ST_GYRO,
    ST_POS,
    ST_QUAT,
    ST_VEL,
)

STEP_RATE = 500  # Hz, environment steps
_DT = 1.0 / STEP_RATE
_GRAVITY = 9.8
_DEG = 180.0 / math.pi
GYRO_CUTOFF = 30.0  # Hz
ACCEL_CUTOFF = 80.0  # Hz

# Memory row: previous sample, filter coefficients, filter delays.
MEM_VEL = 0  # m/s
MEM_RPY = 3  # rad
MEM_GYRO_COEF = 6
MEM_ACCEL_COEF = MEM_GYRO_COEF + lowpass.COEF_SIZE
MEM_GYRO_DELAY = MEM_ACCEL_COEF + lowpass.COEF_SIZE
MEM_ACCEL_DELAY = MEM_GYRO_DELAY + 3 * lowpass.DELAY_SIZE
MEM_SIZE = MEM_ACCEL_DELAY + 3 * lowpass.DELAY_SIZE

# Timing row: when attitude and position control last ran, in seconds.
TIMING_ATTITUDE, TIMING_POSITION = range(2)
TIMING_SIZE = 2

TICK_BOTH, TICK_SKIP, TICK_ATTITUDE = range(3)


@kernel
def reset(
    mem: np.ndarray, vx: float, vy: float, vz: float, roll: float, pitch: float, yaw: float
) -> None:
    """Start the sensor chain (``MEM_SIZE``) at a velocity (m/s) and an attitude (rad)."""
    mem[MEM_VEL] = vx
    mem[MEM_VEL + 1] = vy
    mem[MEM_VEL + 2] = vz
    mem[MEM_RPY] = roll
    mem[MEM_RPY + 1] = pitch
    mem[MEM_RPY + 2] = yaw
    lowpass.coefficients(STEP_RATE, GYRO_CUTOFF, mem[MEM_GYRO_COEF:MEM_ACCEL_COEF])
    lowpass.coefficients(STEP_RATE, ACCEL_CUTOFF, mem[MEM_ACCEL_COEF:MEM_GYRO_DELAY])
    for i in range(MEM_GYRO_DELAY, MEM_SIZE):
        mem[i] = 0.0


@kernel
def sense(
    mem: np.ndarray,
    x: float,
    y: float,
    z: float,
    vx: float,
    vy: float,
    vz: float,
    roll: float,
    pitch: float,
    yaw: float,
    state: np.ndarray,
) -> None:
    """Fill the firmware's state row from the exact state after one 2 ms step.

    Parameters
    ----------
    mem
        Sensor memory, see :func:`reset`.
    x, y, z, vx, vy, vz
        Position and velocity, m and m/s, world.
    roll, pitch, yaw
        ZYX Euler angles, rad, usual signs.
    state
        State row to write. As in the original, ``ST_ACC`` keeps gravity: 1 g on z at rest.
    """
    state[ST_POS] = x
    state[ST_POS + 1] = y
    state[ST_POS + 2] = z
    state[ST_VEL] = vx
    state[ST_VEL + 1] = vy
    state[ST_VEL + 2] = vz

    ax = (vx - mem[MEM_VEL]) / _DT / _GRAVITY
    ay = (vy - mem[MEM_VEL + 1]) / _DT / _GRAVITY
    az = (vz - mem[MEM_VEL + 2]) / _DT / _GRAVITY + 1.0
    state[ST_ACC] = ax
    state[ST_ACC + 1] = ay
    state[ST_ACC + 2] = az

    gyro_coef = mem[MEM_GYRO_COEF:MEM_ACCEL_COEF]
    gyro_x = (roll - mem[MEM_RPY]) / _DT * _DEG
    gyro_y = (pitch - mem[MEM_RPY + 1]) / _DT * _DEG
    gyro_z = (yaw - mem[MEM_RPY + 2]) / _DT * _DEG
    at = MEM_GYRO_DELAY
    state[ST_GYRO] = lowpass.apply(gyro_coef, mem, at, gyro_x)
    state[ST_GYRO + 1] = lowpass.apply(gyro_coef, mem, at + 2, gyro_y)
    state[ST_GYRO + 2] = lowpass.apply(gyro_coef, mem, at + 4, gyro_z)

    state[ST_ATT] = roll * _DEG
    state[ST_ATT + 1] = -pitch * _DEG
    state[ST_ATT + 2] = yaw * _DEG

    cr, sr = math.cos(0.5 * roll), math.sin(0.5 * roll)
    cp, sp = math.cos(0.5 * pitch), math.sin(0.5 * pitch)
    cy, sy = math.cos(0.5 * yaw), math.sin(0.5 * yaw)
    state[ST_QUAT] = sr * cp * cy - cr * sp * sy
    state[ST_QUAT + 1] = cr * sp * cy + sr * cp * sy
    state[ST_QUAT + 2] = cr * cp * sy - sr * sp * cy
    state[ST_QUAT + 3] = cr * cp * cy + sr * sp * sy

    # The accelerometer sees the world acceleration through the transpose of Rx Ry Rz, not of
    # the true attitude Rz Ry Rx. Full angles from half angles.
    cr, sr = cr * cr - sr * sr, 2.0 * sr * cr
    cp, sp = cp * cp - sp * sp, 2.0 * sp * cp
    cy, sy = cy * cy - sy * sy, 2.0 * sy * cy
    by = cr * ay + sr * az  # about x
    bz = cr * az - sr * ay
    bx = cp * ax - sp * bz  # about y
    bz = cp * bz + sp * ax
    accel_coef = mem[MEM_ACCEL_COEF:MEM_GYRO_DELAY]
    at = MEM_ACCEL_DELAY
    state[ST_ACCEL] = lowpass.apply(accel_coef, mem, at, cy * bx + sy * by)
    state[ST_ACCEL + 1] = lowpass.apply(accel_coef, mem, at + 2, cy * by - sy * bx)
    state[ST_ACCEL + 2] = lowpass.apply(accel_coef, mem, at + 4, bz)

    mem[MEM_VEL] = vx
    mem[MEM_VEL + 1] = vy
    mem[MEM_VEL + 2] = vz
    mem[MEM_RPY] = roll
    mem[MEM_RPY + 1] = pitch
    mem[MEM_RPY + 2] = yaw


@kernel
def controller_tick(timing: np.ndarray, step: int) -> int:
    """Whether the controller runs at a step: ``TICK_BOTH``, ``TICK_ATTITUDE`` or ``TICK_SKIP``.

    Binary rounding of ``step / 500`` decides, which gives an irregular 312 Hz on average;
    changing the arithmetic here changes flights.

    Parameters
    ----------
    timing
        Times of the last executions (``TIMING_SIZE``, zeros at reset), updated.
    step
        Steps since reset, from 0.
    """
    now = step / STEP_RATE
    if now - timing[TIMING_ATTITUDE] > 0.002:
        timing[TIMING_ATTITUDE] = now
        if now - timing[TIMING_POSITION] > 0.01:
            timing[TIMING_POSITION] = now
            return TICK_BOTH
        return TICK_ATTITUDE
    return TICK_SKIP


@kernel
def step_due(step: int, control_step: int, control_rate: float) -> bool:
    """Whether environment step ``step`` (from 0) still belongs to a control step (from 0).

    A control step executes steps while this holds: 16 or 17 of them at 30 Hz.
    """
    period = 1.0 / control_rate
    return step / STEP_RATE < control_step * period + period
