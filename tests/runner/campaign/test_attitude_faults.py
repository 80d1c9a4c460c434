"""Contestants of the fault campaign that fly by attitude."""

from __future__ import annotations

import math

import pytest

from crazyarena.runner.campaign.faults import ALL_FAULTS, ATTITUDE_FAULTS, FAULTS
from crazyarena.runner.campaign.outcome import failures
from crazyarena.runner.campaign.run import fly, run_campaign


def test_they_are_faults_of_their_own():
    assert not set(FAULTS) & set(ATTITUDE_FAULTS)
    assert set(ALL_FAULTS) == {*FAULTS, *ATTITUDE_FAULTS}
    assert all(fault.attitude and fault.limits.allow_attitude for fault in ATTITUDE_FAULTS.values())


@pytest.mark.parametrize(
    ("fault", "rules"),
    [
        ("attitude_tilted", {"fence_predicted"}),
        ("attitude_up", {"fence_predicted"}),
        ("attitude_silent", {"controller_silent"}),
        ("attitude_mocap_freeze", {"pose_stale"}),
    ],
)
def test_the_watchdog_takes_a_vehicle_that_leans(fault, rules):
    outcome = fly(fault, 1)
    assert outcome.rule in rules
    assert outcome.end == "landed"
    assert outcome.excursion < 0.0


def test_the_pilot_itself_needs_nobody():
    # A link that loses a little does not keep it from its circuit, nor from landing.
    outcome = fly("attitude_radio_loss", 1)
    assert (outcome.rule, outcome.end) == ("", "landed")


@pytest.mark.slow
@pytest.mark.parametrize("fault", ATTITUDE_FAULTS)
def test_every_fault_ends_safely(fault):
    outcomes = run_campaign([fault], 6)
    assert failures(outcomes, 2.0) == []
    assert all(math.isfinite(outcome.safe_after) for outcome in outcomes)


@pytest.mark.slow
def test_hostile_attitudes_stay_inside():
    outcomes = run_campaign(["attitude_hostile"], 40)
    assert failures(outcomes, 0.0) == []


def test_skimming_along_the_floor_is_flying():
    # 5 cm high at more than 4 m/s: nothing but its speed says that it flies.
    outcome = fly("attitude_hostile", 59)
    assert outcome.rule == "fence_predicted"
    assert outcome.excursion < 0.0
