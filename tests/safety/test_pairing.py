"""Poses and body rates of the same moment are brought together, however they arrive."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyarena.safety.pairing import _LAG, Pairing
from crazyarena.types import Telemetry, VehicleState

LEVEL = (0.0, 0.0, 0.0, 1.0)


def told(time, omega, rates_at=None):
    # Rates are a little older than they say.
    time = time + _LAG
    rates_at = None if rates_at is None else rates_at + _LAG
    state = VehicleState(
        time, np.zeros(3), np.zeros(3), np.array(LEVEL), np.asarray(omega, dtype=float)
    )
    return Telemetry(time, state=state, rates_at=rates_at)


def test_a_pose_waits_for_the_rates_after_it():
    pairing = Pairing()
    assert list(pairing.told(told(1.00, (1.0, 0.0, 0.0)))) == []
    pairing.pose(1.02, (1.0, 2.0, 3.0), LEVEL)
    assert list(pairing.told(told(1.00, (1.0, 0.0, 0.0)))) == []
    ((time, position, _, gyro),) = pairing.told(told(1.05, (2.0, 0.0, 0.5)))
    assert (time, position) == (1.02, (1.0, 2.0, 3.0))
    assert gyro == pytest.approx((1.4, 0.0, 0.2))
    assert list(pairing.told(told(1.05, (2.0, 0.0, 0.5)))) == []


def test_a_burst_of_late_poses_gets_the_rates_of_its_own_time():
    pairing = Pairing()
    list(pairing.told(told(1.00, (1.0, 0.0, 0.0))))
    for k in range(6):
        pairing.pose(1.0 + 0.01 * k, (float(k), 0.0, 1.0), LEVEL)
    found = list(pairing.told(told(1.05, (2.0, 0.0, 0.0))))
    assert [gyro[0] for *_, gyro in found] == pytest.approx([1.0, 1.2, 1.4, 1.6, 1.8, 2.0])


def test_what_is_not_known_is_not_compared():
    pairing = Pairing()
    list(pairing.told(told(1.0, (1.0, 0.0, 0.0))))
    pairing.pose(0.9, (0.0, 0.0, 1.0), LEVEL)  # before the first rates
    pairing.pose(1.2, (0.0, 0.0, 1.0), LEVEL)  # in a gap
    assert list(pairing.told(told(1.4, (1.0, 0.0, 0.0)))) == []
    pairing.pose(1.42, (0.0, 0.0, 1.0), LEVEL)
    assert list(pairing.told(told(1.45, (0.0, 0.0, 0.0)))) == []  # it does not tell
    assert list(pairing.told(Telemetry(2.0))) == []


def test_rates_have_a_time_of_their_own():
    pairing = Pairing()
    list(pairing.told(told(1.0, (1.0, 0.0, 0.0), rates_at=1.0)))
    pairing.pose(1.03, (0.0, 0.0, 1.0), LEVEL)
    # A newer state with the rates of before.
    assert list(pairing.told(told(1.05, (1.0, 0.0, 0.0), rates_at=1.0))) == []
    assert len(list(pairing.told(told(1.06, (3.0, 0.0, 0.0), rates_at=1.06)))) == 1


@given(
    st.lists(st.floats(0.0, 5.0), max_size=300),
    st.lists(st.floats(0.0, 5.0), min_size=1, max_size=60),
)
def test_nothing_comes_twice_and_memory_is_bounded(poses, rates):
    pairing = Pairing()
    given_poses, found = sorted(poses), []
    for index, time in enumerate(sorted(rates)):
        while given_poses and given_poses[0] <= time + 0.3:
            at = given_poses.pop(0)
            pairing.pose(at, (at, 0.0, 1.0), LEVEL)
        found += [sample[0] for sample in pairing.told(told(time, (1.0 + index, 0.0, 0.0)))]
    assert found == sorted(found)
    assert all(found.count(time) <= poses.count(time) for time in found)
    assert len(pairing._poses) <= 128
