"""Some milliseconds of one ``arena`` vehicle, compiled: sensors, 2026 firmware, plant, contacts.

Order inside a 1 ms tick: the inertial sensors sample the plant, the firmware turns that and the
external poses that have arrived into motor commands, and the plant moves under them.
"""

from __future__ import annotations

import math

from crazyarena.sim_backend.firmware.kalman import MEAS_NONE
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
from crazyarena.sim_backend.jit import kernel
from crazyarena.sim_backend.physics.arena_plant import (
    AB_ACCELERATION,
    AB_CONTACT,
    AB_ROTOR,
    AB_VOLTS,
    GRAVITY,
    arena_step,
    is_asleep,
    note_acceleration,
    note_contact,
)
from crazyarena.sim_backend.physics.competition_step import (
    B_OMEGA,
    B_POS,
    B_QUAT,
    B_RPY,
    B_VEL,
    update_rpy,
)
from crazyarena.sim_backend.physics.contact import resolve
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
Q_KIND = 1  # MEAS_POSE or MEAS_POSITION
Q_POSE = 2  # position 3, quaternion x, y, z, w
QUEUE_COLUMNS = 9
QUEUE_LENGTH = 20  # as on the vehicle; what does not fit is lost

# Columns of the noise of one tick.
N_GYRO = 0  # deg/s
N_ACCELEROMETER = 3  # g
N_FORCE = 6  # N, world, at the centre of mass
NOISE_COLUMNS = 9

_DEG = 180.0 / math.pi


@kernel
def enqueue(queue, arrival, kind, pose):
    """Append an external pose (7,) that arrives at a firmware tick; False when full.

    Poses arrive in the order they were sent: one cannot overtake another.
    """
    head, count = int(queue[0, Q_HEAD]), int(queue[0, Q_COUNT])
    if count == QUEUE_LENGTH:
        return False
    if count > 0:
        arrival = max(arrival, queue[1 + (head + count - 1) % QUEUE_LENGTH, Q_ARRIVAL])
    row = 1 + (head + count) % QUEUE_LENGTH
    queue[row, Q_ARRIVAL] = arrival
    queue[row, Q_KIND] = kind
    for i in range(7):
        queue[row, Q_POSE + i] = pose[i]
    queue[0, Q_COUNT] = count + 1.0
    return True


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
        row[TR_ACTION + i] = body[AB_ROTOR + 3 - i] * body[AB_ROTOR + 3 - i]
    yaw = sp[SP_ATT + 2] / _DEG
    if sp[M_QUAT] == MODE_ABS:
        x, y, z, w = sp[SP_QUAT], sp[SP_QUAT + 1], sp[SP_QUAT + 2], sp[SP_QUAT + 3]
        yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    row[TR_SETPOINT + 9] = yaw
    row[TR_CONTACT] = body[AB_CONTACT]
    row[TR_TUMBLED] = memory[F_SUPERVISOR + SV_TUMBLED]


@kernel
def advance_fleet(
    first,
    last,
    bodies,
    plants,
    memories,
    params,
    trajectories,
    peer_tables,
    peers,
    faces,
    queues,
    scene,
    ground,
    works,
    noises,
    time,
    ticks,
    traces,
):
    """Run ``ticks`` milliseconds of the vehicles ``first..last-1``.

    The first axis of every array but ``scene`` is the vehicle. Vehicles do not touch each
    other's rows, so ranges may run in parallel (the interpreter lock is released).

    Parameters
    ----------
    bodies, plants: rows of :mod:`.physics.arena_plant`.
    memories, params, trajectories, peer_tables, peers, faces: see :mod:`.firmware.stack_2026`.
    queues: (n, QUEUE_LENGTH + 1, QUEUE_COLUMNS), filled by :func:`enqueue`.
    scene, ground, works: see :mod:`.physics.geometry`.
    noises: (n, >= ticks, NOISE_COLUMNS), or (n, 0, NOISE_COLUMNS) for none.
    time: s, at the beginning, for the trace.
    traces: (n, >= ticks, TRACE_SIZE), written; (n, 0, TRACE_SIZE) writes nothing.
    """
    for v in range(first, last):
        body, plant, memory, param = bodies[v], plants[v], memories[v], params[v]
        queue, noise, trace = queues[v], noises[v], traces[v]
        for k in range(ticks):
            gx, gy, gz = body[B_OMEGA] * _DEG, body[B_OMEGA + 1] * _DEG, body[B_OMEGA + 2] * _DEG
            ax = body[AB_ACCELERATION] / GRAVITY
            ay = body[AB_ACCELERATION + 1] / GRAVITY
            az = body[AB_ACCELERATION + 2] / GRAVITY
            fx, fy, fz = 0.0, 0.0, 0.0
            if k < noise.shape[0]:
                gx += noise[k, N_GYRO]
                gy += noise[k, N_GYRO + 1]
                gz += noise[k, N_GYRO + 2]
                ax += noise[k, N_ACCELEROMETER]
                ay += noise[k, N_ACCELEROMETER + 1]
                az += noise[k, N_ACCELEROMETER + 2]
                fx, fy, fz = noise[k, N_FORCE], noise[k, N_FORCE + 1], noise[k, N_FORCE + 2]
            begin_tick(memory, param, gx, gy, gz, ax, ay, az)
            kind = _arrived(queue, memory[F_TICK], memory)
            while kind != MEAS_NONE:
                measure(memory, param, kind)
                kind = _arrived(queue, memory[F_TICK], memory)
            finish_tick(
                memory, param, trajectories[v], peer_tables[v], peers[v], faces[v], body[AB_VOLTS]
            )

            motors = memory[F_MOTORS:F_SUPPLY]
            if not is_asleep(body, motors, fx, fy, fz):
                vx, vy, vz = body[B_VEL], body[B_VEL + 1], body[B_VEL + 2]
                arena_step(body, plant, motors, fx, fy, fz, DT)
                note_contact(body, resolve(body, plant, scene, ground, DT, works[v]))
                note_acceleration(body, vx, vy, vz, DT)
            if k < trace.shape[0]:
                _trace(trace[k], time + (k + 1.0) * DT, body, memory)
