"""Extended Kalman filter of the 2026 firmware, fed by external positions and poses.

State: position (world, m), velocity (body, m/s), attitude error (rad) around a reference
quaternion; after Mueller, Hamer and D'Andrea, "Fusing ultra-wideband range measurements with
accelerometers and rate gyroscopes for quadrocopter state estimation", ICRA 2015, and Mueller,
Hehn and D'Andrea, "Covariance correction step for Kalman filtering with an attitude", JGCD 2017.

The filter of one vehicle is one float64 row of ``KALMAN_SIZE`` numbers. Measurements touch one
state each, so an update is a rank-one change of the covariance, and process noise is diagonal;
both are exploited. The covariance is kept exactly symmetric.
"""

from __future__ import annotations

import math

import numpy as np

from crazyarena.jit import kernel
from crazyarena.sim_backend.firmware.layout import (
    ST_ACC,
    ST_ACCEL,
    ST_ATT,
    ST_GYRO,
    ST_POS,
    ST_QUAT,
    ST_VEL,
)
from crazyarena.sim_backend.firmware.parameters import Param

PARAMS = (
    Param("kalman.initialX", None, 0.0),
    Param("kalman.initialY", None, 0.0),
    Param("kalman.initialZ", None, 0.0),
    Param("kalman.initialYaw", None, 0.0),
    Param("kalman.pNAcc_xy", None, 0.5),
    Param("kalman.pNAcc_z", None, 1.0),
    Param("kalman.pNVel", None, 0.0),
    Param("kalman.pNPos", None, 0.0),
    Param("kalman.pNAtt", None, 0.0),
    Param("kalman.mNGyro_rollpitch", None, 0.1),
    Param("kalman.mNGyro_yaw", None, 0.1),
    Param("kalman.maxPos", None, 100.0),
    Param("kalman.maxVel", None, 10.0),
    Param("kalman.resetEstimation", None, 0.0, "uint8"),
    Param("locSrv.extPosStdDev", None, 0.01),
    Param("locSrv.extQuatStdDev", None, 4.5e-3),
)
(
    KP_INITIAL_X,
    KP_INITIAL_Y,
    KP_INITIAL_Z,
    KP_INITIAL_YAW,
    KP_ACC_XY,
    KP_ACC_Z,
    KP_VEL,
    KP_POS,
    KP_ATT,
    KP_GYRO_RP,
    KP_GYRO_YAW,
    KP_MAX_POS,
    KP_MAX_VEL,
    KP_RESET,
    KP_EXT_POS_STD,
    KP_EXT_QUAT_STD,
) = range(16)

# Memory row.
KM_S = 0  # position 3 (world), velocity 3 (body), attitude error 3
KM_Q = 9  # w, x, y, z, body to world
KM_R = 13  # rotation matrix of KM_Q, row-major
KM_Q0 = 22  # w, x, y, z at the last reset
KM_SUM_ACC = 26  # g, sum of the samples since the last prediction
KM_SUM_GYRO = 29  # deg/s, likewise
KM_SAMPLES = 32
KM_NEXT = 33  # ms, when the next prediction is due
KM_PREDICTED = 34  # ms, time of the last prediction
KM_NOISED = 35  # ms, time of the last process noise
KM_CHANGED = 36  # 1.0 when the estimate changed since the last finalize
KM_STALE = 37  # 1.0 when the estimate changed since it was last written to a state row
KM_REVERSION = 38  # pull of the attitude towards KM_Q0 while on the ground, per prediction
KM_P = 39  # covariance, 9 x 9 row-major
KM_COLUMN = KM_P + 81  # scratch of an update
KM_RESIDUAL = KM_COLUMN + 9  # scratch: attitude error of a measured quaternion
KALMAN_SIZE = KM_RESIDUAL + 3

# Kinds of measurement.
MEAS_NONE = 0
MEAS_POSE = 1
MEAS_POSITION = 2
MEAS_FLOW = 3

ATTITUDE_REVERSION = 1e-3
GRAVITY = 9.81
_RAD = math.pi / 180.0
_DEG = 180.0 / math.pi
_EPS = 1e-6  # the firmware adds this to angles and norms before dividing by them
_MAX_COVARIANCE = 100.0
_MIN_COVARIANCE = 1e-6
_STD_POS_XY, _STD_POS_Z, _STD_VEL, _STD_ATT = 100.0, 1.0, 0.01, 0.01
_PREDICT_MS = 10.0


def kalman_memory() -> np.ndarray:
    """Return an empty memory row; :func:`kalman_init` makes it usable."""
    memory = np.zeros(KALMAN_SIZE)
    memory[KM_REVERSION] = ATTITUDE_REVERSION
    return memory


@kernel
def _rotation_from_quaternion(m):
    w, x, y, z = m[KM_Q], m[KM_Q + 1], m[KM_Q + 2], m[KM_Q + 3]
    m[KM_R] = w * w + x * x - y * y - z * z
    m[KM_R + 1] = 2.0 * (x * y - w * z)
    m[KM_R + 2] = 2.0 * (x * z + w * y)
    m[KM_R + 3] = 2.0 * (x * y + w * z)
    m[KM_R + 4] = w * w - x * x + y * y - z * z
    m[KM_R + 5] = 2.0 * (y * z - w * x)
    m[KM_R + 6] = 2.0 * (x * z - w * y)
    m[KM_R + 7] = 2.0 * (y * z + w * x)
    m[KM_R + 8] = w * w - x * x - y * y + z * z


@kernel
def kalman_init(m, p, now_ms):
    """Reset the filter to the initial position and yaw of its parameters.

    Parameters
    ----------
    m: memory row; only KM_REVERSION survives.
    p: parameter row in the order of ``PARAMS``.
    now_ms: firmware clock, ms.
    """
    reversion = m[KM_REVERSION]
    for i in range(KALMAN_SIZE):
        m[i] = 0.0
    m[KM_REVERSION] = reversion
    m[KM_S] = p[KP_INITIAL_X]
    m[KM_S + 1] = p[KP_INITIAL_Y]
    m[KM_S + 2] = p[KP_INITIAL_Z]
    m[KM_Q] = math.cos(0.5 * p[KP_INITIAL_YAW])
    m[KM_Q + 3] = math.sin(0.5 * p[KP_INITIAL_YAW])
    for i in range(4):
        m[KM_Q0 + i] = m[KM_Q + i]
    _rotation_from_quaternion(m)
    for i in range(9):
        std = _STD_ATT
        if i < 2:
            std = _STD_POS_XY
        elif i == 2:
            std = _STD_POS_Z
        elif i < 6:
            std = _STD_VEL
        m[KM_P + 10 * i] = std * std
    m[KM_NEXT] = now_ms
    m[KM_PREDICTED] = now_ms
    m[KM_NOISED] = now_ms
    m[KM_STALE] = 1.0


@kernel
def kalman_accumulate(m, state):
    """Add one sample of ``state``'s ST_ACCEL (g) and ST_GYRO (deg/s)."""
    for i in range(3):
        m[KM_SUM_ACC + i] += state[ST_ACCEL + i]
        m[KM_SUM_GYRO + i] += state[ST_GYRO + i]
    m[KM_SAMPLES] += 1.0


@kernel
def _bound(value):
    # A NaN is taken for "knows nothing", as the firmware does.
    if value <= _MAX_COVARIANCE:
        return value
    return _MAX_COVARIANCE


@kernel
def _bound_variance(value):
    return max(_bound(value), _MIN_COVARIANCE)


@kernel
def _error_matrix(e0, e1, e2):
    """Second-order transport of the attitude error through a rotation by 2 e (JGCD 2017)."""
    return (
        1.0 - 0.5 * (e1 * e1 + e2 * e2),
        e2 + 0.5 * e0 * e1,
        -e1 + 0.5 * e0 * e2,
        -e2 + 0.5 * e0 * e1,
        1.0 - 0.5 * (e0 * e0 + e2 * e2),
        e0 + 0.5 * e1 * e2,
        e1 + 0.5 * e0 * e2,
        -e0 + 0.5 * e1 * e2,
        1.0 - 0.5 * (e0 * e0 + e1 * e1),
    )


@kernel
def _turn(m, vx, vy, vz, reversion):
    """Turn the quaternion by the body-frame rotation vector, then pull it to its start."""
    angle = math.sqrt(vx * vx + vy * vy + vz * vz) + _EPS
    c = math.cos(0.5 * angle)
    s = math.sin(0.5 * angle) / angle
    x, y, z = s * vx, s * vy, s * vz
    q0, q1, q2, q3 = m[KM_Q], m[KM_Q + 1], m[KM_Q + 2], m[KM_Q + 3]
    w = c * q0 - x * q1 - y * q2 - z * q3
    i = x * q0 + c * q1 + z * q2 - y * q3
    j = y * q0 - z * q1 + c * q2 + x * q3
    k = z * q0 + y * q1 - x * q2 + c * q3
    if reversion > 0.0:
        keep = 1.0 - reversion
        w = keep * w + reversion * m[KM_Q0]
        i = keep * i + reversion * m[KM_Q0 + 1]
        j = keep * j + reversion * m[KM_Q0 + 2]
        k = keep * k + reversion * m[KM_Q0 + 3]
    norm = math.sqrt(w * w + i * i + j * j + k * k) + _EPS
    m[KM_Q] = w / norm
    m[KM_Q + 1] = i / norm
    m[KM_Q + 2] = j / norm
    m[KM_Q + 3] = k / norm


@kernel
def _predict_covariance(m, dt, wx, wy, wz):
    """P <- A P A^T by the block structure of A, with the estimate before the prediction."""
    vx, vy, vz = m[KM_S + 3], m[KM_S + 4], m[KM_S + 5]
    gx, gy, gz = (
        GRAVITY * dt * m[KM_R + 6],
        GRAVITY * dt * m[KM_R + 7],
        GRAVITY * dt * m[KM_R + 8],
    )
    tx, ty, tz = dt * wx, dt * wy, dt * wz
    e00, e01, e02, e10, e11, e12, e20, e21, e22 = _error_matrix(0.5 * tx, 0.5 * ty, 0.5 * tz)
    # A times each column of P, then A times each row of the result; in place, as either pass
    # mixes only the nine numbers it holds.
    for sweep in range(2):
        step = 9 if sweep == 0 else 1
        for c in range(9):
            o = KM_P + (c if sweep == 0 else 9 * c)
            v0, v1, v2 = m[o + 3 * step], m[o + 4 * step], m[o + 5 * step]
            d0, d1, d2 = m[o + 6 * step], m[o + 7 * step], m[o + 8 * step]
            b0 = dt * (v0 + vz * d1 - vy * d2)
            b1 = dt * (v1 + vx * d2 - vz * d0)
            b2 = dt * (v2 + vy * d0 - vx * d1)
            m[o] += m[KM_R] * b0 + m[KM_R + 1] * b1 + m[KM_R + 2] * b2
            m[o + step] += m[KM_R + 3] * b0 + m[KM_R + 4] * b1 + m[KM_R + 5] * b2
            m[o + 2 * step] += m[KM_R + 6] * b0 + m[KM_R + 7] * b1 + m[KM_R + 8] * b2
            m[o + 3 * step] = v0 + tz * v1 - ty * v2 + gz * d1 - gy * d2
            m[o + 4 * step] = v1 + tx * v2 - tz * v0 + gx * d2 - gz * d0
            m[o + 5 * step] = v2 + ty * v0 - tx * v1 + gy * d0 - gx * d1
            m[o + 6 * step] = e00 * d0 + e01 * d1 + e02 * d2
            m[o + 7 * step] = e10 * d0 + e11 * d1 + e12 * d2
            m[o + 8 * step] = e20 * d0 + e21 * d1 + e22 * d2
    for i in range(9):
        for j in range(i + 1, 9):
            value = _bound(0.5 * (m[KM_P + 9 * i + j] + m[KM_P + 9 * j + i]))
            m[KM_P + 9 * i + j] = value
            m[KM_P + 9 * j + i] = value


@kernel
def kalman_predict(m, now_ms, flying):
    """Advance the estimate to ``now_ms`` with the mean of the accumulated samples.

    Parameters
    ----------
    flying: in flight only the thrust axis of the accelerometer is trusted; on the ground all
        three are, and the attitude is pulled towards its start.
    """
    dt = 1e-3 * (now_ms - m[KM_PREDICTED])
    m[KM_PREDICTED] = now_ms
    count = max(m[KM_SAMPLES], 1.0)
    scale_acc, scale_gyro = GRAVITY / count, _RAD / count
    ax, ay, az = (
        scale_acc * m[KM_SUM_ACC],
        scale_acc * m[KM_SUM_ACC + 1],
        scale_acc * m[KM_SUM_ACC + 2],
    )
    wx, wy, wz = (
        scale_gyro * m[KM_SUM_GYRO],
        scale_gyro * m[KM_SUM_GYRO + 1],
        scale_gyro * m[KM_SUM_GYRO + 2],
    )
    for i in range(KM_SUM_ACC, KM_SAMPLES + 1):
        m[i] = 0.0
    _predict_covariance(m, dt, wx, wy, wz)
    if flying:
        ax = 0.0
        ay = 0.0
    vx, vy, vz = m[KM_S + 3], m[KM_S + 4], m[KM_S + 5]
    dx = dt * (vx + 0.5 * dt * ax)
    dy = dt * (vy + 0.5 * dt * ay)
    dz = dt * (vz + 0.5 * dt * az)
    m[KM_S] += m[KM_R] * dx + m[KM_R + 1] * dy + m[KM_R + 2] * dz
    m[KM_S + 1] += m[KM_R + 3] * dx + m[KM_R + 4] * dy + m[KM_R + 5] * dz
    m[KM_S + 2] += m[KM_R + 6] * dx + m[KM_R + 7] * dy + m[KM_R + 8] * dz - 0.5 * GRAVITY * dt * dt
    m[KM_S + 3] += dt * (ax + vy * wz - vz * wy - GRAVITY * m[KM_R + 6])
    m[KM_S + 4] += dt * (ay + vz * wx - vx * wz - GRAVITY * m[KM_R + 7])
    m[KM_S + 5] += dt * (az + vx * wy - vy * wx - GRAVITY * m[KM_R + 8])
    _turn(m, dt * wx, dt * wy, dt * wz, 0.0 if flying else m[KM_REVERSION])
    m[KM_CHANGED] = 1.0


@kernel
def kalman_process_noise(m, p, now_ms):
    """Add the process noise of the time since the last call (diagonal only)."""
    dt = 1e-3 * (now_ms - m[KM_NOISED])
    m[KM_NOISED] = now_ms
    drift = p[KP_VEL] * dt + p[KP_POS]
    xy = p[KP_ACC_XY] * dt * dt + drift
    z = p[KP_ACC_Z] * dt * dt + drift
    vxy = p[KP_ACC_XY] * dt + p[KP_VEL]
    vz = p[KP_ACC_Z] * dt + p[KP_VEL]
    rp = p[KP_GYRO_RP] * dt + p[KP_ATT]
    yaw = p[KP_GYRO_YAW] * dt + p[KP_ATT]
    m[KM_P] = _bound_variance(m[KM_P] + xy * xy)
    m[KM_P + 10] = _bound_variance(m[KM_P + 10] + xy * xy)
    m[KM_P + 20] = _bound_variance(m[KM_P + 20] + z * z)
    m[KM_P + 30] = _bound_variance(m[KM_P + 30] + vxy * vxy)
    m[KM_P + 40] = _bound_variance(m[KM_P + 40] + vxy * vxy)
    m[KM_P + 50] = _bound_variance(m[KM_P + 50] + vz * vz)
    m[KM_P + 60] = _bound_variance(m[KM_P + 60] + rp * rp)
    m[KM_P + 70] = _bound_variance(m[KM_P + 70] + rp * rp)
    m[KM_P + 80] = _bound_variance(m[KM_P + 80] + yaw * yaw)


@kernel
def _update(m, k, error, std):
    """Fuse a measurement of state ``k`` alone; works on the upper triangle of P.

    With the optimal gain, Joseph's form of the covariance is P - P_k P_k^T / (P_kk + std^2).
    """
    inverse = 1.0 / (m[KM_P + 10 * k] + std * std)
    for i in range(9):
        m[KM_COLUMN + i] = m[KM_P + 9 * min(i, k) + max(i, k)]
    for i in range(9):
        gain = m[KM_COLUMN + i] * inverse
        m[KM_S + i] += gain * error
        m[KM_P + 10 * i] = _bound_variance(m[KM_P + 10 * i] - gain * m[KM_COLUMN + i])
        for j in range(i + 1, 9):
            m[KM_P + 9 * i + j] = _bound(m[KM_P + 9 * i + j] - gain * m[KM_COLUMN + j])


@kernel
def kalman_measure(m, kind, measurement, std_position, std_quaternion):
    """Fuse an external position (std in m) and, for MEAS_POSE, a quaternion (std in rad).

    ``measurement`` (7,) is position (m, world) and quaternion x, y, z, w. For MEAS_FLOW it is
    velocity x, y (m/s, body), height (m), and their standard deviations (m/s, m).
    """
    m[KM_CHANGED] = 1.0
    # One call in a loop, as the compiler would make six copies of the update.
    for n in range(6 if kind == MEAS_POSE else 3):
        if kind == MEAS_FLOW:
            state = 2 if n == 2 else n + 3
            error = measurement[n] - m[KM_S + state]
            _update(m, state, error, measurement[4 if n == 2 else 3])
            continue
        if n == 3:
            w, i, j, k = m[KM_Q], m[KM_Q + 1], m[KM_Q + 2], m[KM_Q + 3]
            qx, qy, qz, qw = measurement[3], measurement[4], measurement[5], measurement[6]
            # Residual conj(q) * q_measured: a rotation in the body frame, fixed from here on.
            rw = w * qw + i * qx + j * qy + k * qz
            if rw == 0.0:
                break
            m[KM_RESIDUAL] = 2.0 * (w * qx - i * qw - j * qz + k * qy) / rw
            m[KM_RESIDUAL + 1] = 2.0 * (w * qy + i * qz - j * qw - k * qx) / rw
            m[KM_RESIDUAL + 2] = 2.0 * (w * qz - i * qy + j * qx - k * qw) / rw
        state, error, std = n, measurement[n] - m[KM_S + n], std_position
        if n >= 3:
            state, error, std = n + 3, m[KM_RESIDUAL + n - 3], std_quaternion
        _update(m, state, error, std)
    for i in range(9):
        for j in range(i + 1, 9):
            m[KM_P + 9 * j + i] = m[KM_P + 9 * i + j]


@kernel
def kalman_finalize(m):
    """Move the attitude error into the quaternion, if anything changed since the last call."""
    if m[KM_CHANGED] == 0.0:
        return
    m[KM_CHANGED] = 0.0
    m[KM_STALE] = 1.0
    d0, d1, d2 = m[KM_S + 6], m[KM_S + 7], m[KM_S + 8]
    largest = max(abs(d0), abs(d1), abs(d2))
    if largest > 1e-4 and largest < 10.0:
        _turn(m, d0, d1, d2, 0.0)
        e00, e01, e02, e10, e11, e12, e20, e21, e22 = _error_matrix(0.5 * d0, 0.5 * d1, 0.5 * d2)
        for sweep in range(2):
            step = 9 if sweep == 0 else 1
            for c in range(9):
                o = KM_P + (c if sweep == 0 else 9 * c) + 6 * step
                d0, d1, d2 = m[o], m[o + step], m[o + 2 * step]
                m[o] = e00 * d0 + e01 * d1 + e02 * d2
                m[o + step] = e10 * d0 + e11 * d1 + e12 * d2
                m[o + 2 * step] = e20 * d0 + e21 * d1 + e22 * d2
        for i in range(9):
            m[KM_P + 10 * i] = _bound_variance(m[KM_P + 10 * i])
            for j in range(max(i + 1, 6), 9):
                value = _bound(0.5 * (m[KM_P + 9 * i + j] + m[KM_P + 9 * j + i]))
                m[KM_P + 9 * i + j] = value
                m[KM_P + 9 * j + i] = value
    _rotation_from_quaternion(m)
    m[KM_S + 6] = 0.0
    m[KM_S + 7] = 0.0
    m[KM_S + 8] = 0.0


@kernel
def kalman_externalize(m, state):
    """Write the estimate into ``state``; ST_ACC from its present accelerometer sample."""
    ax, ay, az = state[ST_ACCEL], state[ST_ACCEL + 1], state[ST_ACCEL + 2]
    state[ST_ACC] = m[KM_R] * ax + m[KM_R + 1] * ay + m[KM_R + 2] * az
    state[ST_ACC + 1] = m[KM_R + 3] * ax + m[KM_R + 4] * ay + m[KM_R + 5] * az
    state[ST_ACC + 2] = m[KM_R + 6] * ax + m[KM_R + 7] * ay + m[KM_R + 8] * az - 1.0
    if m[KM_STALE] == 0.0:
        return
    m[KM_STALE] = 0.0
    vx, vy, vz = m[KM_S + 3], m[KM_S + 4], m[KM_S + 5]
    for i in range(3):
        state[ST_POS + i] = m[KM_S + i]
        row = KM_R + 3 * i
        state[ST_VEL + i] = m[row] * vx + m[row + 1] * vy + m[row + 2] * vz
        state[ST_QUAT + i] = m[KM_Q + 1 + i]
    state[ST_QUAT + 3] = m[KM_Q]
    state[ST_ATT] = _DEG * math.atan2(m[KM_R + 7], m[KM_R + 8])
    state[ST_ATT + 1] = _DEG * math.asin(min(max(m[KM_R + 6], -1.0), 1.0))
    state[ST_ATT + 2] = _DEG * math.atan2(m[KM_R + 3], m[KM_R])


@kernel
def kalman_out_of_bounds(m, p):
    """True when the estimate is beyond the position or velocity limit, or not a number."""
    for i in range(3):
        if not abs(m[KM_S + i]) <= p[KP_MAX_POS] or not abs(m[KM_S + 3 + i]) <= p[KP_MAX_VEL]:
            return True
    return False


@kernel
def kalman_advance(m, p, state, now_ms, flying):
    """First half of a pass of the estimator task (1000 Hz): predict and take the new sample.

    Parameters
    ----------
    m: memory row, p: parameter row of ``PARAMS``.
    state: state row, of which ST_ACCEL and ST_GYRO are read.
    now_ms: firmware clock, ms.
    flying: as the supervisor sees it.
    """
    if p[KP_RESET] != 0.0:
        kalman_init(m, p, now_ms)
        p[KP_RESET] = 0.0
    if now_ms >= m[KM_NEXT]:
        kalman_predict(m, now_ms, flying)
        m[KM_NEXT] = now_ms + _PREDICT_MS
    kalman_process_noise(m, p, now_ms)
    kalman_accumulate(m, state)


@kernel
def kalman_complete(m, p, state, now_ms):
    """Second half, after any :func:`kalman_measure`: write the estimate into ``state``.

    There is no outlier rejection: a wrong pose moves the estimate, as on the vehicle. An
    estimate beyond the limits of ``kalman.maxPos`` and ``kalman.maxVel`` resets the filter.
    """
    kalman_finalize(m)
    kalman_externalize(m, state)
    if kalman_out_of_bounds(m, p):
        kalman_init(m, p, now_ms)
