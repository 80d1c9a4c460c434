"""Some milliseconds of ``arena`` vehicles, compiled: sensors, 2026 firmware, plant, contacts.

Order inside a 1 ms tick: the inertial sensors sample the plant, the firmware turns that and the
external poses that have arrived into motor commands, and the plant moves under them. Vehicles
that might touch each other take every tick together, the others any number of ticks on their own.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from crazyarena.jit import kernel
from crazyarena.sim_backend.firmware.collision_avoidance import note_peer
from crazyarena.sim_backend.firmware.kalman import MEAS_NONE, MEAS_POSE
from crazyarena.sim_backend.firmware.layout import (
    M_QUAT,
    MODE_ABS,
    SP_ACC,
    SP_ATT,
    SP_POS,
    SP_QUAT,
    SP_VEL,
)
from crazyarena.sim_backend.firmware.stack_2026 import (
    F_CONTROL,
    F_MEASUREMENT,
    F_MOTORS,
    F_SETPOINT,
    F_SUPERVISOR,
    F_SUPPLY,
    F_TICK,
    begin_tick,
    finish_tick,
    measure,
)
from crazyarena.sim_backend.firmware.supervisor import SV_TUMBLED
from crazyarena.sim_backend.physics.arena_plant import (
    AB_ACCELERATION,
    AB_CONTACT,
    AB_FORCE,
    AB_VOLTS,
    GRAVITY,
    arena_step,
    is_asleep,
    note_acceleration,
    note_contact,
    wake_up,
)
from crazyarena.sim_backend.physics.competition_step import (
    B_OMEGA,
    B_POS,
    B_QUAT,
    B_RPY,
    B_VEL,
    P_MASS,
    update_rpy,
)
from crazyarena.sim_backend.physics.contact import resolve
from crazyarena.sim_backend.physics.fleet import may_meet, separate, wake_force
from crazyarena.sim_backend.physics.geometry import CONTACT_GAP
from crazyarena.sim_backend.trace import (
    TR_ACTION,
    TR_CONTACT,
    TR_OMEGA,
    TR_POS,
    TR_QUAT,
    TR_RPY,
    TR_SETPOINT,
    TR_TIME,
    TR_TUMBLED,
    TR_VEL,
)

TICK_RATE = 1000
DT = 1e-3  # s

# Queue of external poses on their way to a vehicle: a header row, then a ring of entries.
Q_HEAD, Q_COUNT = 0, 1  # header
Q_ARRIVAL = 0  # firmware tick of arrival
Q_KIND = 1  # MEAS_POSE, MEAS_POSITION or MEAS_FLOW
Q_POSE = 2  # position 3, quaternion x, y, z, w; or as kalman_measure says
QUEUE_COLUMNS = 9
QUEUE_LENGTH = 20  # as on the vehicle; what does not fit is lost

# Columns of the noise of one tick.
N_GYRO = 0  # deg/s
N_ACCELEROMETER = 3  # g
N_FORCE = 6  # N, world, at the centre of mass
NOISE_COLUMNS = 9

# Columns of the contacts that begin between two vehicles.
V_TICK, V_FIRST, V_SECOND = 0, 1, 2
V_SPEED = 3  # m/s, of approach
V_SIZE = 4
CONTACT_PAUSE = 100  # ticks apart before touching again counts as another contact

# Columns of what lock step keeps of a vehicle during a tick.
X_VEL = 0  # m/s, world, before the step
X_WASH = 3  # N, world z
X_LIFT = 4  # thrust over weight
X_MOVED = 5
X_SIZE = 6

_DEG = 180.0 / math.pi

# What belongs together is handed over together, as a plain tuple in the order of one of these:
# Numba reads the type of a named tuple anew at every call, which costs more than a tick. Inside,
# the kernels name it again.


class Fleet(NamedTuple):
    """Rows of all vehicles; the first axis is the vehicle.

    bodies, plants: rows of :mod:`.physics.arena_plant`.
    memories, params, trajectories, peer_tables, peers, faces: see :mod:`.firmware.stack_2026`.
    queues: (n, QUEUE_LENGTH + 1, QUEUE_COLUMNS), filled by :func:`enqueue`.
    works: workspaces of :mod:`.physics.geometry`.
    """

    bodies: np.ndarray
    plants: np.ndarray
    memories: np.ndarray
    params: np.ndarray
    trajectories: np.ndarray
    peer_tables: np.ndarray
    peers: np.ndarray
    faces: np.ndarray
    queues: np.ndarray
    works: np.ndarray


class Vehicle(NamedTuple):
    """What sensors and firmware of one vehicle of a :class:`Fleet` work on."""

    body: np.ndarray
    memory: np.ndarray
    params: np.ndarray
    trajectory: np.ndarray
    peer_table: np.ndarray
    peers: np.ndarray
    face: np.ndarray
    queue: np.ndarray


class Block(NamedTuple):
    """Milliseconds ``begin..end-1`` after a moment of the fleet.

    tick: the fleet's, at millisecond 0.
    noises: (n, >= end, NOISE_COLUMNS), or (n, 0, NOISE_COLUMNS) for none.
    traces: (n, >= end, TRACE_SIZE), written; (n, 0, TRACE_SIZE) writes nothing.
    """

    begin: int
    end: int
    tick: int
    noises: np.ndarray
    traces: np.ndarray


class Encounters(NamedTuple):
    """What is kept of vehicles that might touch each other.

    touched: (n, n), above the diagonal the tick of each pair's latest contact; kept up.
    meetings: (>= n (n - 1) / 2, V_SIZE), receives the contacts that begin. A block must not be
        longer than CONTACT_PAUSE, so that no pair can need two rows.
    scratch: (n, X_SIZE).
    work: workspace of no vehicle.
    """

    touched: np.ndarray
    meetings: np.ndarray
    scratch: np.ndarray
    work: np.ndarray


@kernel
def _append(queue, arrival, kind):
    """Row for an external pose that arrives at a firmware tick; 0 when the queue is full."""
    head, count = int(queue[0, Q_HEAD]), int(queue[0, Q_COUNT])
    if count == QUEUE_LENGTH:
        return 0
    if count > 0:
        arrival = max(arrival, queue[1 + (head + count - 1) % QUEUE_LENGTH, Q_ARRIVAL])
    row = 1 + (head + count) % QUEUE_LENGTH
    queue[row, Q_ARRIVAL] = arrival
    queue[row, Q_KIND] = kind
    queue[0, Q_COUNT] = count + 1.0
    return row


@kernel
def enqueue(queue, arrival, kind, pose):
    """Append an external pose (7,) that arrives at a firmware tick; False when full.

    Poses arrive in the order they were sent: one cannot overtake another.
    """
    row = _append(queue, arrival, kind)
    if row == 0:
        return False
    for i in range(7):
        queue[row, Q_POSE + i] = pose[i]
    return True


@kernel
def show_truth(bodies, memories, queues, peer_tables, avoiding, heard, ids):
    """What a perfect camera system sends: each vehicle's own pose to its estimator, which it
    reaches now, and to those that avoid collisions the positions of the others.

    Parameters
    ----------
    bodies, memories, queues, peer_tables: of a :class:`Fleet`.
    avoiding: (n,) nonzero where a vehicle avoids collisions.
    heard: (n, n) nonzero where the vehicle of a row listens to that of a column.
    ids: (n,).
    """
    for i in range(bodies.shape[0]):
        now = memories[i, F_TICK]
        row = _append(queues[i], now, MEAS_POSE)
        if row > 0:
            for k in range(3):
                queues[i, row, Q_POSE + k] = bodies[i, B_POS + k]
            for k in range(4):
                queues[i, row, Q_POSE + 3 + k] = bodies[i, B_QUAT + k]
        if avoiding[i] == 0.0:
            continue
        for j in range(bodies.shape[0]):
            if j != i and heard[i, j]:
                x, y, z = bodies[j, B_POS], bodies[j, B_POS + 1], bodies[j, B_POS + 2]
                note_peer(peer_tables[i], ids[j], x, y, z, now)


@kernel
def _arrived(queue, tick, memory):
    """Take the next pose that has arrived into F_MEASUREMENT; its kind, or MEAS_NONE."""
    if queue[0, Q_COUNT] == 0.0:
        return MEAS_NONE
    head = int(queue[0, Q_HEAD])
    if queue[1 + head, Q_ARRIVAL] > tick:
        return MEAS_NONE
    for i in range(7):
        memory[F_MEASUREMENT + i] = queue[1 + head, Q_POSE + i]
    queue[0, Q_HEAD] = (head + 1.0) % QUEUE_LENGTH
    queue[0, Q_COUNT] -= 1.0
    return int(queue[1 + head, Q_KIND])


@kernel
def _trace(row, time, body, memory):
    update_rpy(body)
    row[TR_TIME] = time
    sp = memory[F_SETPOINT:F_CONTROL]
    for i in range(3):
        row[TR_POS + i] = body[B_POS + i]
        row[TR_RPY + i] = body[B_RPY + i]
        row[TR_VEL + i] = body[B_VEL + i]
        row[TR_OMEGA + i] = body[B_OMEGA + i]
        row[TR_SETPOINT + i] = sp[SP_POS + i]
        row[TR_SETPOINT + 3 + i] = sp[SP_VEL + i]
        row[TR_SETPOINT + 6 + i] = sp[SP_ACC + i]
    for i in range(4):
        row[TR_QUAT + i] = body[B_QUAT + i]
        row[TR_ACTION + i] = body[AB_FORCE + 3 - i]
    yaw = sp[SP_ATT + 2] / _DEG
    if sp[M_QUAT] == MODE_ABS:
        x, y, z, w = sp[SP_QUAT], sp[SP_QUAT + 1], sp[SP_QUAT + 2], sp[SP_QUAT + 3]
        yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    row[TR_SETPOINT + 9] = yaw
    row[TR_CONTACT] = body[AB_CONTACT]
    row[TR_TUMBLED] = memory[F_SUPERVISOR + SV_TUMBLED]


@kernel
def _vehicle(fleet, v):
    return Vehicle(
        fleet.bodies[v],
        fleet.memories[v],
        fleet.params[v],
        fleet.trajectories[v],
        fleet.peer_tables[v],
        fleet.peers[v],
        fleet.faces[v],
        fleet.queues[v],
    )


@kernel
def _think(own, noise, k, fx, fy, fz):
    """Sensors and firmware of a :class:`Vehicle` in one tick; the disturbance force (N, world) of
    its noise, added to (fx, fy, fz)."""
    body, memory, param, queue = own.body, own.memory, own.params, own.queue
    gx, gy, gz = body[B_OMEGA] * _DEG, body[B_OMEGA + 1] * _DEG, body[B_OMEGA + 2] * _DEG
    ax = body[AB_ACCELERATION] / GRAVITY
    ay = body[AB_ACCELERATION + 1] / GRAVITY
    az = body[AB_ACCELERATION + 2] / GRAVITY
    if k < noise.shape[0]:
        gx += noise[k, N_GYRO]
        gy += noise[k, N_GYRO + 1]
        gz += noise[k, N_GYRO + 2]
        ax += noise[k, N_ACCELEROMETER]
        ay += noise[k, N_ACCELEROMETER + 1]
        az += noise[k, N_ACCELEROMETER + 2]
        fx += noise[k, N_FORCE]
        fy += noise[k, N_FORCE + 1]
        fz += noise[k, N_FORCE + 2]
    begin_tick(memory, param, gx, gy, gz, ax, ay, az)
    kind = _arrived(queue, memory[F_TICK], memory)
    while kind != MEAS_NONE:
        measure(memory, param, kind)
        kind = _arrived(queue, memory[F_TICK], memory)
    finish_tick(memory, param, own.trajectory, own.peer_table, own.peers, own.face, body[AB_VOLTS])
    return fx, fy, fz


@kernel
def advance_fleet(first, last, near, fleet, block, scene, ground):
    """Run a block of those vehicles ``first..last-1`` that are not near.

    Vehicles do not touch each other's rows, so ranges may run in parallel (the interpreter lock
    is released).

    Parameters
    ----------
    near: (n,) of :func:`.physics.fleet.find_near`: 1 for what :func:`advance_near` moves.
    fleet, block: plain tuples in the order of :class:`Fleet` and :class:`Block`.
    scene, ground: see :mod:`.physics.geometry`.
    """
    rows, span = Fleet(*fleet), Block(*block)
    time = span.tick * DT
    for v in range(first, last):
        if near[v]:
            continue
        own = _vehicle(rows, v)
        body, plant, memory = own.body, rows.plants[v], own.memory
        noise, trace = span.noises[v], span.traces[v]
        for k in range(span.begin, span.end):
            fx, fy, fz = _think(own, noise, k, 0.0, 0.0, 0.0)
            motors = memory[F_MOTORS:F_SUPPLY]
            if not is_asleep(body, motors, fx, fy, fz):
                vx, vy, vz = body[B_VEL], body[B_VEL + 1], body[B_VEL + 2]
                arena_step(body, plant, motors, fx, fy, fz, DT)
                note_contact(body, resolve(body, plant, scene, ground, DT, rows.works[v]))
                note_acceleration(body, vx, vy, vz, DT)
            if k < trace.shape[0]:
                _trace(trace[k], time + (k + 1.0) * DT, body, memory)


@kernel
def _wash(bodies, plants, members, count, scratch):
    """Downwash forces (N, upwards) of the members into ``scratch[:, X_WASH]``."""
    for a in range(count):
        i = members[a]
        lift = 0.0
        for r in range(4):
            lift += bodies[i, AB_FORCE + r]
        scratch[i, X_LIFT] = lift / (plants[i, P_MASS] * GRAVITY)
        scratch[i, X_WASH] = 0.0
    for a in range(count):
        i = members[a]
        for b in range(count):
            j = members[b]
            scratch[i, X_WASH] -= scratch[j, X_LIFT] * wake_force(bodies, i, j)


@kernel
def _meet(bodies, plants, members, count, tick, touched, meetings, work):
    """Contacts between members after a step; the number of rows written to ``meetings``."""
    met = 0
    for a in range(count):
        i = members[a]
        for b in range(a + 1, count):
            j = members[b]
            if not may_meet(bodies, i, j, DT):
                continue
            gap, speed, pushed = separate(bodies, plants, i, j, DT, work)
            if gap >= CONTACT_GAP and not pushed:
                continue
            if tick - touched[i, j] > CONTACT_PAUSE:
                row = meetings[met]
                row[V_TICK], row[V_FIRST], row[V_SECOND], row[V_SPEED] = tick, i, j, speed
                met += 1
            touched[i, j] = tick
    return met


@kernel
def advance_near(members, count, wakes, fleet, block, scene, ground, encounters):
    """Run a block of the first ``count`` members in lock step.

    Parameters
    ----------
    members: indices of :func:`.physics.fleet.find_near`.
    wakes: True for downwash between the vehicles.
    fleet, block, encounters: plain tuples in the order of :class:`Fleet`, :class:`Block` and
        :class:`Encounters`.
    scene, ground: see :mod:`.physics.geometry`.

    Returns
    -------
    Number of rows in ``meetings``.
    """
    rows, span, seen = Fleet(*fleet), Block(*block), Encounters(*encounters)
    bodies, plants, memories, traces = rows.bodies, rows.plants, rows.memories, span.traces
    meetings, scratch = seen.meetings, seen.scratch
    time = span.tick * DT
    met = 0
    for k in range(span.begin, span.end):
        if wakes:
            _wash(bodies, plants, members, count, scratch)
        for a in range(count):
            v = members[a]
            body, memory, note = bodies[v], memories[v], scratch[v]
            fx, fy, fz = _think(_vehicle(rows, v), span.noises[v], k, 0.0, 0.0, note[X_WASH])
            for i in range(3):
                note[X_VEL + i] = body[B_VEL + i]
            motors = memory[F_MOTORS:F_SUPPLY]
            note[X_MOVED] = 0.0
            if not is_asleep(body, motors, fx, fy, fz):
                note[X_MOVED] = 1.0
                arena_step(body, plants[v], motors, fx, fy, fz, DT)
                note_contact(body, resolve(body, plants[v], scene, ground, DT, rows.works[v]))
        tick = span.tick + k + 1
        met += _meet(bodies, plants, members, count, tick, seen.touched, meetings[met:], seen.work)
        for a in range(count):
            v = members[a]
            body, note = bodies[v], scratch[v]
            if wake_up(body) or note[X_MOVED] > 0.0:
                note_acceleration(body, note[X_VEL], note[X_VEL + 1], note[X_VEL + 2], DT)
            if k < traces.shape[1]:
                _trace(traces[v, k], time + (k + 1.0) * DT, body, memories[v])
    return met
