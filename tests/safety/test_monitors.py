"""Every rule is broken once, and not broken by what lies just within its limit."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

from crazyarena.safety.events import Action
from crazyarena.safety.heading import Turned
from crazyarena.safety.limits import Limits
from crazyarena.safety.monitors import RULES
from crazyarena.safety.stopping import stopping_path
from tests.safety.scenes import flying, lasting, new_guard, run, tilted

N = Limits()
HOLD, LAND, CUT, WARN = Action.HOLD, Action.LAND, Action.CUT, Action.WARN

# rule, action, what breaks it, what does not, how long it must last (s).
CASES: list[tuple[str, Action, dict[str, Any], dict[str, Any], float]] = [
    ("fence", HOLD, {"position": (3.01, 0, 1)}, {"position": (2.99, 0, 1)}, 0.0),
    ("fence", CUT, {"position": (3.51, 0, 1)}, {"position": (3.49, 0, 1)}, 0.0),
    ("fence", HOLD, {"position": (0, 0, 2.01)}, {"position": (0, 0, 1.99)}, 0.0),
    (
        "fence_predicted",
        HOLD,
        {"position": (2.45, 0, 1), "velocity": (2.0, 0, 0)},
        {"position": (2.4, 0, 1), "velocity": (1.8, 0, 0)},
        0.0,
    ),
    (
        "fence_predicted",
        HOLD,
        {"position": (0, 0, 1.5), "velocity": (0, 0, 1.9)},
        {"position": (0, 0, 1.5), "velocity": (0, 0, 1.2)},
        0.0,
    ),
    ("keep_out", HOLD, {"position": (1.15, 1.0, 0.5)}, {"position": (1.21, 1.0, 0.5)}, 0.0),
    (
        "keep_out_predicted",
        HOLD,
        {"position": (0.2, 1.0, 0.5), "velocity": (2.0, 0, 0)},
        {"position": (0.2, 1.0, 0.5), "velocity": (1.8, 0, 0)},
        0.0,
    ),
    ("people_zone", CUT, {"position": (-1.85, 2.5, 1.0)}, {"position": (-1.75, 2.5, 1.0)}, 0.0),
    (
        "speed",
        HOLD,
        {"position": (-2, -2, 1), "velocity": (2.6, 2.6, 0)},
        {"position": (-2, -2, 1), "velocity": (2.4, 2.4, 0)},
        N.speed_time,
    ),
    ("tilt", HOLD, {"quaternion": tilted(1.25)}, {"quaternion": tilted(1.15)}, N.tilt_time),
    ("tumble", CUT, {"quaternion": tilted(1.8)}, {"quaternion": tilted(1.7)}, N.tumble_time),
    ("pose_stale", WARN, {"pose_age": 0.09}, {"pose_age": 0.07}, 0.0),
    ("pose_stale", HOLD, {"pose_age": 0.16}, {"pose_age": 0.14}, 0.0),
    ("pose_stale", LAND, {"pose_age": 0.51}, {"pose_age": 0.49}, 0.0),
    ("pose_stale", CUT, {"pose_age": 3.6}, {"pose_age": 3.4}, 0.0),
    ("pose_jump", WARN, {"doubted": 0.01}, {}, 0.0),
    ("pose_jump", HOLD, {"doubted": 0.11}, {"doubted": 0.09}, 0.0),
    ("body_swap", HOLD, {"swapped": True}, {}, 0.0),
    (
        "wrong_body",
        LAND,
        {"onboard": (0.0, 0.45, 1.0)},
        {"onboard": (0.0, 0.35, 1.0)},
        N.disagreement_time,
    ),
    ("link_lost", WARN, {"link_age": 0.31}, {"link_age": 0.29}, 0.0),
    ("link_lost", HOLD, {"link_age": 0.51}, {"link_age": 0.49}, 0.0),
    ("link_lost", CUT, {"link_age": 1.01}, {"link_age": 0.99}, 0.0),
    ("link_quality", WARN, {"link_quality": 0.69}, {"link_quality": 0.71}, N.quality_time),
    ("link_quality", LAND, {"link_quality": 0.29}, {"link_quality": 0.31}, N.quality_time),
    ("battery", WARN, {"battery": 3.19}, {"battery": 3.21}, N.battery_time),
    ("battery", LAND, {"battery": 2.99}, {"battery": 3.01}, N.battery_time),
    ("supervisor", CUT, {"supervisor": 1 << 3 | 1 << 5}, {}, 0.0),
    ("supervisor", CUT, {"supervisor": 1 << 3 | 1 << 6}, {}, 0.0),
    ("supervisor", CUT, {"supervisor": 1 << 3 | 1 << 7}, {}, 0.0),
    ("may_not_fly", CUT, {"supervisor": 1 << 1}, {}, 0.2),
    ("following", HOLD, {"setpoint": (0.51, 0, 1)}, {"setpoint": (0.49, 0, 1)}, N.following_time),
    ("following", LAND, {"setpoint": (1.01, 0, 1)}, {"setpoint": (0.99, 0, 1)}, N.following_time),
    ("controller_silent", WARN, {"controller_age": 0.16}, {"controller_age": 0.14}, 0.0),
    ("controller_silent", HOLD, {"controller_age": 0.41}, {"controller_age": 0.39}, 0.0),
    ("scheduler_late", WARN, {"lateness": 0.04}, {"lateness": 0.02}, 0.0),
    ("scheduler_late", HOLD, {"lateness": 0.26}, {"lateness": 0.24}, 0.0),
    ("camera_rate", WARN, {"camera_rate": 29.0}, {"camera_rate": 31.0}, N.camera_rate_time),
    ("body_turned_far", CUT, {"turned": Turned(0.7, 0.1)}, {"turned": Turned(3.0, 0.3)}, 0.0),
    ("body_turned", WARN, {"turned": Turned(0.35, 0.03)}, {"turned": Turned(0.24, 0.01)}, 0.3),
    ("body_turned", WARN, {"turned": Turned(-0.35, 0.03)}, {"turned": Turned(-0.35, 0.06)}, 0.3),
    ("body_turned_far", CUT, {"turned": Turned(0.7, 0.1)}, {"turned": Turned(0.7, 0.14)}, 0.0),
    ("body_turned_far", CUT, {"turned": Turned(-3.1, 0.15)}, {"turned": Turned(0.5, 0.01)}, 0.0),
    ("yaw_apart", WARN, {"turned": Turned(yaw=0.3)}, {"turned": Turned(yaw=0.2)}, 0.0),
    ("yaw_apart", CUT, {"turned": Turned(yaw=-0.6)}, {"turned": Turned(yaw=-0.4)}, 0.0),
    ("neighbour", WARN, {"neighbour": 0.29}, {"neighbour": 0.31}, 0.0),
    ("neighbour", HOLD, {"neighbour": 0.19}, {"neighbour": 0.21}, 0.0),
    (
        "neighbour_predicted",
        HOLD,
        {"neighbour_predicted": 0.19},
        {"neighbour_predicted": 0.21},
        0.0,
    ),
    ("clock_jump", LAND, {"clock_error": -0.06}, {"clock_error": -0.04}, 0.0),
    ("person_near", CUT, {"person_distance": 0.9}, {"person_distance": 1.1}, 0.0),
    ("person_inside", LAND, {"person_depth": 0.1}, {"person_depth": -0.1}, 0.0),
    ("strangers", WARN, {"strangers": 1}, {"strangers": 0}, 0.0),
    ("dead_man", LAND, {"dead_man_age": 0.6}, {"dead_man_age": 0.4}, 0.0),
]


def test_one_that_does_not_know_where_it_is_is_cut_before_it_drifts_out():
    there: dict[str, Any] = {"position": (2.6, 0.0, 1.0), "velocity": (1.3, 0.0, 0.0)}
    lost: dict[str, Any] = {**there, "onboard": (0.0, 0.0, 1.0)}
    cut = [e for e in run(new_guard(), lasting(0.4, **lost)) if e.rule == "adrift"]
    assert [e.action for e in cut] == [CUT]
    assert cut[0].time == pytest.approx(N.disagreement_time + 0.05, abs=0.02)
    for harmless in (
        {**there, "onboard": (2.6, 0.1, 1.0)},
        {**lost, "velocity": (-1.3, 0.0, 0.0)},
        {**lost, "position": (1.0, 0.0, 1.0)},
    ):
        assert "adrift" not in {e.rule for e in run(new_guard(), lasting(0.4, **harmless))}


@pytest.mark.parametrize(("rule", "action", "bad", "good", "time"), CASES)
def test_rule_is_broken_beyond_its_limit_and_for_long_enough(rule, action, bad, good, time):
    events = run(new_guard(), lasting(time + 0.02, **bad))
    found = [e for e in events if e.rule == rule and e.severity == action]
    assert found
    assert found[0].time >= time - 1e-9
    assert found[0].action >= action
    if time > 0:
        early = run(new_guard(), lasting(time - 0.02, **bad))
        assert not [e for e in early if e.rule == rule and e.severity == action]
    assert not [
        e
        for e in run(new_guard(), lasting(time + 0.1, **good))
        if e.rule == rule and e.severity == action
    ]


def test_every_rule_has_a_case():
    after_the_takeover = {"lost_control", "adrift"}
    covered = {case[0] for case in CASES} | after_the_takeover
    assert covered == {rule.name for rule in RULES}
    for rule in RULES:
        if rule.name not in after_the_takeover:
            stages = {stage.action for stage in rule.stages}
            assert stages == {case[1] for case in CASES if case[0] == rule.name}


def test_lost_control_cuts_when_the_pilot_is_not_obeyed():
    guard = new_guard()
    events = run(guard, lasting(1.5, swapped=True, position=(0.0, 0.0, 1.0)))
    assert all(e.rule != "lost_control" for e in events)
    away = [
        replace(obs, position=(2.0, 0.0, 1.0), onboard=(2.0, 0.0, 1.0), time=obs.time + 1.6)
        for obs in lasting(1.0)
    ]
    events = run(guard, away)
    assert [e for e in events if e.rule == "lost_control" and e.action is Action.CUT]


def test_hovering_breaks_nothing():
    assert run(new_guard(), lasting(3.0)) == []


def test_nothing_is_watched_before_the_trial_and_on_the_ground():
    broken = {
        "position": (5.0, 0.0, 0.05),
        "velocity": (9.0, 0.0, 0.0),
        "quaternion": tilted(3.0),
        "pose_age": 9.0,
    }
    assert run(new_guard(), lasting(1.0, active=False, airborne=False, **broken)) == []
    grounded = run(new_guard(), lasting(0.3, airborne=False, position=(3.05, 0.0, 0.03)))
    assert grounded == []


def test_what_is_unknown_breaks_nothing():
    unknown = dict.fromkeys(
        (
            "position", "onboard", "link_age", "link_quality", "battery", "supervisor", "setpoint",
            "controller_age", "lateness", "clock_error", "dead_man_age", "person_distance",
            "person_depth",
        )
    )  # fmt: skip
    assert run(new_guard(), lasting(2.0, **unknown)) == []


@pytest.mark.parametrize(
    ("field", "value", "rule"),
    [
        ("position", (math.nan, 0.0, 1.0), "fence"),
        ("velocity", (math.nan, 0.0, 0.0), "fence_predicted"),
        ("quaternion", (math.nan, 0.0, 0.0, 1.0), "tumble"),
        ("battery", math.nan, "battery"),
        ("pose_age", math.nan, "pose_stale"),
    ],
)
def test_a_number_that_is_none_breaks_the_rule(field, value, rule):
    events = run(new_guard(), lasting(2.0, **{field: value}))
    assert rule in {e.rule for e in events}


def test_a_single_bad_measurement_needs_its_persistence():
    guard = new_guard()
    frames = []
    for k in range(200):
        frames.append(flying(0.01 * k, battery=2.5 if k % 50 else 3.8))
    assert all(e.rule != "battery" for e in run(guard, frames))


def test_one_who_brakes_is_not_taken_for_one_who_runs_away():
    # 1.5 m/s towards a wall 0.3 m away: too fast, unless the attitude says it is braking.
    fast = {"position": (2.7, 0.0, 1.0), "velocity": (1.5, 0.0, 0.0)}
    assert "fence_predicted" in {e.rule for e in run(new_guard(), lasting(0.02, **fast))}
    backwards = (0.0, -math.sin(0.25), 0.0, math.cos(0.25))  # 0.5 rad nose up: 5.4 m/s2
    assert run(new_guard(), lasting(0.02, quaternion=backwards, **fast)) == []


def test_stopping_path_is_that_of_uniform_braking():
    limits = Limits(braking=5.0, reaction=0.2)
    begin, end = stopping_path(flying(velocity=(2.0, 0.0, 0.0)), limits)
    assert begin[0] == pytest.approx(0.4)
    assert end[0] == pytest.approx(0.4 + 4.0 / 10.0)
    assert end[1:] == begin[1:] == (0.0, 1.0)
