"""Arbitration between setpoint sources, in both firmware generations.

One vehicle is one float64 row of ``COMMANDER_SIZE`` numbers: the last accepted setpoint with
its time stamp (ms of the firmware clock), and the priority in force.

2026: a setpoint of at least the present priority wins; timeouts are the supervisor's business.
2022: the commander itself levels out and falls back to the high-level planner as the last
low-level setpoint ages.
"""

from __future__ import annotations

import numpy as np

from crazyarena.jit import kernel
from crazyarena.sim_backend.firmware.layout import (
    M_PITCH,
    M_ROLL,
    M_X,
    M_Y,
    M_YAW,
    MODE_ABS,
    MODE_DISABLE,
    MODE_VELOCITY,
    SETPOINT_SIZE,
    SP_ATT,
    SP_RATE,
    SP_TIME,
)

# Memory row.
CM_SETPOINT = 0
CM_PRIORITY = SETPOINT_SIZE
COMMANDER_SIZE = SETPOINT_SIZE + 1

# Priorities of 2026. The 2022 firmware has 0 disabled, 1 CRTP, 2 external receiver.
PRIORITY_DISABLED = 0
PRIORITY_HIGH_LEVEL = 1
PRIORITY_CRTP = 2
PRIORITY_EXTERNAL = 3
PRIORITY_2022_CRTP = 1
PRIORITY_2022_EXTERNAL = 2

# Answers of commander_set.
REFUSED = 0
ACCEPTED = 1
ACCEPTED_STOP_PLANNER = 2

# Answers of commander_get_2022.
LOW_LEVEL = 0
LEVELLED_OUT = 1
HIGH_LEVEL = 2
NULL = 3

_LEVEL_OUT_MS = 500.0
_SHUTDOWN_MS = 2000.0


def commander_memory() -> np.ndarray:
    """Memory row after boot: null setpoint, stamped 0 ms, any source may take over."""
    return np.zeros(COMMANDER_SIZE)


@kernel
def level_out(setpoint):
    """Turn a setpoint into "stay level, no yaw rate", keeping its z mode and value."""
    setpoint[M_X] = MODE_DISABLE
    setpoint[M_Y] = MODE_DISABLE
    setpoint[M_ROLL] = MODE_ABS
    setpoint[M_PITCH] = MODE_ABS
    setpoint[M_YAW] = MODE_VELOCITY
    setpoint[SP_ATT] = 0.0
    setpoint[SP_ATT + 1] = 0.0
    setpoint[SP_RATE + 2] = 0.0


@kernel
def _accept(m, setpoint, priority, now_ms):
    if priority < m[CM_PRIORITY]:
        return False
    for i in range(SETPOINT_SIZE):
        m[CM_SETPOINT + i] = setpoint[i]
    m[CM_SETPOINT + SP_TIME] = now_ms
    m[CM_PRIORITY] = priority
    return True


@kernel
def commander_set(m, setpoint, priority, now_ms):
    """Offer a setpoint (2026).

    Returns
    -------
    REFUSED, ACCEPTED, or ACCEPTED_STOP_PLANNER: a source above the high-level commander took
    over, whose planner the caller must stop.
    """
    if not _accept(m, setpoint, priority, now_ms):
        return REFUSED
    return ACCEPTED_STOP_PLANNER if priority > PRIORITY_HIGH_LEVEL else ACCEPTED


@kernel
def commander_get(m, setpoint):
    """Copy the setpoint in force, with its SP_TIME, to ``setpoint``."""
    for i in range(SETPOINT_SIZE):
        setpoint[i] = m[CM_SETPOINT + i]


@kernel
def commander_relax(m):
    """Let the high-level commander take over (2026 notify-setpoints-stop).

    The caller also hands the estimate to the high-level commander. The setpoint in force stays
    until another is offered.
    """
    m[CM_PRIORITY] = PRIORITY_HIGH_LEVEL


@kernel
def commander_set_2022(m, setpoint, priority, now_ms):
    """Offer a setpoint (2022): REFUSED, or ACCEPTED_STOP_PLANNER."""
    if not _accept(m, setpoint, priority, now_ms):
        return REFUSED
    return ACCEPTED_STOP_PLANNER


@kernel
def commander_notify_2022(m, remain_valid_ms, now_ms):
    """Shift the time stamp so that the setpoint stays in force ``remain_valid_ms`` longer,
    after which the high-level commander may take over."""
    m[CM_SETPOINT + SP_TIME] = now_ms - min(_SHUTDOWN_MS - remain_valid_ms, now_ms)


@kernel
def commander_get_2022(m, now_ms, high_level, planner_stopped, setpoint):
    """Arbitrate (2022).

    Parameters
    ----------
    high_level: value of ``commander.enHighLevel``.
    planner_stopped: whether the planner is idle *after* it was asked for its setpoint.
    setpoint: written, except for HIGH_LEVEL, where the planner's answer is kept.

    Returns
    -------
    LOW_LEVEL, LEVELLED_OUT, HIGH_LEVEL or NULL.
    """
    age = now_ms - m[CM_SETPOINT + SP_TIME]
    if age > _SHUTDOWN_MS:
        if high_level and not planner_stopped:
            return HIGH_LEVEL
        for i in range(SETPOINT_SIZE):
            setpoint[i] = 0.0
        return NULL
    commander_get(m, setpoint)
    if age > _LEVEL_OUT_MS:
        m[CM_PRIORITY] = PRIORITY_DISABLED
        level_out(setpoint)
        return LEVELLED_OUT
    return LOW_LEVEL
