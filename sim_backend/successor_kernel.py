"""One step of lsy_drone_racing's environment, compiled.

At the beginning of the step the position part of the controller answers the command (in state
mode), with the integral of its own rate; then every physics tick: attitude part when it is due,
plant, contacts.
"""

from __future__ import annotations

import math

import numpy as np

from crazyarena.jit import kernel
from crazyarena.sim_backend.firmware.successor_control import (
    CM_COMMAND,
    CONTROL_MEM_SIZE,
    attitude_part,
    position_part,
)
from crazyarena.sim_backend.physics.successor_plant import (
    PLANT_STATE_SIZE,
    PP_THRUST,
    SS_POS,
    SS_QUAT,
    SS_RATE,
    SS_ROTOR,
    SS_VEL,
    plant_step,
)
from crazyarena.sim_backend.physics.successor_scene import NO_CONTACT, place_drone, touched
from crazyarena.sim_backend.trace import (
    TR_ACTION,
    TR_CONTACT,
    TR_OMEGA,
    TR_POS,
    TR_QUAT,
    TR_RPY,
    TR_SETPOINT,
    TR_TIME,
    TR_VEL,
)

# What the vehicle is and remembers, in one row.
V_STATE = 0
V_CONTROL = V_STATE + PLANT_STATE_SIZE
V_MOTORS = V_CONTROL + CONTROL_MEM_SIZE  # rpm asked of the rotors, 4
V_TICK = V_MOTORS + 4
VEHICLE_SIZE = V_TICK + 1


@kernel
def _trace(row, time, state, par, code, setpoint, is_state):
    row[TR_TIME] = time
    for i in range(3):
        row[TR_POS + i] = state[SS_POS + i]
        row[TR_VEL + i] = state[SS_VEL + i]
        row[TR_OMEGA + i] = state[SS_RATE + i]
    x, y, z, w = state[SS_QUAT], state[SS_QUAT + 1], state[SS_QUAT + 2], state[SS_QUAT + 3]
    row[TR_QUAT], row[TR_QUAT + 1], row[TR_QUAT + 2], row[TR_QUAT + 3] = x, y, z, w
    row[TR_RPY] = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    row[TR_RPY + 1] = math.asin(min(max(2.0 * (w * y - z * x), -1.0), 1.0))
    row[TR_RPY + 2] = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    for i in range(4):
        rpm = state[SS_ROTOR + i]
        force = par[PP_THRUST] + rpm * (par[PP_THRUST + 1] + rpm * par[PP_THRUST + 2])
        # Motors count from front right; the trace from front left, both the other way round.
        row[TR_ACTION + 3 - i] = force
    row[TR_CONTACT] = code
    for i in range(10):
        row[TR_SETPOINT + i] = setpoint[i] if is_state else math.nan


@kernel
def step(vehicle, plant, control, solids, drone, command, is_state, limits, noise, rates, trace):
    """Fly one step of the environment.

    Parameters
    ----------
    vehicle: (VEHICLE_SIZE,); plant, control: parameter rows.
    solids: (n, SOLID_SIZE); drone: (SOLID_SIZE,), scratch.
    command: (13,) full state, or roll, pitch, yaw (rad) and thrust (N) in its first four.
    limits: thrust min and max of all motors together, N.
    noise: (ticks, 3) N, world.
    rates: Hz of physics, of the environment and of the attitude part.
    trace: (ticks, TRACE_SIZE), written.
    """
    state = vehicle[V_STATE:V_CONTROL]
    memory = vehicle[V_CONTROL:V_MOTORS]
    motors = vehicle[V_MOTORS:V_TICK]
    dt = 1.0 / rates[0]
    every = int(rates[0] / rates[2])
    if is_state:
        position_part(control, memory, state, command, 1.0 / rates[1])
    else:
        half = 0.5 * math.pi
        for i in range(3):
            memory[CM_COMMAND + i] = min(max(command[i], -half), half)
        memory[CM_COMMAND + 3] = min(max(command[3], limits[0]), limits[1])
    for k in range(trace.shape[0]):
        tick = int(vehicle[V_TICK])
        if tick % every == 0:
            attitude_part(control, memory, state, motors, 1.0 / rates[2])
        plant_step(state, plant, motors, noise[k], dt)
        place_drone(
            drone, state[SS_POS], state[SS_POS + 1], state[SS_POS + 2],
            state[SS_QUAT], state[SS_QUAT + 1], state[SS_QUAT + 2], state[SS_QUAT + 3],
        )  # fmt: skip
        code = touched(solids, drone)
        vehicle[V_TICK] = tick + 1.0
        _trace(trace[k], (tick + 1.0) * dt, state, plant, code, command, is_state)


def new_vehicle(start: np.ndarray) -> np.ndarray:
    """Row of a vehicle with motors off at (13,) position, velocity, quaternion, body rates."""
    row = np.zeros(VEHICLE_SIZE)
    row[SS_POS : SS_RATE + 3] = start
    return row


__all__ = ["NO_CONTACT", "VEHICLE_SIZE", "new_vehicle", "step"]
