"""The trajectory that a vehicle is following: planned pieces and uploaded trajectories.

One row of memory per vehicle holds the planner state and, decoded, the one piece that is being
flown; the uploaded trajectories stay in the vehicle's 4096-byte trajectory memory as they came
in and are read there at every change of piece.

Times are seconds in single precision, as on the vehicle: at 120 s they step by 8 microseconds.

Compressed trajectories are chains of Bezier curves in integer millimetres; the segment layout
is that of the public "trajectory formats" page of the Crazyflie documentation.
"""

from __future__ import annotations

import math

import numpy as np

from crazyarena.jit import kernel
from crazyarena.sim_backend.firmware.polynomial import (
    EV_ACC,
    EV_OMEGA,
    EV_POS,
    EV_VEL,
    EV_YAW,
    EVAL_SIZE,
    PIECE_DURATION,
    PIECE_SIZE,
    evaluate,
    hold,
    plan_axis,
    set_constant,
)

TRAJECTORY_MEMORY_SIZE = 4096
PIECE_BYTES = 132  # 33 float32
COMPRESSED_HEAD_BYTES = 8  # start point, four int16
SEGMENT_HEAD_BYTES = 3  # types, duration

# Planner states, as the firmware numbers them.
IDLE, FLYING, LANDING, DISABLED = 0.0, 1.0, 3.0, 4.0

# What is being followed.
KIND_NONE, KIND_PLANNED, KIND_PIECES, KIND_COMPRESSED = 0.0, 1.0, 2.0, 3.0

# Planner memory.
PL_STATE = 0
PL_KIND = 1
PL_BEGIN = 2  # start time, s
PL_SCALE = 3  # stretches time
PL_REVERSED = 4
PL_SHIFT = 5  # m, added to positions (3)
PL_TURN = 8  # rad about the world z axis, with its cosine and sine (3)
PL_OFFSET = 11  # bytes, where the trajectory starts in the trajectory memory
PL_COUNT = 12  # pieces
PL_INDEX = 13  # piece in PL_PIECE; -1 none, PL_COUNT when past the end
PL_FROM = 14  # local time at which the piece in PL_PIECE begins, s
PL_TO = 15  # and ends
PL_CURSOR = 16  # bytes, next compressed segment
PL_LAST = 17  # end point of the compressed segment before (4)
PL_YAW_UNIT = 21  # rad per stored unit of compressed yaw
PL_PIECE = 22
PL_EVAL = PL_PIECE + PIECE_SIZE
PLANNER_SIZE = PL_EVAL + EVAL_SIZE

# Single-precision time sums can disagree by this much about where a piece ends.
_TIME_SLACK = 1e-4

_FACTORIAL = (1.0, 1.0, 2.0, 6.0, 24.0, 120.0, 720.0, 5040.0)


@kernel
def since(mem, t):
    """Seconds since the trajectory began, at single precision."""
    return np.float32(t) - np.float32(mem[PL_BEGIN])


@kernel
def _read_float(memory, at):
    bits = (
        np.uint32(memory[at])
        | (np.uint32(memory[at + 1]) << np.uint32(8))
        | (np.uint32(memory[at + 2]) << np.uint32(16))
        | (np.uint32(memory[at + 3]) << np.uint32(24))
    )
    return np.uint32(bits).view(np.float32)


@kernel
def _read_int16(memory, at):
    value = int(memory[at]) | (int(memory[at + 1]) << 8)
    return float(value - 65536 if value >= 32768 else value)


@kernel
def _stretched_duration(mem, memory, piece):
    at = int(mem[PL_OFFSET]) + PIECE_BYTES * piece + 4 * PIECE_DURATION
    return _read_float(memory, at) * np.float32(mem[PL_SCALE])


@kernel
def _load_piece(mem, memory, piece):
    at = int(mem[PL_OFFSET]) + PIECE_BYTES * piece
    for k in range(PIECE_SIZE):
        mem[PL_PIECE + k] = _read_float(memory, at + 4 * k)


@kernel
def _follow(mem, kind, t):
    mem[PL_KIND] = kind
    mem[PL_BEGIN] = np.float32(t)
    mem[PL_SCALE] = 1.0
    mem[PL_REVERSED] = 0.0
    for k in range(3):
        mem[PL_SHIFT + k] = 0.0
    mem[PL_TURN] = 0.0
    mem[PL_TURN + 1] = 1.0
    mem[PL_TURN + 2] = 0.0
    mem[PL_INDEX] = -1.0


@kernel
def _seek_piece(mem, memory, local):
    # Walks the stretched durations from the start, in single precision like the vehicle.
    count = int(mem[PL_COUNT])
    reverse = mem[PL_REVERSED] != 0.0
    remaining = local
    for k in range(count):
        piece = count - 1 - k if reverse else k
        length = _stretched_duration(mem, memory, piece)
        if remaining <= length:
            if mem[PL_INDEX] != piece:
                _load_piece(mem, memory, piece)
                mem[PL_INDEX] = piece
            mem[PL_FROM] = local - remaining
            mem[PL_TO] = mem[PL_FROM] + length
            return
        remaining -= length
    _load_piece(mem, memory, 0 if reverse else count - 1)
    mem[PL_INDEX] = count
    mem[PL_FROM] = local - remaining
    mem[PL_TO] = math.inf


@kernel
def _decode_axis(mem, memory, axis, points, at, unit, duration):
    # From Bezier control points (the first is the end of the segment before) to powers of t.
    base = PL_PIECE + 8 * axis
    first = mem[PL_LAST + axis]
    for j in range(8):
        mem[base + j] = 0.0
    mem[base] = first
    inverse = 1.0 / duration
    power = 1.0
    for j in range(1, points + 1):
        power *= inverse
        total = 0.0
        for i in range(j + 1):
            x = first if i == 0 else _read_int16(memory, at + 2 * (i - 1)) * unit
            sign = 1.0 if (i + j) % 2 == 0 else -1.0
            total += sign * x / (_FACTORIAL[i] * _FACTORIAL[j - i])
        mem[base + j] = _FACTORIAL[points] / _FACTORIAL[points - j] * total * power
    if points > 0:
        mem[PL_LAST + axis] = _read_int16(memory, at + 2 * (points - 1)) * unit


@kernel
def _next_segment(mem, memory):
    """Decode the segment at the cursor; past the end, stand at the last end point for ever."""
    at = int(mem[PL_CURSOR])
    mem[PL_FROM] = mem[PL_TO]
    milliseconds = 0
    if at + SEGMENT_HEAD_BYTES <= TRAJECTORY_MEMORY_SIZE:
        kinds = int(memory[at])
        milliseconds = int(memory[at + 1]) | (int(memory[at + 2]) << 8)
        at += SEGMENT_HEAD_BYTES
        total = 0
        for axis in range(4):
            total += (1 << ((kinds >> (2 * axis)) & 3)) - 1
        if at + 2 * total > TRAJECTORY_MEMORY_SIZE:
            milliseconds = 0
    if milliseconds == 0:
        for axis in range(4):
            set_constant(mem, PL_PIECE, axis, mem[PL_LAST + axis])
        mem[PL_INDEX] = mem[PL_COUNT]
        mem[PL_TO] = math.inf
        return
    duration = milliseconds / 1000.0
    for axis in range(4):
        # Kinds 0..3 have 0, 1, 3 and 7 further control points.
        points = (1 << ((kinds >> (2 * axis)) & 3)) - 1
        unit = mem[PL_YAW_UNIT] if axis == 3 else 1e-3
        _decode_axis(mem, memory, axis, points, at, unit, duration)
        at += 2 * points
    mem[PL_CURSOR] = at
    mem[PL_INDEX] = 0.0
    mem[PL_TO] = mem[PL_FROM] + np.float32(duration)


@kernel
def _seek_segment(mem, memory, local):
    if mem[PL_INDEX] < 0.0 or local < mem[PL_FROM]:
        start = int(mem[PL_OFFSET])
        for axis in range(4):
            unit = mem[PL_YAW_UNIT] if axis == 3 else 1e-3
            mem[PL_LAST + axis] = _read_int16(memory, start + 2 * axis) * unit
        mem[PL_CURSOR] = start + COMPRESSED_HEAD_BYTES
        mem[PL_TO] = 0.0
        _next_segment(mem, memory)
    while local >= mem[PL_TO]:
        _next_segment(mem, memory)


@kernel
def evaluate_plan(mem, memory, t):
    """Evaluate the trajectory at time ``t`` (s) into ``mem[PL_EVAL:]``.

    Past its end a trajectory stands still at its last point.
    """
    local = float(since(mem, t))
    kind = mem[PL_KIND]
    u = local
    rate = 1.0
    ended = False
    if kind == KIND_PLANNED:
        duration = mem[PL_PIECE + PIECE_DURATION]
        if local > duration:
            ended = True
            u = duration
    elif kind == KIND_COMPRESSED:
        if mem[PL_INDEX] < 0.0 or local < mem[PL_FROM] or local >= mem[PL_TO]:
            _seek_segment(mem, memory, local)
        ended = mem[PL_INDEX] == mem[PL_COUNT]
        u = 0.0 if ended else local - mem[PL_FROM]
    else:
        inside = local > mem[PL_FROM] + _TIME_SLACK and local < mem[PL_TO] - _TIME_SLACK
        if mem[PL_INDEX] < 0.0 or not inside:
            _seek_piece(mem, memory, np.float32(local))
        reverse = mem[PL_REVERSED] != 0.0
        ended = mem[PL_INDEX] == mem[PL_COUNT]
        if ended:
            u = 0.0 if reverse else mem[PL_PIECE + PIECE_DURATION]
        else:
            rate = 1.0 / mem[PL_SCALE]
            if reverse:
                u = (mem[PL_TO] - local) * rate
                rate = -rate
            else:
                u = (local - mem[PL_FROM]) * rate
    if ended:
        hold(mem, PL_PIECE, u, mem, PL_EVAL)
    else:
        evaluate(mem, PL_PIECE, u, rate, mem, PL_EVAL)
    if kind != KIND_PLANNED:
        if mem[PL_TURN] != 0.0 and mem[PL_REVERSED] == 0.0:
            _turn(mem, PL_EVAL + EV_POS)
            _turn(mem, PL_EVAL + EV_VEL)
            _turn(mem, PL_EVAL + EV_ACC)
            mem[PL_EVAL + EV_YAW] += mem[PL_TURN]
        for k in range(3):
            mem[PL_EVAL + EV_POS + k] += mem[PL_SHIFT + k]


@kernel
def _turn(mem, at):
    x = mem[at]
    y = mem[at + 1]
    mem[at] = mem[PL_TURN + 1] * x - mem[PL_TURN + 2] * y
    mem[at + 1] = mem[PL_TURN + 2] * x + mem[PL_TURN + 1] * y


@kernel
def is_finished(mem, memory, t):
    """Whether the last trajectory has come to its end, even if it was interrupted."""
    local = since(mem, t)
    kind = mem[PL_KIND]
    if kind == KIND_PLANNED:
        return local >= mem[PL_PIECE + PIECE_DURATION]
    if kind == KIND_PIECES:
        total = np.float32(0.0)
        for piece in range(int(mem[PL_COUNT])):
            total += _stretched_duration(mem, memory, piece)
        return local >= total
    if kind == KIND_COMPRESSED:
        _seek_segment(mem, memory, local)
        return mem[PL_INDEX] == mem[PL_COUNT]
    return True


@kernel
def plan_point_to_point(mem, t, duration, pos, yaw, end_vel, end_yaw_rate):
    """Plan one piece from the evaluated point in ``mem[PL_EVAL:]`` to the given end state.

    ``pos`` (m) and ``end_vel`` (m/s) are 3-tuples, ``yaw`` rad; acceleration is zero at the end.
    The body rate about z serves as the yaw rate at the start.
    """
    _follow(mem, KIND_PLANNED, t)
    duration = np.float32(duration)
    mem[PL_PIECE + PIECE_DURATION] = duration
    for axis in range(4):
        if axis < 3:
            p0 = mem[PL_EVAL + EV_POS + axis]
            v0 = mem[PL_EVAL + EV_VEL + axis]
            a0 = mem[PL_EVAL + EV_ACC + axis]
            p1 = pos[axis]
            v1 = end_vel[axis]
        else:
            p0 = mem[PL_EVAL + EV_YAW]
            v0 = mem[PL_EVAL + EV_OMEGA + 2]
            a0 = 0.0
            p1 = yaw
            v1 = end_yaw_rate
        plan_axis(mem, PL_PIECE, axis, duration, p0, v0, a0, p1, v1, 0.0)


@kernel
def plan_spiral(mem, t, duration, sideways, clockwise, angle, radius0, radius1, climb, pos, yaw):
    """Plan one piece that joins the ends of a spiral arc about a point beside or ahead.

    Parameters
    ----------
    sideways: fly with the centre ahead or behind instead of to the side.
    angle: rad to turn, limited to +-2 pi. radius0, radius1: m at the start and end, >= 0.
    climb: m. pos, yaw: where the arc starts, m and rad (yaw within +-pi).
    """
    _follow(mem, KIND_PLANNED, t)
    duration = np.float32(duration)
    mem[PL_PIECE + PIECE_DURATION] = duration
    inverse = 1.0 / duration if duration > 0.0 else 0.0
    s = 1.0 if clockwise else -1.0
    angle = min(max(angle, -2.0 * math.pi), 2.0 * math.pi)
    r0 = max(radius0, 0.0)
    r1 = max(radius1, 0.0)
    w = -s * angle * inverse
    dr = (r1 - r0) * inverse
    end_yaw = yaw - s * angle
    start = _arc_point(sideways, s, r0, yaw, w, dr)
    end = _arc_point(sideways, s, r1, end_yaw, w, dr)
    vz = climb * inverse
    # x, y, z and yaw at the start and at the end.
    p0 = (pos[0], pos[1], pos[2], yaw)
    v0 = (start[2], start[3], vz, w)
    a0 = (start[4], start[5], 0.0, 0.0)
    p1 = (pos[0] - start[0] + end[0], pos[1] - start[1] + end[1], pos[2] + climb, end_yaw)
    v1 = (end[2], end[3], vz, w)
    a1 = (end[4], end[5], 0.0, 0.0)
    for axis in range(4):
        plan_axis(
            mem,
            PL_PIECE,
            axis,
            duration,
            p0[axis],
            v0[axis],
            a0[axis],
            p1[axis],
            v1[axis],
            a1[axis],
        )


@kernel
def _arc_point(sideways, s, r, f, w, dr):
    # Position, velocity and acceleration (x, y each) relative to the centre of the arc. With
    # the radius vector along e and n = de/df, r' = dr and f' = w:
    # d(r e)/dt = dr e + r w n, and once more: (-r w^2) e + 2 dr w n.
    sin = math.sin(f)
    cos = math.cos(f)
    if sideways:
        ex, ey, nx, ny = -cos, -sin, sin, -cos
    else:
        ex, ey, nx, ny = -sin, cos, -cos, -sin
    along = -r * w * w
    across = 2.0 * dr * w
    return (
        s * r * ex,
        s * r * ey,
        s * (dr * ex + r * w * nx),
        s * (dr * ey + r * w * ny),
        s * (along * ex + across * nx),
        s * (along * ey + across * ny),
    )


@kernel
def start_pieces(mem, memory, t, offset, count, scale, reverse):
    """Follow uploaded polynomial pieces as they stand, neither shifted nor turned.

    ``offset`` bytes into the trajectory memory, ``count`` > 0 pieces, ``scale`` > 0.
    """
    _follow(mem, KIND_PIECES, t)
    mem[PL_OFFSET] = offset
    mem[PL_COUNT] = count
    mem[PL_SCALE] = np.float32(scale)
    mem[PL_REVERSED] = 1.0 if reverse else 0.0


@kernel
def start_compressed(mem, memory, t, offset, yaw_unit):
    """Follow an uploaded compressed trajectory, not shifted; ``yaw_unit`` rad per stored unit."""
    _follow(mem, KIND_COMPRESSED, t)
    mem[PL_OFFSET] = offset
    mem[PL_COUNT] = 1.0
    mem[PL_YAW_UNIT] = yaw_unit


@kernel
def make_relative(mem, memory, pos, turned, yaw):
    """Move the trajectory just started so that its first sample is at ``pos`` (m, 3-tuple).

    If ``turned``, it is also turned so that the first sample's yaw is ``yaw`` (rad). The turn
    is about the world's origin and the shift is found without it, so the first sample then
    only meets ``pos`` if it lies above the origin.
    """
    evaluate_plan(mem, memory, mem[PL_BEGIN])
    for k in range(3):
        mem[PL_SHIFT + k] = pos[k] - mem[PL_EVAL + EV_POS + k]
    if turned:
        turn = yaw - mem[PL_EVAL + EV_YAW]
        mem[PL_TURN] = turn
        mem[PL_TURN + 1] = math.cos(turn)
        mem[PL_TURN + 2] = math.sin(turn)
