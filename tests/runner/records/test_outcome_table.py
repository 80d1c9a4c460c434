"""The table of a trial at any width, its score, and what is remarked on."""

import io

import pytest
from rich.console import Console

from crazyarena.levels import load_level
from crazyarena.runner.judging.result import EpisodeResult, TrialResult
from crazyarena.runner.records.outcome_table import computing, remarks, score_line, table

LEVEL = load_level("level0")
WHY = "COLLISION with gate 0 (left bar) at 5.10 s, 0.24 m left of its centre"


def episode(index=0, termination="TASK COMPLETION", completed=True, **facts):
    known = {
        "flight_time": 7.5,
        "gates_passed": 4,
        "gates": 4,
        "collisions": 0,
        "violations": 0,
        "reward": 0.0,
        "interstep_learning_time": 0.0,
        "interstep_learning_average": 0.0,
        "interepisode_learning_time": 0.5,
        "steps": 226,
        "gate_times": [],
        "compute_ms": {"p50": 0.0123, "max": 41.0},
        "over_period": 0,
        "late_ms": {},
        "skipped_steps": 0,
    }
    return EpisodeResult(index, termination, completed=completed, **{**known, **facts})


def printed(result, width):
    text = io.StringIO()
    Console(file=text, width=width).print(table(result))
    return text.getvalue()


@pytest.mark.parametrize("width", [50, 60, 80, 120])
def test_what_names_the_result_is_folded_and_never_cut(width):
    result = TrialResult([episode(), episode(1, "COLLISION", False, why=WHY, collisions=1)], 2)
    text = printed(result, width)
    assert all(len(line) <= width for line in text.splitlines())
    assert "…" not in text
    words = " ".join(text.split())
    for word in WHY.split():
        assert word in words
    assert "7.500" in text


def test_markup_of_others_is_shown_as_it_is():
    result = TrialResult([episode(why="CONTROLLER ERROR: [red]boo[/red]", completed=False)], 1)
    assert "[red]boo[/red]" in printed(result, 120)


def test_the_score_of_the_rules():
    result = TrialResult([episode(), episode(1)], 2)
    assert score_line(result).startswith("Score: A 7.500 s")
    assert "B 16.000 s" in score_line(result)
    assert "1 of 2 episodes" in score_line(TrialResult([episode()], 2))
    fallen = TrialResult([episode(completed=False, termination="COLLISION")], 1)
    assert "without collision" in score_line(fallen)


def test_slow_steps_are_told():
    slow = episode(steps=990, over_period=990, compute_ms={"p50": 600.0, "max": 700.0})
    (line,) = remarks(TrialResult([slow], 1), LEVEL, 7)
    assert line.startswith("Slow: 990 of 990 steps took longer than a tick (33 ms)")
    assert "out after 0.5 s" in line
    late = episode(steps=990, over_period=500, compute_ms={"p50": 40.0, "max": 50.0})
    assert "come late" in remarks(TrialResult([late], 1), LEVEL, 7)[0]
    missed = episode(steps=990, over_period=500, missed_ticks=480)
    assert "480 ticks passed" in remarks(TrialResult([missed], 1), LEVEL, 7)[0]
    assert remarks(TrialResult([episode(over_period=1)], 1), LEVEL, 7) == []


def test_the_same_draw_many_times_is_told():
    level = load_level("level1", ["reseed_on_reset=true"])
    (line,) = remarks(TrialResult([episode(), episode(1)], 2), level, 7)
    assert "seed 7" in line
    assert "--seed" in line
    other = load_level("level1", ["reseed_on_reset=false"])
    assert remarks(TrialResult([episode(), episode(1)], 2), other, 7) == []


def test_times_of_computing_are_plain_numbers():
    assert computing({"p50": 0.00047, "max": 4.14}) == "0.00047/4.1"
    assert computing({"p50": 99.4, "max": 99.6}) == "99/100"
    assert computing({"p50": 131.0, "max": 2345.6}) == "131/2346"
    assert computing({}) == "-"
