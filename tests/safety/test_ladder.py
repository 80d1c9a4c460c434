"""The ladder only climbs, tells once, and always comes to an end."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crazyarena.errors import InputError
from crazyarena.safety.events import Action
from crazyarena.safety.ladder import Ladder
from crazyarena.safety.limits import Limits
from crazyarena.safety.monitors import Finding

N = Limits()


def finding(action: Action, rule: str = "rule") -> Finding:
    return Finding(rule, action, 2.0, 1.0)


def test_actions_are_ordered():
    assert Action.NONE < Action.WARN < Action.HOLD < Action.LAND < Action.CUT
    assert [a.takes_over for a in Action] == [False, False, True, True, True]


def test_transition_carries_rule_measurement_limit_and_time():
    ladder = Ladder(N, vehicle=7)
    (event,) = ladder.update(1.5, [finding(Action.HOLD, "fence")])
    assert (event.rule, event.severity, event.action) == ("fence", Action.HOLD, Action.HOLD)
    assert (event.measured, event.limit, event.time, event.vehicle) == (2.0, 1.0, 1.5, 7)


@settings(max_examples=200, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.floats(0.0, 1.0),
            st.lists(st.tuples(st.sampled_from("abc"), st.sampled_from(list(Action)[1:]))),
            st.booleans(),
        ),
        max_size=60,
    )
)
def test_never_falls_never_repeats_itself(steps):
    ladder = Ladder(N)
    time, last, told = 0.0, Action.NONE, set()
    for gap, findings, landed in steps:
        time += gap
        before = ladder.action
        events = ladder.update(time, [finding(a, r) for r, a in findings], landed)
        assert ladder.action >= last
        last = ladder.action
        for event in events:
            if event.severity.takes_over:
                assert (event.rule, event.severity) not in told
                told.add((event.rule, event.severity))
            assert before <= event.action <= ladder.action


def test_equal_inputs_equal_events():
    def play() -> list[object]:
        ladder = Ladder(N)
        events: list[object] = []
        for k in range(400):
            worst = finding(Action.HOLD if k > 50 else Action.WARN)
            events += ladder.update(0.01 * k, [worst])
        return [repr(event) for event in events]

    assert play() == play()


def test_hold_becomes_landing_becomes_cut_in_bounded_time():
    ladder = Ladder(N)
    ladder.update(0.0, [finding(Action.HOLD)])
    ladder.update(N.hold_time - 0.01, [])
    assert ladder.action is Action.HOLD
    (event,) = ladder.update(N.hold_time + 0.01, [])
    assert (event.rule, ladder.action) == ("hold_over", Action.LAND)
    ladder.update(N.hold_time + N.land_time, [])
    assert ladder.action is Action.LAND
    (event,) = ladder.update(N.hold_time + N.land_time + 0.02, [])
    assert (event.rule, ladder.action) == ("landing_over", Action.CUT)
    assert ladder.over


def test_landed_ends_the_landing():
    ladder = Ladder(N)
    ladder.update(0.0, [finding(Action.LAND)])
    (event,) = ladder.update(1.0, [], landed=True)
    assert (event.rule, event.action) == ("landed", Action.LAND)
    assert ladder.update(100.0, [], landed=True) == []
    assert ladder.action is Action.LAND
    # Whoever asks for a cut afterwards still gets it.
    ladder.update(101.0, [finding(Action.CUT)], landed=True)
    assert ladder.action is Action.CUT


def test_a_warning_is_told_again_only_after_it_was_gone():
    ladder = Ladder(N)
    warn = [finding(Action.WARN)]
    told = [len(ladder.update(0.01 * k, warn)) for k in range(300)]
    assert sum(told) == 1
    assert ladder.update(3.5, warn) == []
    assert len(ladder.update(5.0, warn)) == 1


@pytest.mark.parametrize(
    "wrong",
    [
        {"braking": 0.0},
        {"braking": math.nan},
        {"reaction": -1.0},
        {"pose_warn": 0.3},
        {"battery_warn": 2.9},
        {"setpoint_speed": 4.0},
        {"link_hold": 0.1},
    ],
)
def test_contradictory_limits_are_refused_by_name(wrong):
    with pytest.raises(InputError, match=next(iter(wrong))):
        Limits(**wrong)
