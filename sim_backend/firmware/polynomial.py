"""Polynomial pieces in x, y, z and yaw, and the attitude rates that flying them needs.

A piece is 33 numbers: eight ascending coefficients each of x, y, z (m) and yaw (rad), then the
duration (s). Body rates follow from differential flatness of the quadrotor (Mellinger and
Kumar, "Minimum snap trajectory generation and control for quadrotors", ICRA 2011).
"""

from __future__ import annotations

import math

from crazyarena.jit import kernel

PIECE_SIZE = 33
PIECE_DURATION = 32

# An evaluated point of a trajectory, relative to where its row starts.
EV_POS = 0  # m
EV_VEL = 3  # m/s
EV_ACC = 6  # m/s2
EV_JERK = 9  # m/s3
EV_YAW = 12  # rad, not wrapped
EV_OMEGA = 13  # rad/s, body axes
EVAL_SIZE = 16

GRAVITY = 9.81


@kernel
def set_constant(row, base, axis, value):
    """Make one axis (0..3) of the piece at ``row[base:]`` stand at ``value``."""
    at = base + 8 * axis
    row[at] = value
    for k in range(1, 8):
        row[at + k] = 0.0


@kernel
def plan_axis(row, base, axis, duration, p0, v0, a0, p1, v1, a1):
    """Join two states of one axis by the degree-7 polynomial with zero jerk at both ends.

    Writes eight coefficients into the piece at ``row[base:]``. With ``duration`` <= 0 there is
    no way to go: the result is the parabola through the end state at local time 0.
    """
    at = base + 8 * axis
    if not duration > 0.0:
        row[at] = p1
        row[at + 1] = v1
        row[at + 2] = 0.5 * a1
        for k in range(3, 8):
            row[at + k] = 0.0
        return
    # What the upper four coefficients have to make up for, in units of normalised time.
    dp = p1 - (p0 + duration * (v0 + 0.5 * duration * a0))
    dv = (v1 - v0 - duration * a0) * duration
    da = (a1 - a0) * duration * duration
    inverse = 1.0 / duration
    inverse2 = inverse * inverse
    inverse4 = inverse2 * inverse2
    row[at] = p0
    row[at + 1] = v0
    row[at + 2] = 0.5 * a0
    row[at + 3] = 0.0
    row[at + 4] = (35.0 * dp - 15.0 * dv + 2.5 * da) * inverse4
    row[at + 5] = (-84.0 * dp + 39.0 * dv - 7.0 * da) * inverse4 * inverse
    row[at + 6] = (70.0 * dp - 34.0 * dv + 6.5 * da) * inverse4 * inverse2
    row[at + 7] = (-20.0 * dp + 10.0 * dv - 2.0 * da) * inverse4 * inverse2 * inverse


@kernel
def _evaluate_axis(row, at, t, rate):
    # Horner's scheme carried through three derivatives; d2 and d3 lack their factors 2 and 6.
    c7 = row[at + 7]
    p = c7 * t + row[at + 6]
    d1 = c7 * t + p
    d2 = c7 * t + d1
    d3 = c7 * t + d2
    p = p * t + row[at + 5]
    d1 = d1 * t + p
    d2 = d2 * t + d1
    d3 = d3 * t + d2
    p = p * t + row[at + 4]
    d1 = d1 * t + p
    d2 = d2 * t + d1
    d3 = d3 * t + d2
    p = p * t + row[at + 3]
    d1 = d1 * t + p
    d2 = d2 * t + d1
    d3 = d3 * t + d2
    p = p * t + row[at + 2]
    d1 = d1 * t + p
    d2 = d2 * t + d1
    p = p * t + row[at + 1]
    d1 = d1 * t + p
    p = p * t + row[at]
    rate2 = rate * rate
    return p, d1 * rate, 2.0 * d2 * rate2, 6.0 * d3 * rate2 * rate


@kernel
def body_rates(acc, jerk, yaw, yaw_rate):
    """Body rates (rad/s) of a thrust-only vehicle that follows acceleration, jerk and yaw.

    ``acc`` (m/s2, without gravity) and ``jerk`` (m/s3) are 3-tuples, world axes; yaw in rad.
    """
    tx = acc[0]
    ty = acc[1]
    tz = acc[2] + GRAVITY
    inverse = 1.0 / math.sqrt(tx * tx + ty * ty + tz * tz)
    zx = tx * inverse
    zy = ty * inverse
    zz = tz * inverse
    cos_yaw = math.cos(yaw)
    sin_yaw = math.sin(yaw)
    # y_b is normal to z_b and to the heading (cos, sin, 0).
    yx = -zz * sin_yaw
    yy = zz * cos_yaw
    yz = zx * sin_yaw - zy * cos_yaw
    norm = 1.0 / math.sqrt(yx * yx + yy * yy + yz * yz)
    yx *= norm
    yy *= norm
    yz *= norm
    xx = yy * zz - yz * zy
    xy = yz * zx - yx * zz
    xz = yx * zy - yy * zx
    # The part of the jerk along z_b changes the thrust and turns nothing; x_b and y_b are
    # normal to z_b, so it drops out of the products without being removed first.
    roll = -(jerk[0] * yx + jerk[1] * yy + jerk[2] * yz) * inverse
    pitch = (jerk[0] * xx + jerk[1] * xy + jerk[2] * xz) * inverse
    return roll, pitch, zz * yaw_rate


@kernel
def evaluate(row, base, t, rate, out, to):
    """Evaluate the piece at ``row[base:]`` and write an evaluated point to ``out[to:]``.

    Parameters
    ----------
    t: local time of the piece as stored, s.
    rate: d(t)/d(flight time): 1/timescale, negative when flown backwards.
    """
    at = base + 24
    yaw = row[at + 7]
    d = 0.0
    for k in range(6, -1, -1):
        d = d * t + yaw
        yaw = yaw * t + row[at + k]
    for axis in range(3):
        # Counted from `at`, a plain int: Numba compiles anew for every constant passed as such.
        p, v, acc, jerk = _evaluate_axis(row, at - 24 + 8 * axis, t, rate)
        out[to + EV_POS + axis] = p
        out[to + EV_VEL + axis] = v
        out[to + EV_ACC + axis] = acc
        out[to + EV_JERK + axis] = jerk
    acc_at, jerk_at = to + EV_ACC, to + EV_JERK
    roll, pitch, turn = body_rates(
        (out[acc_at], out[acc_at + 1], out[acc_at + 2]),
        (out[jerk_at], out[jerk_at + 1], out[jerk_at + 2]),
        yaw,
        d * rate,
    )
    out[to + EV_YAW] = yaw
    out[to + EV_OMEGA] = roll
    out[to + EV_OMEGA + 1] = pitch
    out[to + EV_OMEGA + 2] = turn


@kernel
def hold(row, base, t, out, to):
    """Write the point of a piece at local time ``t`` as an evaluated point standing still."""
    for k in range(EVAL_SIZE):
        out[to + k] = 0.0
    for axis in range(4):
        at = base + 8 * axis
        p = row[at + 7]
        for k in range(6, -1, -1):
            p = p * t + row[at + k]
        out[to + (EV_POS + axis if axis < 3 else EV_YAW)] = p
