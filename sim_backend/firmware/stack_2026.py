"""The 1000 Hz loop of the 2026 firmware: sensors to motor commands, one vehicle, one tick.

``F_*`` are the parts of the memory row, ``P_*`` those of the parameter row, each in the layout
of the module that owns it. ``PARAMS`` lists every parameter of the row by name.
"""

from __future__ import annotations

import numpy as np

from crazyarena.jit import kernel
from crazyarena.sim_backend.firmware import (
    collision_avoidance,
    commander,
    high_level,
    kalman,
    lowpass,
    mellinger,
    pid,
    power,
    supervisor,
)
from crazyarena.sim_backend.firmware.layout import (
    CONTROL_SIZE,
    SETPOINT_SIZE,
    SP_TIME,
    ST_GYRO,
    ST_POS,
    STATE_SIZE,
)
from crazyarena.sim_backend.firmware.parameters import Param, default_row
from crazyarena.sim_backend.firmware.planner import PL_STATE, is_finished

_OWN_PARAMS = (
    Param("stabilizer.controller", 1.0, 1.0, "uint8"),
    Param("stabilizer.estimator", 2.0, 2.0, "uint8"),
    Param("commander.enHighLevel", 0.0, 0.0, "uint8"),
)
PARAMS = (
    *mellinger.PARAMS,
    *pid.PARAMS,
    *kalman.PARAMS,
    *supervisor.PARAMS,
    *high_level.PARAMS,
    *collision_avoidance.PARAMS,
    *power.PARAMS,
    *_OWN_PARAMS,
)
P_MELLINGER = 0
P_PID = P_MELLINGER + len(mellinger.PARAMS)
P_KALMAN = P_PID + len(pid.PARAMS)
P_SUPERVISOR = P_KALMAN + len(kalman.PARAMS)
P_HIGH_LEVEL = P_SUPERVISOR + len(supervisor.PARAMS)
P_AVOIDANCE = P_HIGH_LEVEL + len(high_level.PARAMS)
P_POWER = P_AVOIDANCE + len(collision_avoidance.PARAMS)
P_OWN = P_POWER + len(power.PARAMS)
P_CONTROLLER = P_OWN
PARAM_SIZE = len(PARAMS)

# Controllers. Any other number flies the PID: the remaining controllers are not modelled.
PID, MELLINGER = 1, 2

# Memory row.
F_STATE = 0
F_SETPOINT = F_STATE + STATE_SIZE  # as handed to the controller
F_CONTROL = F_SETPOINT + SETPOINT_SIZE
F_MOTORS = F_CONTROL + CONTROL_SIZE  # commands of M1..M4, 0..65535
F_SUPPLY = F_MOTORS + 4  # V, battery voltage after the low-pass
F_CONTROLLER = F_SUPPLY + 1  # controller of the previous tick
F_TICK = F_CONTROLLER + 1  # loops since boot, also the clock in ms
F_FILTERS = F_TICK + 1  # delays of gyro x, y, z and accelerometer x, y, z
F_MEASUREMENT = F_FILTERS + 6 * lowpass.DELAY_SIZE  # last external pose
F_OFFERED = F_MEASUREMENT + 7  # scratch: setpoint of the high-level commander
F_SUPERVISOR = F_OFFERED + SETPOINT_SIZE
F_COMMANDER = F_SUPERVISOR + supervisor.SUPERVISOR_SIZE
F_MELLINGER = F_COMMANDER + commander.COMMANDER_SIZE
F_PID = F_MELLINGER + mellinger.MEM_SIZE
F_AVOIDANCE = F_PID + pid.MEM_SIZE
F_KALMAN = F_AVOIDANCE + collision_avoidance.MEMORY_SIZE
F_HIGH_LEVEL = F_KALMAN + kalman.KALMAN_SIZE
F_PLATFORM = F_HIGH_LEVEL + high_level.HIGH_LEVEL_SIZE  # what it takes its vehicle for
FIRMWARE_SIZE = F_PLATFORM + power.PLATFORM_SIZE

GYRO_CUTOFF, ACCELEROMETER_CUTOFF = 80.0, 30.0  # Hz
_GYRO_FILTER = np.zeros(lowpass.COEF_SIZE)
_ACCEL_FILTER = np.zeros(lowpass.COEF_SIZE)
lowpass.coefficients.py_func(1000.0, GYRO_CUTOFF, _GYRO_FILTER)
lowpass.coefficients.py_func(1000.0, ACCELEROMETER_CUTOFF, _ACCEL_FILTER)
_FULL_BATTERY = 4.2


def firmware_memory(platform: np.ndarray, auto_arm: bool = True) -> np.ndarray:
    """Memory row of a vehicle that has just booted at firmware time 0.

    ``platform`` is what its build takes the vehicle for, see :func:`.power.platform_row`.
    """
    memory = np.zeros(FIRMWARE_SIZE)
    memory[F_SUPPLY] = _FULL_BATTERY
    memory[F_CONTROLLER] = PID
    memory[F_SUPERVISOR:F_COMMANDER] = supervisor.supervisor_memory(auto_arm)
    memory[F_COMMANDER:F_MELLINGER] = commander.commander_memory()
    memory[F_AVOIDANCE:F_KALMAN] = collision_avoidance.new_memory()
    memory[F_KALMAN:F_HIGH_LEVEL] = kalman.kalman_memory()
    kalman.kalman_init(memory[F_KALMAN:F_HIGH_LEVEL], default_row(kalman.PARAMS, 2026), 0.0)
    memory[F_HIGH_LEVEL:F_PLATFORM] = high_level.new_memory(2026)
    memory[F_PLATFORM:] = platform
    return memory


@kernel
def begin_tick(memory, params, gx, gy, gz, ax, ay, az):
    """Count the tick and run sensors and estimator up to its measurements.

    ``g*`` (deg/s) and ``a*`` (g, specific force) are the raw samples in body axes. External
    poses follow with :func:`measure`, then :func:`finish_tick`.
    """
    memory[F_TICK] += 1.0
    filters = memory[F_FILTERS:F_MEASUREMENT]
    samples = (gx, gy, gz, ax, ay, az)
    for i in range(6):
        taps = _GYRO_FILTER if i < 3 else _ACCEL_FILTER
        # Gyro and accelerometer lie next to each other in the state row.
        memory[F_STATE + ST_GYRO + i] = lowpass.apply(
            taps, filters, i * lowpass.DELAY_SIZE, samples[i]
        )
    flying = (
        memory[F_SUPERVISOR + supervisor.SV_STATE] == supervisor.FLYING
        or memory[F_SUPERVISOR + supervisor.SV_STATE] == supervisor.WARNING_LEVEL_OUT
    )
    state = memory[F_STATE:F_SETPOINT]
    estimator = memory[F_KALMAN:F_HIGH_LEVEL]
    kalman.kalman_advance(estimator, params[P_KALMAN:P_SUPERVISOR], state, memory[F_TICK], flying)


@kernel
def measure(memory, params, kind):
    """Fuse the external pose in F_MEASUREMENT (``kind`` as in :mod:`.kalman`)."""
    own = params[P_KALMAN:P_SUPERVISOR]
    kalman.kalman_measure(
        memory[F_KALMAN:F_HIGH_LEVEL],
        kind,
        memory[F_MEASUREMENT:F_OFFERED],
        own[kalman.KP_EXT_POS_STD],
        own[kalman.KP_EXT_QUAT_STD],
    )


@kernel
def offer_setpoint(memory, setpoint, priority):
    """Hand a setpoint row to the commander, as a packet does; stops the planner if it must."""
    answer = commander.commander_set(
        memory[F_COMMANDER:F_MELLINGER], setpoint, priority, memory[F_TICK]
    )
    if answer == commander.ACCEPTED_STOP_PLANNER:
        high_level.stop(memory[F_HIGH_LEVEL:F_PLATFORM])
    return answer


@kernel
def notify_setpoints_stop(memory):
    """Let the high-level commander take over from the present estimate."""
    high_level.tell_state(memory[F_HIGH_LEVEL:F_PLATFORM], memory[F_STATE:F_SETPOINT])
    commander.commander_relax(memory[F_COMMANDER:F_MELLINGER])


@kernel
def _control(memory, params, tick):
    state, setpoint = memory[F_STATE:F_SETPOINT], memory[F_SETPOINT:F_CONTROL]
    control = memory[F_CONTROL:F_MOTORS]
    chosen = MELLINGER if params[P_CONTROLLER] == MELLINGER else PID
    if chosen != memory[F_CONTROLLER]:
        memory[F_CONTROLLER] = chosen
        if chosen == MELLINGER:
            mellinger.reset(memory[F_MELLINGER:F_PID])
        else:
            for i in range(F_PID, F_AVOIDANCE):
                memory[i] = 0.0
    if chosen == PID:
        pid.pid_2026(
            params[P_PID:P_KALMAN], memory[F_PID:F_AVOIDANCE], state, setpoint, tick, control
        )
    elif tick % 2 == 0:
        mellinger.mellinger_2026(
            params[P_MELLINGER:P_PID], memory[F_MELLINGER:F_PID], state, setpoint, control
        )


@kernel
def finish_tick(memory, params, trajectories, peer_table, peers, faces, volts):
    """The tick after its measurements: estimate, setpoint, supervisor, controller, motors.

    Parameters
    ----------
    memory, params: rows of FIRMWARE_SIZE and PARAM_SIZE.
    trajectories: uint8 trajectory memory (4096,).
    peer_table, peers, faces: peers known for collision avoidance and its scratch arrays, see
        :mod:`.collision_avoidance`.
    volts: battery voltage.
    """
    now_ms = memory[F_TICK]
    tick = int(now_ms)
    state, setpoint = memory[F_STATE:F_SETPOINT], memory[F_SETPOINT:F_CONTROL]
    planner = memory[F_HIGH_LEVEL:F_PLATFORM]
    guard = memory[F_SUPERVISOR:F_COMMANDER]
    motors = memory[F_MOTORS:F_SUPPLY]
    estimator = memory[F_KALMAN:F_HIGH_LEVEL]
    kalman.kalman_complete(estimator, params[P_KALMAN:P_SUPERVISOR], state, now_ms)

    can_fly = supervisor.supervisor_can_fly(guard)
    high_level.block(planner, not can_fly)
    if can_fly and tick % 10 == 0:
        offered = memory[F_OFFERED:F_SUPERVISOR]
        answer = high_level.get_setpoint(planner, trajectories, 1e-3 * now_ms, state, offered)
        if answer != high_level.SETPOINT_UNTOUCHED:
            commander.commander_set(
                memory[F_COMMANDER:F_MELLINGER], offered, commander.PRIORITY_HIGH_LEVEL, now_ms
            )
    commander.commander_get(memory[F_COMMANDER:F_MELLINGER], setpoint)
    if not can_fly:
        for i in range(SP_TIME):
            setpoint[i] = 0.0

    idle = params[P_POWER + power.IDLE_THRUST]
    if tick % 40 == 0:
        supervisor.supervisor_update(
            guard,
            params[P_SUPERVISOR:P_HIGH_LEVEL],
            state,
            now_ms,
            setpoint[SP_TIME],
            max(max(motors[0], motors[1]), max(motors[2], motors[3])),
            idle,
            planner[PL_STATE],
            is_finished(planner, trajectories, 1e-3 * now_ms),
        )
    if params[P_AVOIDANCE + collision_avoidance.P_ENABLE] != 0.0:
        own = params[P_AVOIDANCE:P_POWER]
        count = collision_avoidance.current_peers(
            peer_table, now_ms, own[collision_avoidance.P_MAX_AGE], peers
        )
        collision_avoidance.avoid_collisions(
            own,
            memory[F_AVOIDANCE:F_KALMAN],
            state[ST_POS],
            state[ST_POS + 1],
            state[ST_POS + 2],
            peers,
            count,
            setpoint,
            faces,
        )
    supervisor.supervisor_override(guard, setpoint)
    _control(memory, params, tick)

    memory[F_SUPPLY] = power.filter_supply(memory[F_SUPPLY], volts)
    if supervisor.supervisor_motors_allowed(guard):
        power.distribute_2026(
            memory[F_PLATFORM:], memory[F_CONTROL:F_MOTORS], memory[F_SUPPLY], idle, motors
        )
    else:
        for i in range(4):
            motors[i] = 0.0
