"""Perfect tracking: a vehicle is, one tick later, where its setpoint is.

No dynamics and no timeouts, so a choreography can be checked for what it asks. Setpoints come
from the firmware's planner or from a stream, may be bent by the firmware's collision
avoidance, and are reached within one tick unless a speed limit or noise is set. A whole fleet
advances in one call; everybody sees the others where they were one tick before.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from crazyarena.jit import kernel
from crazyarena.sim_backend.firmware.collision_avoidance import P_ENABLE, avoid_collisions
from crazyarena.sim_backend.firmware.layout import (
    M_X,
    MODE_ABS,
    SP_POS,
    SP_VEL,
)
from crazyarena.sim_backend.firmware.layout import MODE_VELOCITY as SP_MODE_VELOCITY
from crazyarena.sim_backend.firmware.planner import (
    FLYING,
    IDLE,
    LANDING,
    PL_EVAL,
    PL_STATE,
    evaluate_plan,
    is_finished,
    make_relative,
    plan_point_to_point,
    start_pieces,
)
from crazyarena.sim_backend.firmware.polynomial import (
    EV_ACC,
    EV_OMEGA,
    EV_POS,
    EV_VEL,
    EV_YAW,
    EVAL_SIZE,
)

# Motion of one vehicle, as a state or as a setpoint.
MO_POS = 0  # m, world
MO_VEL = 3  # m/s, world; of a hover setpoint vx, vy in the yaw-aligned frame
MO_ACC = 6  # m/s2, world
MO_YAW = 9  # rad, not wrapped
MO_OMEGA = 10  # rad/s, body
MOTION_SIZE = 13

# Who decides on the setpoint.
MODE_IDLE = 0
MODE_HIGH_LEVEL = 1
MODE_FULL_STATE = 2
MODE_POSITION = 3
MODE_VELOCITY = 4
MODE_HOVER = 5


@kernel
def _start_at(mem, state):
    # The point that the next plan starts from: the present state, at rest.
    for k in range(EVAL_SIZE):
        mem[PL_EVAL + k] = 0.0
    for k in range(3):
        mem[PL_EVAL + EV_POS + k] = state[MO_POS + k]
    mem[PL_EVAL + EV_YAW] = state[MO_YAW]


@kernel
def plan_vertical(mem, state, t, height, duration, yaw, landing):
    """Plan a takeoff or landing from the present state to ``height`` (m) and ``yaw`` (rad)."""
    _start_at(mem, state)
    goal = (state[MO_POS], state[MO_POS + 1], height)
    plan_point_to_point(mem, t, duration, goal, yaw, (0.0, 0.0, 0.0), 0.0)
    mem[PL_STATE] = LANDING if landing else FLYING


@kernel
def plan_go_to(mem, memory, state, t, x, y, z, yaw, duration, relative):
    """Plan from the present setpoint to a goal at rest; ``relative`` adds it to the setpoint."""
    if mem[PL_STATE] == IDLE:
        _start_at(mem, state)
    else:
        evaluate_plan(mem, memory, t)
    if relative:
        x += mem[PL_EVAL + EV_POS]
        y += mem[PL_EVAL + EV_POS + 1]
        z += mem[PL_EVAL + EV_POS + 2]
        yaw += mem[PL_EVAL + EV_YAW]
    plan_point_to_point(mem, t, duration, (x, y, z), yaw, (0.0, 0.0, 0.0), 0.0)
    mem[PL_STATE] = FLYING


@kernel
def plan_trajectory(mem, memory, state, t, count, scale, reverse, relative):
    """Follow the ``count`` pieces in ``memory``, shifted to the present state if ``relative``."""
    start_pieces(mem, memory, t, 0, count, scale, reverse)
    if relative:
        pos = (state[MO_POS], state[MO_POS + 1], state[MO_POS + 2])
        make_relative(mem, memory, pos, False, 0.0)
    mem[PL_STATE] = FLYING


@kernel
def freeze(mem, state):
    """Stay in place with nobody in charge."""
    mem[PL_STATE] = IDLE
    for k in range(MO_VEL, MO_YAW):
        state[k] = 0.0
    for k in range(MO_OMEGA, MOTION_SIZE):
        state[k] = 0.0
    return MODE_IDLE


@kernel
def choose_setpoint(mode, mem, memory, t, dt, state, stream, setpoint):
    """Write the setpoint (MO_*) of one vehicle for time ``t`` (s).

    Position and full-state setpoints are reached through MO_POS, velocity and hover setpoints
    through MO_VEL.
    """
    if mode == MODE_HIGH_LEVEL:
        if mem[PL_STATE] == IDLE:
            _start_at(mem, state)
        else:
            evaluate_plan(mem, memory, t)
        for k in range(3):
            setpoint[MO_POS + k] = mem[PL_EVAL + EV_POS + k]
            setpoint[MO_VEL + k] = mem[PL_EVAL + EV_VEL + k]
            setpoint[MO_ACC + k] = mem[PL_EVAL + EV_ACC + k]
            setpoint[MO_OMEGA + k] = mem[PL_EVAL + EV_OMEGA + k]
        setpoint[MO_YAW] = mem[PL_EVAL + EV_YAW]
        return
    for k in range(MOTION_SIZE):
        setpoint[k] = stream[k]
    if mode == MODE_POSITION:
        setpoint[MO_OMEGA + 2] = (stream[MO_YAW] - state[MO_YAW]) / dt
    elif mode >= MODE_VELOCITY:
        setpoint[MO_YAW] = state[MO_YAW] + dt * stream[MO_OMEGA + 2]
    if mode == MODE_HOVER:
        cos = math.cos(state[MO_YAW])
        sin = math.sin(state[MO_YAW])
        setpoint[MO_VEL] = cos * stream[MO_VEL] - sin * stream[MO_VEL + 1]
        setpoint[MO_VEL + 1] = sin * stream[MO_VEL] + cos * stream[MO_VEL + 1]
        setpoint[MO_VEL + 2] = (stream[MO_POS + 2] - state[MO_POS + 2]) / dt


@kernel
def follow_setpoint(mode, setpoint, dt, max_velocity, disturbance, noise, state):
    """Move one vehicle onto its setpoint within ``dt`` (s).

    ``max_velocity`` m/s limits the speed before ``disturbance`` (m/s) times ``noise`` (three
    standard normals) is added.
    """
    vx = setpoint[MO_VEL]
    vy = setpoint[MO_VEL + 1]
    vz = setpoint[MO_VEL + 2]
    if mode <= MODE_POSITION:
        vx = (setpoint[MO_POS] - state[MO_POS]) / dt
        vy = (setpoint[MO_POS + 1] - state[MO_POS + 1]) / dt
        vz = (setpoint[MO_POS + 2] - state[MO_POS + 2]) / dt
    speed = math.sqrt(vx * vx + vy * vy + vz * vz)
    if speed > max_velocity:
        scale = max_velocity / speed
        vx *= scale
        vy *= scale
        vz *= scale
    vx += disturbance * noise[0]
    vy += disturbance * noise[1]
    vz += disturbance * noise[2]
    state[MO_POS] += dt * vx
    state[MO_POS + 1] += dt * vy
    state[MO_POS + 2] += dt * vz
    state[MO_VEL] = vx
    state[MO_VEL + 1] = vy
    state[MO_VEL + 2] = vz
    for k in range(MO_ACC, MOTION_SIZE):
        state[k] = setpoint[k]


@kernel
def _gather_peers(positions, peers, vehicle, found):
    # A count that starts as a literal in the caller would have its callees compiled twice.
    count = 0
    for other in range(positions.shape[0]):
        if peers[vehicle, other]:
            for k in range(3):
                found[count, k] = positions[other, k]
            count += 1
    return count


@kernel
def _avoid(mode, avoidance, memory, own, positions, peers, vehicle, setpoint, work):
    """Bend a setpoint around the peers; what is left of it is position, velocity and yaw."""
    found, faces, sp = work
    count = _gather_peers(positions, peers, vehicle, found)
    sp[M_X] = SP_MODE_VELOCITY if mode >= MODE_VELOCITY else MODE_ABS
    for k in range(3):
        sp[SP_POS + k] = setpoint[MO_POS + k]
        sp[SP_VEL + k] = setpoint[MO_VEL + k]
    avoid_collisions(
        avoidance,
        memory,
        own[MO_POS],
        own[MO_POS + 1],
        own[MO_POS + 2],
        found,
        count,
        sp,
        faces,
    )
    for k in range(3):
        setpoint[MO_POS + k] = sp[SP_POS + k]
        setpoint[MO_VEL + k] = sp[SP_VEL + k]
        setpoint[MO_ACC + k] = 0.0
    setpoint[MO_OMEGA] = 0.0
    setpoint[MO_OMEGA + 1] = 0.0


@kernel
def has_landed(mem, memory, t):
    """Whether a landing has come to its end."""
    return mem[PL_STATE] == LANDING and is_finished(mem, memory, t)


class Motion(NamedTuple):
    """Rows of all vehicles; the first axis is the vehicle.

    modes: (n,) MODE_*. planner, memory: planner rows and trajectory memories.
    state, stream, setpoint: MO_* rows: true motion, last streamed setpoint, setpoint in use.
    """

    modes: np.ndarray
    planner: np.ndarray
    memory: np.ndarray
    state: np.ndarray
    stream: np.ndarray
    setpoint: np.ndarray


class Avoidance(NamedTuple):
    """What collision avoidance works on.

    params, last_feasible: its rows, one a vehicle: parameters and memory.
    peers: (n, n) flags, which vehicles each one avoids.
    positions: (n, 3) scratch. work: scratch for peers, cell faces and a setpoint row.
    """

    params: np.ndarray
    last_feasible: np.ndarray
    peers: np.ndarray
    positions: np.ndarray
    work: tuple[np.ndarray, np.ndarray, np.ndarray]


@kernel
def advance_fleet(t, dt, motion, avoidance, max_velocity, disturbance, noise):
    """Advance every vehicle that is not idle by ``dt`` s to the new time ``t`` (s).

    Parameters
    ----------
    motion, avoidance: plain tuples in the order of :class:`Motion` and :class:`Avoidance`; the
        type of a named one is read anew, in Python, at every call.
    max_velocity, disturbance: m/s. noise: one row of standard normals per flying vehicle.
    """
    modes, planner, memory, state, stream, setpoint = motion
    params, last_feasible, peers, positions, work = avoidance
    n = modes.shape[0]
    for i in range(n):
        for k in range(3):
            positions[i, k] = state[i, MO_POS + k]
    drawn = 0
    for i in range(n):
        mode = modes[i]
        if mode == MODE_IDLE:
            continue
        choose_setpoint(mode, planner[i], memory[i], t, dt, state[i], stream[i], setpoint[i])
        if params[i, P_ENABLE] != 0.0:
            _avoid(
                mode, params[i], last_feasible[i], state[i], positions, peers, i, setpoint[i], work
            )
        follow_setpoint(mode, setpoint[i], dt, max_velocity, disturbance, noise[drawn], state[i])
        drawn += 1
        if has_landed(planner[i], memory[i], t) and mode == MODE_HIGH_LEVEL:
            modes[i] = freeze(planner[i], state[i])
