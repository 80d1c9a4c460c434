"""The fault campaign: single flights of it, and all of it in the slow suite."""

from __future__ import annotations

import math

import pytest

from crazyarena.errors import InputError
from crazyarena.runner.campaign.faults import FAULTS
from crazyarena.runner.campaign.outcome import failures
from crazyarena.runner.campaign.run import fly, run_campaign


@pytest.mark.parametrize(
    ("fault", "rules"),
    [
        ("wall", {"fence_predicted", "fence"}),
        ("silent", {"controller_silent"}),
        ("mocap_freeze", {"pose_stale"}),
        ("identity_swap", {"body_swap"}),
    ],
)
def test_faults_are_met_by_their_rule(fault, rules):
    outcome = fly(fault, 1)
    assert outcome.rule in rules
    assert outcome.end == "landed"
    # At a wall it stops at the soft fence's edge; the pull on it may carry it a little further.
    assert outcome.excursion < (0.05 if fault == "wall" else 0.0)
    assert outcome.safe_after < 12.0


def test_killed_ground_station_is_stopped_by_the_vehicle():
    outcome = fly("killed_process", 0)
    assert outcome.end == "cut"
    assert 0.8 < outcome.safe_after < 1.2


def test_same_seed_same_flight():
    first, second = fly("radio_loss", 2), fly("radio_loss", 2)
    assert repr(first) == repr(second)
    assert repr(first) != repr(fly("radio_loss", 3))


def test_unknown_fault_is_refused():
    with pytest.raises(InputError, match="wall"):
        run_campaign(["meteor"], 1)


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS)
def test_every_fault_ends_safely(fault):
    outcomes = run_campaign([fault], 6)
    assert failures(outcomes, 2.0) == []
    assert all(math.isfinite(outcome.safe_after) for outcome in outcomes)
