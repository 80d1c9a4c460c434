"""The high-level commander: takeoff, land, go-to, spiral and trajectories, run on board.

One code path serves the firmware of 2022 and that of 2026 (``generation`` in the memory row).
They differ in yaw (2026 turns the short way), in what follows a landing (2022 leaves the
setpoint alone, 2026 sends the null setpoint that stops the motors) and in the states that only
2026 has (disabled, blocked).

Commands return what the vehicle puts into its answer: 0, or an error number.
"""

from __future__ import annotations

import math

import numpy as np

from crazyarena.jit import kernel
from crazyarena.sim_backend.firmware.layout import (
    M_PITCH,
    M_QUAT,
    M_ROLL,
    M_X,
    M_Y,
    M_YAW,
    M_Z,
    MODE_ABS,
    MODE_DISABLE,
    SETPOINT_SIZE,
    SP_ACC,
    SP_ATT,
    SP_JERK,
    SP_POS,
    SP_RATE,
    SP_VEL,
    ST_ATT,
    ST_POS,
    ST_VEL,
)
from crazyarena.sim_backend.firmware.parameters import GENERATIONS, Param
from crazyarena.sim_backend.firmware.planner import (
    DISABLED,
    FLYING,
    IDLE,
    LANDING,
    PIECE_BYTES,
    PL_EVAL,
    PL_INDEX,
    PL_PIECE,
    PL_STATE,
    PLANNER_SIZE,
    TRAJECTORY_MEMORY_SIZE,
    evaluate_plan,
    make_relative,
    plan_point_to_point,
    plan_spiral,
    since,
    start_compressed,
    start_pieces,
)
from crazyarena.sim_backend.firmware.polynomial import (
    EV_ACC,
    EV_JERK,
    EV_OMEGA,
    EV_POS,
    EV_VEL,
    EV_YAW,
    PIECE_DURATION,
)

PARAMS = (
    Param("hlCommander.vtoff", 0.5, 0.5),
    Param("hlCommander.vland", 0.5, 0.5),
    # 2022 has the group mask too, but only as a command; its place in the row serves both.
    Param("hlCommander.groupmask", None, 0, "uint8"),
)
P_TAKEOFF_SPEED, P_LANDING_SPEED, P_GROUP_MASK = range(3)

# Memory row: the planner's, then the commander's own.
HL_GENERATION = PLANNER_SIZE
HL_BLOCKED = PLANNER_SIZE + 1
HL_POS = PLANNER_SIZE + 2  # last known position, m (3)
HL_VEL = PLANNER_SIZE + 5  # m/s (3)
HL_YAW = PLANNER_SIZE + 8  # rad
HL_DEFINITIONS = PLANNER_SIZE + 9  # per id: defined, type, offset in bytes, pieces
MAX_DEFINITIONS = 31
DEFINITIONS_2022 = 10
HIGH_LEVEL_SIZE = HL_DEFINITIONS + 4 * MAX_DEFINITIONS

TYPE_POLYNOMIAL = 0
TYPE_COMPRESSED = 1

OK = 0
REFUSED = 1
ENOEXEC = 8
EBUSY = 16

# What get_setpoint says about the setpoint row.
SETPOINT_UNTOUCHED = 0
SETPOINT_TRAJECTORY = 1
SETPOINT_NULL = 2

_DEG = 180.0 / math.pi
_RAD = math.pi / 180.0
# The decoder of 2022 divides by the unit where it should multiply.
_YAW_UNIT_2022 = 10.0
_YAW_UNIT_2026 = 0.1 * _RAD


def new_memory(generation: int) -> np.ndarray:
    """Memory row of a freshly booted commander, float64 of shape ``(HIGH_LEVEL_SIZE,)``.

    Raises
    ------
    ValueError
        If the generation is neither 2022 nor 2026.
    """
    if generation not in GENERATIONS:
        raise ValueError(f"firmware generation {generation!r}: expected 2022 or 2026")
    mem = np.zeros(HIGH_LEVEL_SIZE)
    mem[HL_GENERATION] = generation
    mem[PL_INDEX] = -1.0
    return mem


@kernel
def in_group(params, group):
    """Whether a command for ``group`` is for this vehicle: 0 is for all."""
    return group == 0 or (int(group) & int(params[P_GROUP_MASK])) != 0


@kernel
def set_group_mask(params, mask):
    """Make the vehicle a member of the groups in the 8-bit ``mask``."""
    params[P_GROUP_MASK] = mask
    return OK


@kernel
def is_stopped(mem):
    """Whether no plan is being followed."""
    return mem[PL_STATE] != FLYING and mem[PL_STATE] != LANDING


@kernel
def tell_state(mem, state):
    """Let the next plan start from this state row rather than from the last setpoint."""
    for k in range(3):
        mem[HL_POS + k] = state[ST_POS + k]
        mem[HL_VEL + k] = state[ST_VEL + k]
    mem[HL_YAW] = state[ST_ATT + 2] * _RAD


@kernel
def stop(mem):
    """Drop the plan: the commander is idle."""
    mem[PL_STATE] = IDLE
    return OK


@kernel
def disable(mem):
    """Drop the plan and produce nothing until the next go-to, landing or trajectory (2026)."""
    mem[PL_STATE] = DISABLED
    return OK


@kernel
def block(mem, blocked):
    """Refuse motion while the supervisor does not allow flight; a running plan ends (2026)."""
    mem[HL_BLOCKED] = 1.0 if blocked else 0.0
    if blocked and not is_stopped(mem):
        mem[PL_STATE] = IDLE


@kernel
def _wrap(angle):
    return math.atan2(math.sin(angle), math.cos(angle))


@kernel
def _start_at_rest(mem):
    # Plans that do not continue a running one start from the last setpoint.
    for k in range(3):
        mem[PL_EVAL + EV_POS + k] = mem[HL_POS + k]
        mem[PL_EVAL + EV_VEL + k] = 0.0
        mem[PL_EVAL + EV_ACC + k] = 0.0
        mem[PL_EVAL + EV_OMEGA + k] = 0.0
    mem[PL_EVAL + EV_YAW] = mem[HL_YAW]


@kernel
def _end_yaw(mem, yaw):
    # 2026 takes the short way; the plan then starts from a yaw within +-pi.
    if mem[HL_GENERATION] == 2022.0:
        return yaw
    start = _wrap(mem[PL_EVAL + EV_YAW])
    mem[PL_EVAL + EV_YAW] = start
    return start + _wrap(yaw - start)


@kernel
def _plan_vertical(mem, height, duration, yaw, use_current_yaw, t):
    x = mem[PL_EVAL + EV_POS]
    y = mem[PL_EVAL + EV_POS + 1]
    end_yaw = _end_yaw(mem, mem[PL_EVAL + EV_YAW] if use_current_yaw else yaw)
    plan_point_to_point(mem, t, duration, (x, y, height), end_yaw, (0.0, 0.0, 0.0), 0.0)


@kernel
def takeoff(mem, height, duration, yaw, use_current_yaw, t):
    """Rise from the last known position to an absolute height.

    Parameters
    ----------
    height: m, world. duration: s. yaw: rad at the end, unless ``use_current_yaw``. t: now, s.

    Returns
    -------
    0; 1 if not idle (the command is ignored); 16 if blocked.
    """
    if mem[HL_BLOCKED] != 0.0:
        return EBUSY
    if mem[PL_STATE] != IDLE:
        return REFUSED
    _start_at_rest(mem)
    _plan_vertical(mem, height, duration, yaw, use_current_yaw, t)
    mem[PL_STATE] = FLYING
    return OK


@kernel
def land(mem, height, duration, yaw, use_current_yaw, t):
    """Sink from the last known position to an absolute height, then go idle.

    Arguments and result as :func:`takeoff`; ignored (1) while already landing.
    """
    if mem[HL_BLOCKED] != 0.0:
        return EBUSY
    if mem[PL_STATE] == LANDING:
        return REFUSED
    _start_at_rest(mem)
    _plan_vertical(mem, height, duration, yaw, use_current_yaw, t)
    mem[PL_STATE] = LANDING
    return OK


@kernel
def _vertical_duration(mem, height, velocity, default_velocity):
    v = velocity if velocity > 0.0 else default_velocity
    return abs(height - mem[HL_POS + 2]) / v


@kernel
def takeoff_with_velocity(mem, params, height, relative, velocity, yaw, use_current_yaw, t):
    """Take off at a mean ``velocity`` (m/s); <= 0 means ``hlCommander.vtoff``.

    ``height`` is above the last known position if ``relative``. Otherwise as :func:`takeoff`.
    """
    target = mem[HL_POS + 2] + height if relative else height
    duration = _vertical_duration(mem, target, velocity, params[P_TAKEOFF_SPEED])
    return takeoff(mem, target, duration, yaw, use_current_yaw, t)


@kernel
def land_with_velocity(mem, params, height, relative, velocity, yaw, use_current_yaw, t):
    """Land at a mean ``velocity`` (m/s); <= 0 means ``hlCommander.vland``.

    ``height`` is how far to sink if ``relative``. Otherwise as :func:`land`.
    """
    target = mem[HL_POS + 2] - height if relative else height
    duration = _vertical_duration(mem, target, velocity, params[P_LANDING_SPEED])
    return land(mem, target, duration, yaw, use_current_yaw, t)


@kernel
def go_to(mem, memory, x, y, z, yaw, duration, relative, linear, t):
    """Fly to a point (m) and yaw (rad) within ``duration`` (s) and stop there.

    Continues the running plan smoothly. ``relative`` adds to the present setpoint. ``linear``
    (2026) flies at constant velocity and does not come to rest.

    Returns
    -------
    0; 16 if blocked.
    """
    if mem[HL_BLOCKED] != 0.0:
        return EBUSY
    if is_stopped(mem):
        _start_at_rest(mem)
        for k in range(3):
            mem[PL_EVAL + EV_VEL + k] = mem[HL_VEL + k]
    else:
        evaluate_plan(mem, memory, t)
    if relative:
        x += mem[PL_EVAL + EV_POS]
        y += mem[PL_EVAL + EV_POS + 1]
        z += mem[PL_EVAL + EV_POS + 2]
        yaw += mem[PL_EVAL + EV_YAW]
    yaw = _end_yaw(mem, yaw)
    vx = 0.0
    vy = 0.0
    vz = 0.0
    yaw_rate = 0.0
    if linear:
        inverse = 1.0 / duration if duration > 0.0 else 0.0
        vx = (x - mem[PL_EVAL + EV_POS]) * inverse
        vy = (y - mem[PL_EVAL + EV_POS + 1]) * inverse
        vz = (z - mem[PL_EVAL + EV_POS + 2]) * inverse
        yaw_rate = (yaw - mem[PL_EVAL + EV_YAW]) * inverse
        mem[PL_EVAL + EV_VEL] = vx
        mem[PL_EVAL + EV_VEL + 1] = vy
        mem[PL_EVAL + EV_VEL + 2] = vz
        for k in range(3):
            mem[PL_EVAL + EV_ACC + k] = 0.0
        mem[PL_EVAL + EV_OMEGA + 2] = yaw_rate
    plan_point_to_point(mem, t, duration, (x, y, z), yaw, (vx, vy, vz), yaw_rate)
    mem[PL_STATE] = FLYING
    return OK


@kernel
def spiral(mem, sideways, clockwise, angle, radius0, radius1, climb, duration, t):
    """Fly an arc of ``angle`` (rad) about a point beside (or, sideways, ahead), 2026 only.

    Radii and climb in m, duration in s. Starts from the last setpoint, also in flight.

    Returns
    -------
    0; 16 if blocked.
    """
    if mem[HL_BLOCKED] != 0.0:
        return EBUSY
    pos = (mem[HL_POS], mem[HL_POS + 1], mem[HL_POS + 2])
    yaw = _wrap(mem[HL_YAW])
    plan_spiral(mem, t, duration, sideways, clockwise, angle, radius0, radius1, climb, pos, yaw)
    mem[PL_STATE] = FLYING
    return OK


@kernel
def place_trajectory(mem, trajectory_id, kind, offset, pieces):
    """Note where a trajectory lies, unchecked; arguments of :func:`define_trajectory`."""
    at = HL_DEFINITIONS + 4 * int(trajectory_id)
    mem[at] = 1.0
    mem[at + 1] = kind
    mem[at + 2] = offset
    mem[at + 3] = pieces


@kernel
def define_trajectory(mem, trajectory_id, kind, offset, pieces):
    """Name a part of the trajectory memory.

    Parameters
    ----------
    trajectory_id: 0..9 (2022) or 0..30 (2026).
    kind: TYPE_POLYNOMIAL or TYPE_COMPRESSED. offset: bytes. pieces: count (polynomial only).

    Returns
    -------
    0; 8 for an unknown id or kind, or a part that does not lie within the memory.
    """
    limit = DEFINITIONS_2022 if mem[HL_GENERATION] == 2022.0 else MAX_DEFINITIONS
    if trajectory_id < 0 or trajectory_id >= limit or offset < 0:
        return ENOEXEC
    if kind == TYPE_POLYNOMIAL:
        if pieces < 1 or offset + PIECE_BYTES * pieces > TRAJECTORY_MEMORY_SIZE:
            return ENOEXEC
    elif kind != TYPE_COMPRESSED or offset + 8 > TRAJECTORY_MEMORY_SIZE:
        return ENOEXEC
    place_trajectory(mem, trajectory_id, kind, offset, pieces)
    return OK


@kernel
def start_trajectory(mem, memory, trajectory_id, scale, relative, relative_yaw, reverse, t):
    """Follow an uploaded trajectory.

    Parameters
    ----------
    scale: stretches time; 0.5 is twice as fast.
    relative: shift it to begin at the last known position.
    relative_yaw: if relative, also turn it to begin at the last known yaw (2026; polynomial
        only).
    reverse: fly it from its end.

    Returns
    -------
    0, also for an id that is not defined (which changes nothing); 8 for a compressed trajectory
    with a timescale or reversed, or a timescale that is not a positive number; 16 if blocked.
    """
    if mem[HL_BLOCKED] != 0.0:
        return EBUSY
    if trajectory_id < 0 or trajectory_id >= MAX_DEFINITIONS:
        return OK
    at = HL_DEFINITIONS + 4 * int(trajectory_id)
    if mem[at] == 0.0:
        return OK
    if not (scale > 0.0 and scale < math.inf):
        return ENOEXEC
    compressed = mem[at + 1] == TYPE_COMPRESSED
    if compressed:
        if scale != 1.0 or reverse:
            return ENOEXEC
        unit = _YAW_UNIT_2022 if mem[HL_GENERATION] == 2022.0 else _YAW_UNIT_2026
        start_compressed(mem, memory, t, mem[at + 2], unit)
    else:
        start_pieces(mem, memory, t, mem[at + 2], mem[at + 3], scale, reverse)
    if relative:
        turned = relative_yaw and not compressed and mem[HL_GENERATION] != 2022.0
        pos = (mem[HL_POS], mem[HL_POS + 1], mem[HL_POS + 2])
        make_relative(mem, memory, pos, turned, mem[HL_YAW])
    mem[PL_STATE] = FLYING
    return OK


@kernel
def _write_setpoint(mem, sp):
    for k in range(3):
        sp[SP_POS + k] = mem[PL_EVAL + EV_POS + k]
        sp[SP_VEL + k] = mem[PL_EVAL + EV_VEL + k]
        sp[SP_ACC + k] = mem[PL_EVAL + EV_ACC + k]
        sp[SP_JERK + k] = mem[PL_EVAL + EV_JERK + k]
        sp[SP_RATE + k] = mem[PL_EVAL + EV_OMEGA + k] * _DEG
        mem[HL_POS + k] = mem[PL_EVAL + EV_POS + k]
        mem[HL_VEL + k] = mem[PL_EVAL + EV_VEL + k]
    mem[HL_YAW] = mem[PL_EVAL + EV_YAW]
    sp[SP_ATT + 2] = mem[PL_EVAL + EV_YAW] * _DEG
    sp[M_X] = MODE_ABS
    sp[M_Y] = MODE_ABS
    sp[M_Z] = MODE_ABS
    sp[M_ROLL] = MODE_DISABLE
    sp[M_PITCH] = MODE_DISABLE
    sp[M_YAW] = MODE_ABS
    sp[M_QUAT] = MODE_DISABLE


@kernel
def get_setpoint(mem, memory, t, state, sp):
    """Produce the setpoint of time ``t`` (s).

    Parameters
    ----------
    mem: memory row of :func:`new_memory`.
    memory: uint8 trajectory memory of the vehicle, shape ``(4096,)``.
    state, sp: state and setpoint rows; attitude roll and pitch, quaternion and thrust are left
        alone by a trajectory setpoint (2022) or zero (2026).

    Returns
    -------
    SETPOINT_TRAJECTORY, SETPOINT_NULL (2026: the row is all zero, motors off) or
    SETPOINT_UNTOUCHED.
    """
    old = mem[HL_GENERATION] == 2022.0
    if is_stopped(mem):
        tell_state(mem, state)
        if old or mem[PL_STATE] == DISABLED:
            return SETPOINT_UNTOUCHED
        for k in range(SETPOINT_SIZE):
            sp[k] = 0.0
        return SETPOINT_NULL
    if mem[PL_STATE] == LANDING and since(mem, t) >= mem[PL_PIECE + PIECE_DURATION]:
        mem[PL_STATE] = IDLE
        if not old:
            tell_state(mem, state)
            for k in range(SETPOINT_SIZE):
                sp[k] = 0.0
            return SETPOINT_NULL
    evaluate_plan(mem, memory, t)
    if not old:
        for k in range(SETPOINT_SIZE):
            sp[k] = 0.0
    _write_setpoint(mem, sp)
    return SETPOINT_TRAJECTORY
