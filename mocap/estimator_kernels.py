"""Compiled per-frame work of :mod:`crazyarena.mocap.estimator`.

One row of ``WIDTH`` float64 per body. Each axis of the position is a Kalman filter with
constant acceleration driven by white jerk (Bar-Shalom, Li & Kirubarajan, *Estimation with
Applications to Tracking and Navigation*, 2001, section 6.2.3); the three axes see the same
intervals and noise, so they share one covariance. The attitude is the multiplicative form of
the same filter (Markley 2003): the quaternion carries the attitude, three small body-frame
angles the error.
"""

from __future__ import annotations

import math

import numpy as np

from crazyarena.jit import kernel

# Columns of a row.
TIME = 0
POSITION = 1
VELOCITY = 4
ACCELERATION = 7
COVARIANCE = 10  # pp, pv, pa, vv, va, aa
QUATERNION = 16
RATE = 20
RATE_DOT = 23
ATTITUDE_COVARIANCE = 26
POSITION_SEEN = 32  # time of the last accepted position
ATTITUDE_SEEN = 33  # time of the last accepted attitude
STATUS = 34
CANDIDATES = 35  # consecutive consistent measurements that were not accepted
CANDIDATE = 36  # the last of them: position, quaternion
CANDIDATE_TIME = 43
CANDIDATE_FIRST = 44  # position of the first of them
CANDIDATE_FIRST_TIME = 47
CANDIDATE_FIRST_QUATERNION = 48
MEASURED = 52  # last measurement of any worth, to notice frozen ones
CHANGED = 59  # time at which it last differed from the one before
WIDTH = 60

# Values of STATUS.
NEVER = 0.0
TRACKED = 1.0
LOST = 2.0

# Entries of the settings vector.
POSITION_VARIANCE = 0
JERK_DENSITY = 1
ATTITUDE_VARIANCE = 2
RATE_JERK_DENSITY = 3
JUMP_GATE = 4
JUMP_GROWTH = 5
JUMP_LIMIT = 6
FLIP_GATE = 7
FLIP_GROWTH = 8
FLIP_LIMIT = 9
STALE_AFTER = 10
CONFIRM = 11
CANDIDATE_GATE = 12
CANDIDATE_SPEED = 13
MIN_UPRIGHT = 14
CORRECT_SWAPS = 15
FROZEN_AFTER = 16
SETTINGS = 17

# What became of a body in one frame.
ABSENT = 0
ACCEPTED = 1
JUMP = 2
FLIP = 3
ACQUIRED = 4
PENDING = 5
OLD = 6
FROZEN = 7

_njit = kernel(_nrt=True)


@_njit
def _predict_covariance(row, at, dt, density):
    pp = row[at]
    pv = row[at + 1]
    pa = row[at + 2]
    vv = row[at + 3]
    va = row[at + 4]
    aa = row[at + 5]
    d2 = dt * dt
    d3 = d2 * dt
    row[at] = (
        pp + 2.0 * dt * pv + d2 * (vv + pa) + d3 * va + 0.25 * d2 * d2 * aa
        + density * d3 * d2 / 20.0
    )  # fmt: skip
    row[at + 1] = pv + dt * (vv + pa) + 1.5 * d2 * va + 0.5 * d3 * aa + density * d2 * d2 / 8.0
    row[at + 2] = pa + dt * va + 0.5 * d2 * aa + density * d3 / 6.0
    row[at + 3] = vv + 2.0 * dt * va + d2 * aa + density * d3 / 3.0
    row[at + 4] = va + dt * aa + 0.5 * density * d2
    row[at + 5] = aa + density * dt


@_njit
def _update_covariance(row, at, variance):
    pp = row[at]
    pv = row[at + 1]
    pa = row[at + 2]
    inverse = 1.0 / (pp + variance)
    kp = pp * inverse
    kv = pv * inverse
    ka = pa * inverse
    row[at] = pp - kp * pp
    row[at + 1] = pv - kp * pv
    row[at + 2] = pa - kp * pa
    row[at + 3] -= kv * pv
    row[at + 4] -= kv * pa
    row[at + 5] -= ka * pa
    return kp, kv, ka


@_njit
def _turned(row, at, rx, ry, rz):
    """Quaternion at ``at`` turned by the body-frame rotation vector r."""
    angle = math.sqrt(rx * rx + ry * ry + rz * rz)
    scale = 0.5 if angle < 1e-9 else math.sin(0.5 * angle) / angle
    dx = rx * scale
    dy = ry * scale
    dz = rz * scale
    dw = math.cos(0.5 * angle)
    x = row[at]
    y = row[at + 1]
    z = row[at + 2]
    w = row[at + 3]
    qx = w * dx + x * dw + y * dz - z * dy
    qy = w * dy - x * dz + y * dw + z * dx
    qz = w * dz + x * dy - y * dx + z * dw
    qw = w * dw - x * dx - y * dy - z * dz
    norm = 1.0 / math.sqrt(qx * qx + qy * qy + qz * qz + qw * qw)
    return qx * norm, qy * norm, qz * norm, qw * norm


@_njit
def _between(ax, ay, az, aw, bx, by, bz, bw):
    """Rotation vector that turns quaternion a into b, in the frame of a; |r| <= pi."""
    ex = aw * bx - ax * bw - ay * bz + az * by
    ey = aw * by + ax * bz - ay * bw - az * bx
    ez = aw * bz - ax * by + ay * bx - az * bw
    ew = aw * bw + ax * bx + ay * by + az * bz
    if ew < 0.0:
        ex, ey, ez, ew = -ex, -ey, -ez, -ew
    sine = math.sqrt(ex * ex + ey * ey + ez * ez)
    scale = 2.0 if sine < 1e-12 else 2.0 * math.atan2(sine, ew) / sine
    return ex * scale, ey * scale, ez * scale


@_njit
def _is_unit(pose):
    """False for quaternions of the wrong length, and for NaN."""
    squared = pose[3] * pose[3] + pose[4] * pose[4] + pose[5] * pose[5] + pose[6] * pose[6]
    return abs(squared - 1.0) <= 0.01


@_njit
def _forecast_attitude(row, dt):
    half = 0.5 * dt * dt
    return _turned(
        row,
        QUATERNION,
        row[RATE] * dt + row[RATE_DOT] * half,
        row[RATE + 1] * dt + row[RATE_DOT + 1] * half,
        row[RATE + 2] * dt + row[RATE_DOT + 2] * half,
    )


@_njit
def _miss(row, pose, dt):
    """Distance between a measured position and its prediction."""
    total = 0.0
    for i in range(3):
        predicted = (
            row[POSITION + i] + row[VELOCITY + i] * dt + 0.5 * row[ACCELERATION + i] * dt * dt
        )
        total += (pose[i] - predicted) ** 2
    return math.sqrt(total)


@_njit
def _within_jump_gate(row, pose, time, settings):
    age = time - row[POSITION_SEEN]
    gate = settings[JUMP_GATE] + 0.5 * settings[JUMP_GROWTH] * age * age
    return _miss(row, pose, time - row[TIME]) <= min(gate, settings[JUMP_LIMIT])


@_njit
def _absorb(row, pose, time, settings):
    """Take one measurement that passed the jump gate; return ACCEPTED or FLIP."""
    dt = time - row[TIME]
    _predict_covariance(row, COVARIANCE, dt, settings[JERK_DENSITY])
    kp, kv, ka = _update_covariance(row, COVARIANCE, settings[POSITION_VARIANCE])
    for i in range(3):
        acceleration = row[ACCELERATION + i]
        velocity = row[VELOCITY + i] + acceleration * dt
        position = row[POSITION + i] + (row[VELOCITY + i] + 0.5 * acceleration * dt) * dt
        error = pose[i] - position
        row[POSITION + i] = position + kp * error
        row[VELOCITY + i] = velocity + kv * error
        row[ACCELERATION + i] = acceleration + ka * error
    qx, qy, qz, qw = _forecast_attitude(row, dt)
    age = time - row[ATTITUDE_SEEN]
    gate = settings[FLIP_GATE] + 0.5 * settings[FLIP_GROWTH] * age * age
    ex, ey, ez = _between(qx, qy, qz, qw, pose[3], pose[4], pose[5], pose[6])
    row[QUATERNION] = qx
    row[QUATERNION + 1] = qy
    row[QUATERNION + 2] = qz
    row[QUATERNION + 3] = qw
    for i in range(3):
        row[RATE + i] += row[RATE_DOT + i] * dt
    _predict_covariance(row, ATTITUDE_COVARIANCE, dt, settings[RATE_JERK_DENSITY])
    row[TIME] = time
    row[POSITION_SEEN] = time
    row[CANDIDATES] = 0.0
    turn = math.sqrt(ex * ex + ey * ey + ez * ez)
    if not (turn <= min(gate, settings[FLIP_LIMIT]) and _is_unit(pose)):
        if age > settings[STALE_AFTER]:
            # Nobody knows the rates any more; turning on would only lead astray.
            for i in range(3):
                row[RATE + i] = 0.0
                row[RATE_DOT + i] = 0.0
        return FLIP
    kp, kv, ka = _update_covariance(row, ATTITUDE_COVARIANCE, settings[ATTITUDE_VARIANCE])
    qx, qy, qz, qw = _turned(row, QUATERNION, kp * ex, kp * ey, kp * ez)
    row[QUATERNION] = qx
    row[QUATERNION + 1] = qy
    row[QUATERNION + 2] = qz
    row[QUATERNION + 3] = qw
    row[RATE] += kv * ex
    row[RATE + 1] += kv * ey
    row[RATE + 2] += kv * ez
    row[RATE_DOT] += ka * ex
    row[RATE_DOT + 1] += ka * ey
    row[RATE_DOT + 2] += ka * ez
    row[ATTITUDE_SEEN] = time
    return ACCEPTED


@_njit
def _start(row, pose, time, settings):
    """Begin a track from the run of candidates that ends with ``pose``."""
    span = time - row[CANDIDATE_FIRST_TIME]
    for i in range(3):
        row[POSITION + i] = pose[i]
        row[VELOCITY + i] = (pose[i] - row[CANDIDATE_FIRST + i]) / span if span > 0.0 else 0.0
        row[ACCELERATION + i] = 0.0
        row[RATE + i] = 0.0
        row[RATE_DOT + i] = 0.0
    if span > 0.0:
        first = CANDIDATE_FIRST_QUATERNION
        rx, ry, rz = _between(
            row[first], row[first + 1], row[first + 2], row[first + 3],
            pose[3], pose[4], pose[5], pose[6],
        )  # fmt: skip
        row[RATE] = rx / span
        row[RATE + 1] = ry / span
        row[RATE + 2] = rz / span
    for i in range(4):
        row[QUATERNION + i] = pose[3 + i]
    for at, variance in (
        (COVARIANCE, settings[POSITION_VARIANCE]),
        (ATTITUDE_COVARIANCE, settings[ATTITUDE_VARIANCE]),
    ):
        for i in range(6):
            row[at + i] = 0.0
        row[at] = variance
        row[at + 3] = 2.0 * variance / (span * span) + 1.0
        row[at + 5] = 400.0
    row[TIME] = time
    row[POSITION_SEEN] = time
    row[ATTITUDE_SEEN] = time
    row[STATUS] = TRACKED
    row[CANDIDATES] = 0.0


@_njit
def _offer(row, pose, time, settings):
    """Count a measurement that was not accepted; True when enough of them agree."""
    upright = 1.0 - 2.0 * (pose[3] * pose[3] + pose[4] * pose[4])
    if upright < settings[MIN_UPRIGHT] or not _is_unit(pose):
        row[CANDIDATES] = 0.0
        return False
    agrees = False
    if row[CANDIDATES] > 0.0 and time > row[CANDIDATE_TIME]:
        dt = time - row[CANDIDATE_TIME]
        total = 0.0
        for i in range(3):
            total += (pose[i] - row[CANDIDATE + i]) ** 2
        rx, ry, rz = _between(
            row[CANDIDATE + 3], row[CANDIDATE + 4], row[CANDIDATE + 5], row[CANDIDATE + 6],
            pose[3], pose[4], pose[5], pose[6],
        )  # fmt: skip
        gate = settings[CANDIDATE_GATE] + settings[CANDIDATE_SPEED] * dt
        agrees = (
            dt <= settings[STALE_AFTER]
            and math.sqrt(total) <= gate
            and math.sqrt(rx * rx + ry * ry + rz * rz) <= settings[FLIP_GATE]
        )
    if agrees:
        row[CANDIDATES] += 1.0
    else:
        row[CANDIDATES] = 1.0
        row[CANDIDATE_FIRST_TIME] = time
        for i in range(3):
            row[CANDIDATE_FIRST + i] = pose[i]
        for i in range(4):
            row[CANDIDATE_FIRST_QUATERNION + i] = pose[3 + i]
    row[CANDIDATE_TIME] = time
    for i in range(7):
        row[CANDIDATE + i] = pose[i]
    return row[CANDIDATES] >= settings[CONFIRM]


@_njit
def _is_frozen(row, pose, time, settings):
    """Keep account of measurements that do not change by a bit; True when for too long."""
    same = True
    for i in range(7):
        if row[MEASURED + i] != pose[i]:
            same = False
            row[MEASURED + i] = pose[i]
    if not same:
        row[CHANGED] = time
    return time - row[CHANGED] > settings[FROZEN_AFTER]


@_njit
def step(rows, poses, seen, time, settings, taken, outcome):
    """Advance every body by one frame.

    Parameters
    ----------
    rows: (b, WIDTH) states. poses: (b, 7) measured, position then quaternion, row i under the
    name of body i. seen: (b,) bool. time: capture time, s. settings: (SETTINGS,).
    taken: (b,) int, out: row of ``poses`` that body i took, -1 for none; other than i when
    the camera system had mixed up names. outcome: (b,) int, out.
    """
    count = rows.shape[0]
    for i in range(count):
        row = rows[i]
        taken[i] = -1
        if row[STATUS] == TRACKED and time - row[POSITION_SEEN] > settings[STALE_AFTER]:
            row[STATUS] = LOST
        if not seen[i]:
            outcome[i] = ABSENT
        elif _is_frozen(row, poses[i], time, settings):
            outcome[i] = FROZEN
        elif row[STATUS] != TRACKED:
            outcome[i] = PENDING
        elif time <= row[TIME]:
            outcome[i] = OLD
        elif _within_jump_gate(row, poses[i], time, settings):
            outcome[i] = ACCEPTED
            taken[i] = i
        else:
            outcome[i] = JUMP
    if settings[CORRECT_SWAPS] != 0.0:
        for i in range(count):
            if outcome[i] != JUMP:
                continue
            for j in range(count):
                if (
                    j != i
                    and taken[j] < 0
                    and rows[j, STATUS] == TRACKED
                    and (outcome[j] == JUMP or outcome[j] == ABSENT)
                    and time > rows[j, TIME]
                    and _within_jump_gate(rows[j], poses[i], time, settings)
                ):
                    taken[j] = i
                    break
    for i in range(count):
        if taken[i] >= 0:
            outcome[i] = _absorb(rows[i], poses[taken[i]], time, settings)
    for i in range(count):
        if outcome[i] == JUMP or outcome[i] == PENDING:
            # A pose that belongs to another tracked body is no candidate for this one.
            claimed = False
            for j in range(count):
                if taken[j] == i:
                    claimed = True
            if claimed:
                rows[i, CANDIDATES] = 0.0
            elif _offer(rows[i], poses[i], time, settings) and rows[i, STATUS] != TRACKED:
                _start(rows[i], poses[i], time, settings)
                outcome[i] = ACQUIRED
                taken[i] = i


@_njit
def extrapolate(rows, now, horizon, out):
    """Carry the states to ``now``, at most ``horizon`` s beyond their last measurement.

    out: (b, 13) position, velocity, quaternion, body rates.
    """
    for i in range(rows.shape[0]):
        row = rows[i]
        dt = min(max(now - row[TIME], 0.0), horizon)
        for k in range(3):
            a = row[ACCELERATION + k]
            out[i, k] = row[POSITION + k] + (row[VELOCITY + k] + 0.5 * a * dt) * dt
            out[i, 3 + k] = row[VELOCITY + k] + a * dt
            out[i, 10 + k] = row[RATE + k] + row[RATE_DOT + k] * dt
        out[i, 6], out[i, 7], out[i, 8], out[i, 9] = _forecast_attitude(row, dt)


def blank_rows(count: int) -> np.ndarray:
    """Return rows of bodies that were never seen."""
    rows = np.zeros((count, WIDTH))
    rows[:, QUATERNION + 3] = 1.0
    rows[:, CANDIDATE + 6] = 1.0
    rows[:, TIME] = -np.inf
    rows[:, POSITION_SEEN] = -np.inf
    rows[:, ATTITUDE_SEEN] = -np.inf
    return rows
