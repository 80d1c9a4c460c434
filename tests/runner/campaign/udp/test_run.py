"""The fault campaign over the virtual radio: what became of a flight, and flights."""

from __future__ import annotations

import json
from dataclasses import asdict

import pytest
from typer.testing import CliRunner

from crazyarena.errors import InputError
from crazyarena.runner.campaign.faults import FAULTS
from crazyarena.runner.campaign.outcome import failures
from crazyarena.runner.campaign.udp import field, run, station
from crazyarena.runner.cli import make_app
from crazyarena.safety.events import Action, SafetyEvent


def test_every_fault_has_its_place():
    struck = field.STRIKES | station.STRIKES | {run.KILLED}
    assert struck == set(run.UDP_FAULTS)
    assert set(FAULTS) - struck == {"identity_swap", "tilt"}
    both = field.STRIKES & station.STRIKES
    assert both == {"radio_cut_at_wall"}


@pytest.mark.parametrize(
    ("safe_after", "locked", "end"),
    [(None, False, "flying"), (1.0, True, "cut"), (1.0, False, "landed")],
)
def test_outcome(safe_after, locked, end):
    report = {"excursion": 0.05, "safe_after": safe_after, "locked": locked, "speed": 1.0}
    outcome = run.outcome_of("wall", 3, 2.5, report, [])
    assert (outcome.end, outcome.rule, outcome.action) == (end, "", 0)
    assert outcome.safe == (end != "flying")
    assert failures([outcome], 1.0) == ([] if outcome.safe else [outcome])


def test_events_survive_the_way_between_processes():
    event = SafetyEvent("fence", Action.WARN, 0.1, 0.0, Action.HOLD, 2.0, 1, "east")
    cut = SafetyEvent("fence", Action.CUT, 0.6, 0.5, Action.CUT, 2.5, 1)
    told = json.loads(json.dumps([asdict(event), asdict(cut)]))
    report = {"excursion": 0.6, "safe_after": 2.0, "locked": False, "speed": 1.0}
    outcome = run.outcome_of("wall", 0, 1.0, report, told)
    assert outcome.events == [event, cut]
    assert (outcome.rule, outcome.action, outcome.end) == ("fence", Action.CUT, "cut")


def test_a_fault_that_is_not_flown_over_udp_is_refused(tmp_path):
    with pytest.raises(InputError, match="identity_swap"):
        run.run_campaign(["identity_swap"], 1)
    arguments = ["fault-campaign", "--udp", "--fault", "tilt", "--out", str(tmp_path)]
    result = CliRunner().invoke(make_app(), arguments)
    assert result.exit_code == 2
    assert "radio_cut" in result.output


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.timeout(600)  # the first flight compiles
@pytest.mark.parametrize(
    ("fault", "end"),
    [("nan", "landed"), ("radio_cut", "cut"), ("killed_process", "cut"), ("wall", "landed")],
)
def test_flights_end_safely(fault, end):
    outcomes = run.run_campaign([fault], 1)
    assert failures(outcomes, 0.5) == []
    (outcome,) = outcomes
    assert outcome.end == end
    assert 0.0 < outcome.safe_after < 14.0
    if fault == "killed_process":
        assert 0.8 < outcome.safe_after < 1.3
        assert not outcome.rule, "nobody was left to take over"
    else:
        assert outcome.rule
        assert outcome.events
