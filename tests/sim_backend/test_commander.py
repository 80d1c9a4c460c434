"""Setpoint arbitration and tumble detection, from the documented rules."""

from __future__ import annotations

import numpy as np
import pytest

from crazyarena.sim_backend.firmware import commander as c
from crazyarena.sim_backend.firmware import tumble as t
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
    MODE_VELOCITY,
    SETPOINT_SIZE,
    SP_ATT,
    SP_POS,
    SP_RATE,
    SP_TIME,
)


def setpoint(z=1.0):
    row = np.zeros(SETPOINT_SIZE)
    row[[M_X, M_Y, M_Z, M_QUAT]] = MODE_ABS
    row[SP_POS : SP_POS + 3] = 0.5, -0.5, z
    row[SP_ATT : SP_ATT + 3] = row[SP_RATE : SP_RATE + 3] = 5.0
    return row


def now_in_force(m):
    out = np.full(SETPOINT_SIZE, np.nan)
    c.commander_get(m, out)
    return out


def test_equal_or_higher_priority_wins():
    m = c.commander_memory()
    assert c.commander_set(m, setpoint(1), c.PRIORITY_HIGH_LEVEL, 10.0) == c.ACCEPTED
    assert c.commander_set(m, setpoint(2), c.PRIORITY_CRTP, 20.0) == c.ACCEPTED_STOP_PLANNER
    assert c.commander_set(m, setpoint(3), c.PRIORITY_HIGH_LEVEL, 30.0) == c.REFUSED
    assert now_in_force(m)[SP_POS + 2] == 2.0
    assert now_in_force(m)[SP_TIME] == 20.0
    assert c.commander_set(m, setpoint(4), c.PRIORITY_CRTP, 40.0) == c.ACCEPTED_STOP_PLANNER
    assert c.commander_set(m, setpoint(5), c.PRIORITY_EXTERNAL, 50.0) == c.ACCEPTED_STOP_PLANNER
    assert c.commander_set(m, setpoint(6), c.PRIORITY_CRTP, 60.0) == c.REFUSED
    assert now_in_force(m)[SP_POS + 2] == 5.0


def test_notify_opens_the_way_for_the_high_level_commander():
    m = c.commander_memory()
    c.commander_set(m, setpoint(2), c.PRIORITY_CRTP, 20.0)
    c.commander_relax(m)
    assert now_in_force(m)[SP_POS + 2] == 2.0
    assert c.commander_set(m, np.zeros(SETPOINT_SIZE), c.PRIORITY_HIGH_LEVEL, 30.0) == c.ACCEPTED
    assert not now_in_force(m)[:SP_TIME].any()


@pytest.mark.parametrize(
    ("age", "planner_stopped", "expected"),
    [
        (0.0, False, c.LOW_LEVEL),
        (500.0, False, c.LOW_LEVEL),
        (501.0, False, c.LEVELLED_OUT),
        (2000.0, False, c.LEVELLED_OUT),
        (2001.0, False, c.HIGH_LEVEL),
        (2001.0, True, c.NULL),
    ],
)
def test_2022_ageing(age, planner_stopped, expected):
    m = c.commander_memory()
    c.commander_set_2022(m, setpoint(1.5), c.PRIORITY_2022_CRTP, 7000.0)
    out = np.full(SETPOINT_SIZE, 99.0)
    assert c.commander_get_2022(m, 7000.0 + age, True, planner_stopped, out) == expected
    if expected == c.LOW_LEVEL:
        np.testing.assert_array_equal(out[:SP_TIME], setpoint(1.5)[:SP_TIME])
        assert m[c.CM_PRIORITY] == c.PRIORITY_2022_CRTP
    elif expected == c.LEVELLED_OUT:
        assert (out[M_X], out[M_Y], out[M_Z]) == (MODE_DISABLE, MODE_DISABLE, MODE_ABS)
        assert (out[M_ROLL], out[M_PITCH], out[M_YAW]) == (MODE_ABS, MODE_ABS, MODE_VELOCITY)
        assert out[SP_POS + 2] == 1.5
        assert out[SP_ATT] == out[SP_ATT + 1] == out[SP_RATE + 2] == 0.0
        assert m[c.CM_PRIORITY] == c.PRIORITY_DISABLED
    elif expected == c.HIGH_LEVEL:
        assert (out == 99.0).all()
    else:
        assert not out.any()


def test_2022_high_level_can_be_switched_off():
    m = c.commander_memory()
    out = np.ones(SETPOINT_SIZE)
    assert c.commander_get_2022(m, 2001.0, False, False, out) == c.NULL
    assert not out.any()


def test_2022_notify_keeps_the_setpoint_for_the_given_time():
    m, out = c.commander_memory(), np.zeros(SETPOINT_SIZE)
    c.commander_set_2022(m, setpoint(), c.PRIORITY_2022_CRTP, 7000.0)
    c.commander_notify_2022(m, 100.0, 7040.0)
    assert c.commander_get_2022(m, 7140.0, True, False, out) != c.HIGH_LEVEL
    assert c.commander_get_2022(m, 7141.0, True, False, out) == c.HIGH_LEVEL


def test_2022_notify_right_after_boot_does_not_stamp_before_zero():
    m = c.commander_memory()
    c.commander_notify_2022(m, 0.0, 300.0)
    assert m[c.CM_SETPOINT + SP_TIME] == 0.0


def test_2022_higher_source_keeps_control_until_it_ages():
    m, out = c.commander_memory(), np.zeros(SETPOINT_SIZE)
    c.commander_set_2022(m, setpoint(2), c.PRIORITY_2022_EXTERNAL, 100.0)
    assert c.commander_set_2022(m, setpoint(3), c.PRIORITY_2022_CRTP, 200.0) == c.REFUSED
    c.commander_get_2022(m, 700.0, True, True, out)
    accepted = c.commander_set_2022(m, setpoint(3), c.PRIORITY_2022_CRTP, 700.0)
    assert accepted == c.ACCEPTED_STOP_PLANNER


def test_tumble_2022_needs_15_loops_with_running_motors():
    m = np.zeros(t.TUMBLE_SIZE)
    assert not any(t.tumble_2022(m, -0.9, 1000.0) for _ in range(100))
    assert not any(t.tumble_2022(m, -0.5, 1001.0) for _ in range(14))
    assert not t.tumble_2022(m, -0.49, 40000.0)
    found = [t.tumble_2022(m, -0.5, 40000.0) for _ in range(15)]
    assert found == [False] * 14 + [True]
    assert t.tumble_2022(m, 1.0, 40000.0)


def test_tumble_in_the_competition_needs_30_ticks():
    m = np.zeros(t.TUMBLE_SIZE)
    assert not any(t.tumble_competition(m, -0.5) for _ in range(100))
    assert not any(t.tumble_competition(m, -0.51) for _ in range(29))
    assert not t.tumble_competition(m, 0.0)
    found = [t.tumble_competition(m, -0.51) for _ in range(30)]
    assert found == [False] * 29 + [True]
