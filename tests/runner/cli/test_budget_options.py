"""Limits of wall time, as they are given on the command line."""

import pytest
from typer.testing import CliRunner

from crazyarena.errors import InputError
from crazyarena.levels import load_level
from crazyarena.runner.cli import make_app
from crazyarena.runner.contestant.compute import Budget
from crazyarena.runner.trial.options import FlightOptions
from tests.runner.fakes import controller


def test_limits_reach_the_deadlines():
    budget = Budget(1.0, 2.0, 3.0)
    for level in ("level0", "sim2real"):
        deadlines = FlightOptions(budget=budget).deadlines(load_level(level))
        assert deadlines.compute.budget == budget
    assert FlightOptions().deadlines(load_level("level0")).compute.budget == Budget(30, 600, 3600)


@pytest.mark.parametrize(
    ("budget", "told"),
    [
        (Budget(step=0.0), "step-limit"),
        (Budget(trial=float("nan")), "trial-limit"),
        (Budget(episode=float("inf")), "episode-limit"),
    ],
)
def test_limits_that_cannot_be_are_told(budget, told):
    with pytest.raises(InputError, match=told):
        FlightOptions(budget=budget).check()


def test_a_slow_step_ends_a_dry_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    entry = tmp_path / "entry\x1b[2J.py"
    entry.write_text(controller("import time as t; t.sleep(1.0); return Command.NONE, []"))
    options = ["--step-limit", "0.2", "--no-figure", "--no-sandbox"]
    result = CliRunner().invoke(make_app(), ["dry-run", str(entry), "--level", "level0", *options])
    assert result.exit_code == 1
    assert "0.2 s" in " ".join(result.output.split())
    # Nor does the name of a submission do anything in a terminal that lists its results.
    (folder,) = (tmp_path / "runs").iterdir()
    assert folder.name.endswith("-entry_2J-level0")
    assert "\x1b" not in result.output


def test_limits_that_cannot_be_are_bad_input(tmp_path):
    entry = tmp_path / "entry.py"
    entry.write_text(controller("return Command.NONE, []"))
    result = CliRunner().invoke(
        make_app(), ["dry-run", str(entry), "--level", "level0", "--trial-limit", "-1"]
    )
    assert result.exit_code == 2
    assert "--trial-limit" in result.output
