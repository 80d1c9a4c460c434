"""The little push at take-off begins and ends at nothing, and is there only while it is needed."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyarena.safety.nudge import Nudge
from crazyarena.safety.take_off import TakeOffCheck
from crazyarena.types import Pose, Telemetry, VehicleState

LEVEL = np.array([0.0, 0.0, 0.0, 1.0])


def test_it_goes_along_one_axis_and_then_along_the_other():
    nudge = Nudge(0.04)
    rows = np.array([nudge.shift(5.0 + 0.01 * k, True) for k in range(80)])
    assert rows[0] == pytest.approx([0.0, 0.0])
    assert np.abs(rows).max() == pytest.approx(0.04, rel=1e-3)
    assert not rows[:40, 1].any()
    assert not rows[41:, 0].any()
    # No jumps: at most as fast as a sine of that size and period.
    assert np.abs(np.diff(rows, axis=0)).max() < 0.04 * math.tau / 0.4 * 0.0101


def test_one_that_is_no_longer_needed_comes_to_its_end():
    nudge = Nudge(0.04)
    rows = [nudge.shift(0.01 * k, k < 5) for k in range(100)]
    assert any(rows[20])
    assert not any(map(any, rows[41:]))


@given(st.lists(st.tuples(st.floats(0.0, 0.2), st.booleans()), max_size=100))
def test_it_is_never_more_than_its_size(steps):
    nudge, now = Nudge(0.04), 0.0
    for step, needed in steps:
        now += step
        assert max(map(abs, nudge.shift(now, needed))) <= 0.04


def test_none_is_none():
    nudge = Nudge(0.0)
    assert [nudge.shift(0.1 * k, True) for k in range(9)] == [(0.0, 0.0)] * 9


def told(time):
    return Telemetry(
        time, state=VehicleState(time, np.zeros(3), np.zeros(3), LEVEL, np.full(3, 1e-3))
    )


def test_it_lasts_from_the_motors_on_for_some_seconds_of_flight():
    check, moved = TakeOffCheck(0.04), []
    for k in range(800):
        time, flies, above = 0.01 * k, k >= 100, 0.0 if k < 200 else 0.5
        pose = Pose(np.array([0.0, 0.0, above]), LEVEL)
        if flies:
            check.flies(time, pose, above, told(time))
        else:
            check.stands()
        shifted = check.nudged(pose, time).position
        assert shifted[2] == above
        if shifted[:2].any():
            moved.append(time)
    # Nothing is found out of a vehicle that does not move; then it is left alone.
    assert moved[0] == pytest.approx(1.01, abs=0.02)
    assert 4.4 < moved[-1] < 5.0


def test_a_vehicle_that_was_taken_is_not_nudged():
    check = TakeOffCheck(0.04)
    pose = Pose(np.zeros(3), LEVEL)
    check.flies(1.0, pose, 0.0, told(1.0))
    assert check.nudged(pose, 1.1, allowed=False) is pose
