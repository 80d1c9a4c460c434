"""The fault campaign: single flights of it, and all of it in the slow suite."""

from __future__ import annotations

import json
import math

import pytest

from crazyarena.errors import InputError
from crazyarena.runner import campaign_report
from crazyarena.runner.campaign import FAULTS, failures, fly, run_campaign, summarise


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


def test_table_figure_and_file(tmp_path):
    outcomes = run_campaign(["nan"], 2)
    (row,) = summarise(outcomes)
    assert (row["fault"], row["flights"], row["safe"]) == ("nan", 2, 2)
    campaign_report.write_json(tmp_path / "c.json", outcomes)
    document = json.loads((tmp_path / "c.json").read_text())
    assert len(document["flights"]) == 2
    assert document["flights"][0]["events"][0]["rule"]
    campaign_report.save_figure(tmp_path / "c.png", outcomes)
    assert (tmp_path / "c.png").stat().st_size > 1000
    assert campaign_report.table(outcomes).row_count == 1
    assert failures(outcomes, 1.0) == []
    bad = outcomes[0]
    bad.excursion = 0.2
    assert failures(outcomes, 1.0) == [bad]
    bad.excursion, bad.end = -0.2, "flying"
    assert failures(outcomes, 1.0) == [bad]


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS)
def test_every_fault_ends_safely(fault):
    outcomes = run_campaign([fault], 6)
    assert failures(outcomes, 2.0) == []
    assert all(math.isfinite(outcome.safe_after) for outcome in outcomes)
