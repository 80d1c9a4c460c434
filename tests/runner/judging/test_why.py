"""Why an episode ended, in words that name the thing, the place and the time."""

import numpy as np
import pytest

from crazyarena.levels import load_level
from crazyarena.runner.judging import referee
from crazyarena.runner.judging.referee import Event
from crazyarena.runner.judging.why import explain
from crazyarena.sim_backend.trace import TR_VEL
from tests.runner.fakes import rows

LEVEL = load_level("level0")
GATES = np.array([gate.row for gate in LEVEL.track.gates])


def told(reason, events=(), places=((0.0, 0.0, 1.0),), velocity=(0.0, 1.0, 0.0), **facts):
    trace = rows(places)
    trace[:, TR_VEL : TR_VEL + 3] = velocity
    known = {"highest": 1.0, "passed": 0, "first_command": "TAKEOFF", "error": None, **facts}
    gates = known.pop("gates", GATES)
    return explain(reason, events, trace, gates, LEVEL, **known)


@pytest.mark.parametrize(
    ("offset", "velocity", "part", "where"),
    [
        ((0.24, 0.0, 0.0), (0, 1, 0), "right bar", "0.24 m right"),
        ((0.24, 0.0, 0.0), (0, -1, 0), "left bar", "0.24 m left"),
        ((-0.24, 0.0, 0.1), (0, 1, 0), "left bar", "0.24 m left"),
        ((0.05, 0.0, 0.23), (0, 1, 0), "top bar", "0.23 m above"),
        ((0.05, 0.0, -0.23), (0, 1, 0), "bottom bar", "0.23 m below"),
        ((0.0, 0.0, -0.5), (0, 1, 0), "post", "0.50 m below"),
    ],
)
def test_a_gate_is_hit_somewhere(offset, velocity, part, where):
    gate = np.array([[1.0, 2.0, 0.0, 0.0, 0.0, 0.0, 0.0]])
    place = np.array([1.0, 2.0, 1.0]) + offset
    text = told(
        referee.COLLISION,
        [Event("contact", 2550, 5.1, "gate 0")],
        [place],
        velocity,
        gates=gate,
    )
    assert text == f"COLLISION with gate 0 ({part}) at 5.10 s, {where} of its centre"


def test_sides_turn_with_the_gate():
    gate = np.array([[0.0, 0.0, 0.0, 0.0, 0.0, np.pi / 2, 1.0]])
    # Flown along -x; its right is +y.
    text = told(
        referee.COLLISION,
        [Event("contact", 500, 1.0, "gate 0")],
        [(0.0, 0.24, 0.525)],
        (-1, 0, 0),
        gates=gate,
    )
    assert "(right bar)" in text


@pytest.mark.parametrize(
    ("detail", "found"),
    [
        ("obstacle 1", "COLLISION with obstacle 1 at 5.10 s"),
        ("ground", "COLLISION with the ground at 5.10 s"),
    ],
)
def test_other_things_are_hit(detail, found):
    assert told(referee.COLLISION, [Event("contact", 2550, 5.1, detail)]) == found


def test_a_violation_names_the_limit():
    high = LEVEL.arena.high[1]
    event = Event("constraint violated", 500, 1.0, "y above the arena")
    text = told(referee.CONSTRAINT_VIOLATION, [event])
    assert text == f"CONSTRAINT VIOLATION: y above {high:g} m at 1.00 s"
    event = Event("constraint violated", 500, 1.0, "rotor 2 force above the maximum")
    assert "rotor 2 force" in told(referee.CONSTRAINT_VIOLATION, [event])


def test_time_runs_out_in_different_ways():
    end = referee.MAX_EPISODE_DURATION
    text = told(end, highest=0.03, first_command="NONE")
    assert text == "MAX EPISODE DURATION: never took off, the first command was NONE"
    x, y, *_ = GATES[2]
    place = (x, y, 0.525 + 0.5)
    assert told(end, places=[place], passed=2).endswith("0.50 m from gate 2")
    goal = LEVEL.goal.position
    near = (goal[0], goal[1], goal[2] + 0.5)
    assert told(end, places=[near], passed=4).endswith("0.50 m from the goal")
    assert "at the goal, but not for 2 s" in told(end, places=[goal], passed=4)


def test_errors_are_told_by_their_last_line():
    text = told("CONTROLLER ERROR", error="Traceback\n  File x\nValueError: lost")
    assert text == "CONTROLLER ERROR: ValueError: lost"
    assert told("FINISHED") == "FINISHED"


def test_nothing_is_known_of_an_empty_step():
    trace = np.empty((0, 33))
    known = {"highest": 1.0, "passed": 0, "first_command": None, "error": None}
    event = Event("contact", 1, 0.1, "gate 0")
    text = explain(referee.COLLISION, [event], trace, GATES, LEVEL, **known)
    assert text == "COLLISION with gate 0 at 0.10 s"


def test_a_vehicle_that_never_left_the_ground_says_so():
    event = Event("contact", 35, 0.07, "ground")
    text = told(referee.COLLISION, [event], highest=0.03, first_command="NONE")
    assert text == (
        "COLLISION with the ground at 0.07 s: never took off, the first command was NONE"
    )
