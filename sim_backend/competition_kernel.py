"""One control period of the IROS 2022 pipeline for one vehicle or many worlds, compiled.

Order of work inside a 2 ms tick: plant step under the *previous* tick's rotor forces, sensors,
tumble test, high-level setpoint (unless a full-state command has taken over), controller when
its timing rule says so, mixer, new forces. Commands are executed between control periods.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from crazyarena.jit import kernel
from crazyarena.sim_backend.firmware import high_level, mellinger, power, tumble, wrapper_sensors
from crazyarena.sim_backend.firmware.layout import (
    CONTROL_SIZE,
    M_QUAT,
    M_X,
    M_Z,
    MODE_ABS,
    SETPOINT_SIZE,
    SP_ACC,
    SP_ATT,
    SP_MODE,
    SP_POS,
    SP_QUAT,
    SP_RATE,
    SP_VEL,
    ST_ACC,
    STATE_SIZE,
)
from crazyarena.sim_backend.physics import competition_step as plant_step
from crazyarena.sim_backend.physics import contact
from crazyarena.sim_backend.physics.competition_step import (
    B_OMEGA,
    B_POS,
    B_QUAT,
    B_RPY,
    B_VEL,
    BODY_SIZE,
)
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

TICK_RATE = 500
_RAD = math.pi / 180.0

# What a vehicle's computer remembers from tick to tick, in one row.
F_STATE = 0
F_SETPOINT = F_STATE + STATE_SIZE
F_CONTROL = F_SETPOINT + SETPOINT_SIZE
F_MELLINGER = F_CONTROL + CONTROL_SIZE
F_SENSORS = F_MELLINGER + mellinger.MEM_SIZE
F_TIMING = F_SENSORS + wrapper_sensors.MEM_SIZE
F_TUMBLE = F_TIMING + wrapper_sensors.TIMING_SIZE
F_ACTION = F_TUMBLE + tumble.TUMBLE_SIZE  # N, four rotors, asked of the next tick
F_PWM = F_ACTION + 4
F_TICK = F_PWM + 4  # ticks since reset
F_STREAMING = F_TICK + 1  # 1.0 while a full-state command has taken over
F_HIGH_LEVEL = F_STREAMING + 1
FIRMWARE_SIZE = F_HIGH_LEVEL + high_level.HIGH_LEVEL_SIZE


@kernel
def reset(body, firmware, x, y, z, vx, vy, vz, roll, pitch, yaw, p, q, r):
    """Start an episode. The planner and the controller's rate memory live on, as they did."""
    plant_step.set_pose(body, x, y, z, roll, pitch, yaw)
    body[B_VEL], body[B_VEL + 1], body[B_VEL + 2] = vx, vy, vz
    body[B_OMEGA], body[B_OMEGA + 1], body[B_OMEGA + 2] = p, q, r
    for i in range(F_MELLINGER):
        firmware[i] = 0.0
    mellinger.reset(firmware[F_MELLINGER:F_SENSORS])
    wrapper_sensors.reset(firmware[F_SENSORS:F_TIMING], vx, vy, vz, roll, pitch, yaw)
    for i in range(F_TIMING, F_HIGH_LEVEL):
        firmware[i] = 0.0
    firmware[F_STREAMING] = 1.0
    state = firmware[F_STATE:F_SETPOINT]
    wrapper_sensors.sense(
        firmware[F_SENSORS:F_TIMING], x, y, z, vx, vy, vz, roll, pitch, yaw, state
    )
    wrapper_sensors.reset(firmware[F_SENSORS:F_TIMING], vx, vy, vz, roll, pitch, yaw)
    high_level.tell_state(firmware[F_HIGH_LEVEL:], state)


@kernel
def full_state(firmware, values):
    """Stream position 3, velocity 3, acceleration 3 (SI), yaw rad, body rates 3 rad/s."""
    sp = firmware[F_SETPOINT:F_CONTROL]
    for i in range(3):
        sp[SP_POS + i] = values[i]
        sp[SP_VEL + i] = values[3 + i]
        sp[SP_ACC + i] = values[6 + i]
        sp[SP_RATE + i] = values[10 + i] / _RAD
    for i in range(7):
        sp[SP_MODE + i] = 0.0
    for i in range(M_X, M_Z + 1):
        sp[i] = MODE_ABS
    sp[M_QUAT] = MODE_ABS
    sp[SP_QUAT], sp[SP_QUAT + 1] = 0.0, 0.0
    sp[SP_QUAT + 2], sp[SP_QUAT + 3] = math.sin(0.5 * values[9]), math.cos(0.5 * values[9])
    firmware[F_STREAMING] = 1.0


@kernel
def _trace(row, time, body, firmware, contact_code):
    row[TR_TIME] = time
    for i in range(3):
        row[TR_POS + i] = body[B_POS + i]
        row[TR_RPY + i] = body[B_RPY + i]
        row[TR_VEL + i] = body[B_VEL + i]
        row[TR_OMEGA + i] = body[B_OMEGA + i]
        row[TR_SETPOINT + i] = firmware[F_SETPOINT + SP_POS + i]
        row[TR_SETPOINT + 3 + i] = firmware[F_SETPOINT + SP_VEL + i]
        row[TR_SETPOINT + 6 + i] = firmware[F_SETPOINT + SP_ACC + i]
    for i in range(4):
        row[TR_QUAT + i] = body[B_QUAT + i]
    sp = firmware[F_SETPOINT:F_CONTROL]
    if sp[M_QUAT] == MODE_ABS:
        row[TR_SETPOINT + 9] = 2.0 * math.atan2(sp[SP_QUAT + 2], sp[SP_QUAT + 3])
    else:
        row[TR_SETPOINT + 9] = sp[SP_ATT + 2] * _RAD
    row[TR_CONTACT] = contact_code
    row[TR_TUMBLED] = firmware[F_TUMBLE + tumble.TB_TUMBLED]


@kernel
def advance(body, plant, firmware, gains, memory, scene, ground, work, noise, n_ticks, trace):
    """Run ``n_ticks`` ticks of one vehicle.

    Parameters
    ----------
    body, plant, firmware, gains: rows of the vehicle; memory: its trajectory memory.
    scene, ground, work: see :mod:`.physics.geometry`.
    noise: (>= n_ticks, 7) added rotor forces (4) and world force (3), N.
    trace: (>= n_ticks, TRACE_SIZE), written; with no rows nothing is written.
    """
    state = firmware[F_STATE:F_SETPOINT]
    setpoint = firmware[F_SETPOINT:F_CONTROL]
    control = firmware[F_CONTROL:F_MELLINGER]
    mellinger_mem = firmware[F_MELLINGER:F_SENSORS]
    sensors = firmware[F_SENSORS:F_TIMING]
    timing = firmware[F_TIMING:F_TUMBLE]
    tumbling = firmware[F_TUMBLE:F_ACTION]
    action = firmware[F_ACTION:F_PWM]
    pwm = firmware[F_PWM:F_TICK]
    commander = firmware[F_HIGH_LEVEL:]
    for k in range(n_ticks):
        tick = int(firmware[F_TICK])
        traced = k < trace.shape[0]
        if traced:
            for i in range(4):
                trace[k, TR_ACTION + i] = action[i]
        plant_step.step(
            body, plant,
            plant_step.rotor_rpm(action[0], noise[k, 0]),
            plant_step.rotor_rpm(action[1], noise[k, 1]),
            plant_step.rotor_rpm(action[2], noise[k, 2]),
            plant_step.rotor_rpm(action[3], noise[k, 3]),
            noise[k, 4], noise[k, 5], noise[k, 6],
        )  # fmt: skip
        code = contact.resolve(body, plant, scene, ground, plant_step.DT, work)
        plant_step.update_rpy(body)
        wrapper_sensors.sense(
            sensors, body[B_POS], body[B_POS + 1], body[B_POS + 2],
            body[B_VEL], body[B_VEL + 1], body[B_VEL + 2],
            body[B_RPY], body[B_RPY + 1], body[B_RPY + 2], state,
        )  # fmt: skip
        tumbled = tumble.tumble_competition(tumbling, state[ST_ACC + 2])
        if firmware[F_STREAMING] == 0.0:
            high_level.tell_state(commander, state)
            high_level.get_setpoint(commander, memory, tick / TICK_RATE, state, setpoint)
        if wrapper_sensors.controller_tick(timing, tick) != wrapper_sensors.TICK_SKIP:
            mellinger.mellinger_2022(gains, mellinger_mem, state, setpoint, control)
        if tumbled:
            for i in range(4):
                action[i] = 0.0
        else:
            power.distribute_competition(control, pwm, action)
        firmware[F_TICK] = tick + 1.0
        if traced:
            _trace(trace[k], (tick + 1.0) / TICK_RATE, body, firmware, code)


@kernel
def ticks_due(first, control_step, control_rate):
    """How many ticks from ``first`` on belong to a control step (both counted from 0)."""
    last = first
    while wrapper_sensors.step_due(last, control_step, control_rate):
        last += 1
    return last - first


@kernel(parallel=True)
def advance_worlds(
    bodies, plants, firmware, gains, memory, scenes, ground, work, noise, n_ticks, trace
):
    """:func:`advance` for many independent worlds; first axis of every array is the world.

    Gains and trajectory memory are shared; so is ``noise`` when it has a single world.
    """
    for w in numba.prange(bodies.shape[0]):
        advance(
            bodies[w], plants[w], firmware[w], gains, memory, scenes[w], ground, work[w],
            noise[w % noise.shape[0]], n_ticks, trace[w % trace.shape[0]],
        )  # fmt: skip


@kernel
def full_state_worlds(firmware, values):
    """:func:`full_state` for many worlds: (worlds, FIRMWARE_SIZE) and (worlds, 13)."""
    for w in range(firmware.shape[0]):
        full_state(firmware[w], values[w])


def new_rows(worlds: int) -> tuple[np.ndarray, np.ndarray]:
    """Body and firmware rows of freshly booted vehicles: (worlds, BODY_SIZE), (worlds, ...)."""
    firmware = np.zeros((worlds, FIRMWARE_SIZE))
    firmware[:, F_HIGH_LEVEL:] = high_level.new_memory(2022)
    return np.zeros((worlds, BODY_SIZE)), firmware
