"""Supervisor of the 2026 firmware: may the vehicle be armed, fly, turn its motors?

A state machine updated at 25 Hz from condition bits. One vehicle is one float64 row of
``SUPERVISOR_SIZE`` numbers; times are milliseconds of the firmware clock.
"""

from __future__ import annotations

import numpy as np

from crazyarena.jit import kernel
from crazyarena.sim_backend.firmware.commander import level_out
from crazyarena.sim_backend.firmware.layout import SETPOINT_SIZE, ST_ACCEL
from crazyarena.sim_backend.firmware.parameters import Param

PARAMS = (
    Param("supervisor.prefltTimeout", None, 30000.0, "uint16"),
    Param("supervisor.landedTimeout", None, 3000.0, "uint16"),
    Param("supervisor.spinupTimeout", None, 2000.0, "uint16"),
    Param("supervisor.tmblChckEn", None, 1.0, "uint8"),
    Param("stabilizer.stop", 0.0, 0.0, "uint8"),
)
SVP_PREFLIGHT_MS, SVP_LANDED_MS, SVP_SPINUP_MS, SVP_TUMBLE_CHECK, SVP_STOP = range(5)

# States.
(
    NOT_INITIALISED,
    PREFLIGHT_FAILED,
    PREFLIGHT_PASSED,
    ARMING,
    READY,
    FLYING,
    LANDED,
    RESET,
    WARNING_LEVEL_OUT,
    EXCEPTION,
    LOCKED,
    CRASHED,
) = range(12)

# Condition bits.
C_ARMED = 1 << 0
C_FLYING = 1 << 1
C_TUMBLED = 1 << 2
C_WARNING = 1 << 3
C_TIMEOUT = 1 << 4
C_STOP = 1 << 5
C_CRASHED = 1 << 6
C_PREFLIGHT_TIMEOUT = 1 << 7
C_LANDED_TIMEOUT = 1 << 8
C_DECK_FAULT = 1 << 9
C_RPM_VALID = 1 << 10
C_SPINUP_TIMEOUT = 1 << 11
C_MOTOR_FAULT = 1 << 12

# Bits of supervisor.info.
INFO_CAN_ARM = 1 << 0
INFO_ARMED = 1 << 1
INFO_AUTO_ARM = 1 << 2
INFO_CAN_FLY = 1 << 3
INFO_FLYING = 1 << 4
INFO_TUMBLED = 1 << 5
INFO_LOCKED = 1 << 6
INFO_CRASHED = 1 << 7
INFO_HL_ACTIVE = 1 << 8
INFO_HL_FINISHED = 1 << 9
INFO_HL_DISABLED = 1 << 10
INFO_DECK_FAULT = 1 << 11

# Memory row. A time of NONE is "never".
SV_STATE = 0
SV_ARMED = 1
SV_CRASHED = 2
SV_TUMBLED = 3
SV_STOP = 4  # emergency stop requested; stays
SV_WATCHDOG = 5  # ms, last notification of the emergency-stop watchdog
SV_THRUST = 6  # ms, last time a motor turned above idle
SV_TILT = 7  # ms, when the present tilt began
SV_ARMED_AT = 8  # ms, entry of READY
SV_LANDED_AT = 9  # ms, entry of LANDED
SV_ARMING_AT = 10  # ms, entry of ARMING
SV_AUTO_ARM = 11  # 1.0: arms by itself after the preflight checks
SV_DECK_FAULT = 12
SV_CONDITIONS = 13
SV_INFO = 14
SUPERVISOR_SIZE = 15

NONE = -1.0
_WATCHDOG_MS = 1000.0
_FLYING_MS = 2000.0
_WARNING_MS = 500.0
_TIMEOUT_MS = 2000.0
_TILT_MS = 1000.0
_UPSIDE_DOWN_MS = 100.0


def supervisor_memory(auto_arm: bool = True) -> np.ndarray:
    """Memory row of a vehicle that has just booted."""
    memory = np.zeros(SUPERVISOR_SIZE)
    memory[SV_WATCHDOG : SV_ARMING_AT + 1] = NONE
    memory[SV_AUTO_ARM] = float(auto_arm)
    return memory


@kernel
def transition(state, conditions):
    """Next state for a state and a word of condition bits; the first matching rule wins."""
    armed = conditions & C_ARMED != 0
    flying = conditions & C_FLYING != 0
    tumbled = conditions & C_TUMBLED != 0
    stop = conditions & C_STOP != 0
    deck = conditions & C_DECK_FAULT != 0
    motor = conditions & C_MOTOR_FAULT != 0
    if state in (NOT_INITIALISED, RESET):
        return PREFLIGHT_FAILED
    if state == PREFLIGHT_FAILED:
        if stop:
            return EXCEPTION
        return state if tumbled or deck else PREFLIGHT_PASSED
    if state == PREFLIGHT_PASSED:
        if stop:
            return EXCEPTION
        if tumbled or deck:
            return PREFLIGHT_FAILED
        return ARMING if armed else state
    if state == ARMING:
        if stop:
            return EXCEPTION
        if tumbled or conditions & C_SPINUP_TIMEOUT != 0 or not armed:
            return PREFLIGHT_FAILED
        return READY if conditions & C_RPM_VALID != 0 else state
    if state == READY:
        if stop or motor:
            return EXCEPTION
        if tumbled or conditions & C_PREFLIGHT_TIMEOUT != 0 or deck or not armed:
            return PREFLIGHT_FAILED
        return FLYING if flying else state
    if state == FLYING:
        if conditions & C_TIMEOUT != 0 or stop or deck or motor:
            return EXCEPTION
        if tumbled:
            return CRASHED
        if not armed:
            return RESET
        if conditions & C_WARNING != 0:
            return WARNING_LEVEL_OUT
        return state if flying else LANDED
    if state == LANDED:
        if conditions & C_LANDED_TIMEOUT != 0 or not armed:
            return RESET
        if motor:
            return EXCEPTION
        return FLYING if flying else state
    if state == WARNING_LEVEL_OUT:
        if conditions & C_TIMEOUT != 0 or tumbled or stop or deck or motor:
            return EXCEPTION
        return state if conditions & C_WARNING != 0 else FLYING
    if state == EXCEPTION:
        return LOCKED
    if state == CRASHED:
        if conditions & C_CRASHED == 0 and not tumbled:
            return PREFLIGHT_FAILED
        return LOCKED if stop else state
    return state


@kernel
def supervisor_can_fly(m):
    """True when setpoints are passed on to the controller."""
    state = m[SV_STATE]
    return state in (READY, FLYING, LANDED, WARNING_LEVEL_OUT)


@kernel
def supervisor_motors_allowed(m):
    """True when the motors may turn."""
    return supervisor_can_fly(m) or m[SV_STATE] == ARMING


@kernel
def supervisor_request_arming(m, arm):
    """Arm or disarm; 1.0 when accepted (or already so), else 0.0."""
    value = 1.0 if arm else 0.0
    if m[SV_ARMED] == value:
        return 1.0
    if m[SV_STATE] != PREFLIGHT_PASSED and arm:
        return 0.0
    m[SV_ARMED] = value
    return 1.0


@kernel
def supervisor_request_recovery(m):
    """Clear the crashed flag; 1.0 when the vehicle is not crashed afterwards, else 0.0."""
    if m[SV_TUMBLED] == 0.0:
        m[SV_CRASHED] = 0.0
    return 1.0 - m[SV_CRASHED]


@kernel
def supervisor_feed_watchdog(m, now_ms):
    """Notify the emergency-stop watchdog, which is active from its first notification on."""
    m[SV_WATCHDOG] = now_ms


@kernel
def _tumbled(m, p, now_ms, ax, ay, az):
    if p[SVP_TUMBLE_CHECK] == 0.0:
        return False
    free_fall = abs(ax) < 0.1 and abs(ay) < 0.1 and abs(az) < 0.1
    if az >= 0.5 or free_fall:
        m[SV_TILT] = NONE
        return False
    if m[SV_TILT] == NONE:
        m[SV_TILT] = now_ms
    tilted = now_ms - m[SV_TILT]
    return tilted > _TILT_MS or (az < -0.2 and tilted > _UPSIDE_DOWN_MS)


@kernel
def supervisor_update(m, p, state, now_ms, setpoint_ms, motor_max, idle, planner, finished):
    """Evaluate the conditions and advance the state machine (25 Hz).

    Parameters
    ----------
    m: memory row.
    p: parameter row of ``PARAMS``.
    state: state row, of which ST_ACCEL (g) is read.
    now_ms, setpoint_ms: firmware clock; time stamp of the setpoint in force.
    motor_max, idle: largest motor command and the idle command, 0..65535.
    planner: state of the high-level planner (0 idle, 1 flying, 3 landing, 4 disabled).
    finished: whether the planner's trajectory has ended.
    """
    if motor_max > idle:
        m[SV_THRUST] = now_ms
    tumbled = _tumbled(m, p, now_ms, state[ST_ACCEL], state[ST_ACCEL + 1], state[ST_ACCEL + 2])
    m[SV_TUMBLED] = 1.0 if tumbled else 0.0
    current = int(m[SV_STATE])
    age = now_ms - setpoint_ms

    conditions = C_RPM_VALID
    if m[SV_ARMED] != 0.0:
        conditions |= C_ARMED
    if m[SV_THRUST] != NONE and now_ms - m[SV_THRUST] < _FLYING_MS:
        conditions |= C_FLYING
    if tumbled:
        conditions |= C_TUMBLED
    if age > _WARNING_MS:
        conditions |= C_WARNING
    if age > _TIMEOUT_MS:
        conditions |= C_TIMEOUT
    unfed = m[SV_WATCHDOG] != NONE and now_ms - m[SV_WATCHDOG] > _WATCHDOG_MS
    if m[SV_STOP] != 0.0 or p[SVP_STOP] != 0.0 or unfed:
        conditions |= C_STOP
    if m[SV_CRASHED] != 0.0:
        conditions |= C_CRASHED
    if current == READY and now_ms - m[SV_ARMED_AT] > p[SVP_PREFLIGHT_MS]:
        conditions |= C_PREFLIGHT_TIMEOUT
    # Not tied to the state: the bit stays up until the next landing.
    if m[SV_LANDED_AT] != NONE and now_ms - m[SV_LANDED_AT] > p[SVP_LANDED_MS]:
        conditions |= C_LANDED_TIMEOUT
    if m[SV_DECK_FAULT] != 0.0:
        conditions |= C_DECK_FAULT
    if current == ARMING and now_ms - m[SV_ARMING_AT] > p[SVP_SPINUP_MS]:
        conditions |= C_SPINUP_TIMEOUT
    m[SV_CONDITIONS] = conditions

    following = transition(current, conditions)
    m[SV_STATE] = following
    if following != current:
        _enter(m, following, now_ms)
    m[SV_INFO] = _info(m, following, planner, finished)


@kernel
def _enter(m, state, now_ms):
    if state == PREFLIGHT_PASSED and m[SV_AUTO_ARM] != 0.0:
        m[SV_ARMED] = 1.0
    elif state == ARMING:
        m[SV_ARMING_AT] = now_ms
    elif state == READY:
        m[SV_ARMED_AT] = now_ms
    elif state == LANDED:
        m[SV_LANDED_AT] = now_ms
    elif state == CRASHED:
        m[SV_CRASHED] = 1.0
    if not (
        (state == PREFLIGHT_PASSED and m[SV_AUTO_ARM] != 0.0)
        or (state >= ARMING and state <= LANDED)
        or state == WARNING_LEVEL_OUT
    ):
        m[SV_ARMED] = 0.0


@kernel
def _info(m, state, planner, finished):
    info = 0
    if state == PREFLIGHT_PASSED:
        info |= INFO_CAN_ARM
    if m[SV_ARMED] != 0.0:
        info |= INFO_ARMED
    if m[SV_AUTO_ARM] != 0.0:
        info |= INFO_AUTO_ARM
    if supervisor_can_fly(m):
        info |= INFO_CAN_FLY
    if state in (FLYING, WARNING_LEVEL_OUT):
        info |= INFO_FLYING
    if m[SV_TUMBLED] != 0.0:
        info |= INFO_TUMBLED
    if state == LOCKED:
        info |= INFO_LOCKED
    if m[SV_CRASHED] != 0.0:
        info |= INFO_CRASHED
    if planner == 1 or planner == 3:
        info |= INFO_HL_ACTIVE
    if finished:
        info |= INFO_HL_FINISHED
    if planner == 4:
        info |= INFO_HL_DISABLED
    if m[SV_DECK_FAULT] != 0.0:
        info |= INFO_DECK_FAULT
    return info


@kernel
def supervisor_override(m, setpoint):
    """Replace the setpoint as the state demands: kept, levelled out, or null."""
    state = m[SV_STATE]
    if state == WARNING_LEVEL_OUT:
        level_out(setpoint)
    elif not (state >= ARMING and state <= LANDED):
        for i in range(SETPOINT_SIZE):
            setpoint[i] = 0.0
