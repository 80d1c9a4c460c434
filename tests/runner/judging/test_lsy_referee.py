"""The rules of lsy_drone_racing on what cameras see."""

from __future__ import annotations

import numpy as np
import pytest

from crazyarena.levels.lsy import load_lsy_level
from crazyarena.levels.lsy.arena import arena_level, poles_of
from crazyarena.runner.judging.lsy_referee import LsyTrialReferee
from crazyarena.runner.judging.lsy_rules import (
    COLLISION,
    GATES_PASSED,
    SAFETY_LIMITS,
    TUMBLED,
    lsy_why,
)
from crazyarena.sim_backend.trace import (
    TR_POS,
    TR_QUAT,
    TR_TIME,
    TR_TUMBLED,
    TRACE_SIZE,
    UNKNOWN_CONTACT,
)

LEVEL = load_lsy_level("lsy/level0")
GATES = np.array([[*g.pos, *g.rpy, 0.0] for g in LEVEL.env.track.gates])
POLES = poles_of(np.array([p.pos for p in LEVEL.env.track.obstacles]))
START = np.array([-1.5, 0.75, 0.03, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0], float)


def begun(gates=GATES):
    referee = LsyTrialReferee(LEVEL, arena_level(LEVEL, 0))
    referee.begin(gates, POLES)
    referee.told_before(GATES, POLES)
    referee.warm_up(np.zeros(12))
    obs = referee.first(START)
    return referee, obs


def rows(*places, time=0.0, tumbled=np.nan):
    found = np.full((len(places), TRACE_SIZE), np.nan)
    for i, place in enumerate(places):
        found[i, TR_TIME] = time + 0.01 * (i + 1)
        found[i, TR_POS : TR_POS + 3] = place
        found[i, TR_QUAT : TR_QUAT + 4] = 0.0, 0.0, 0.0, 1.0
        found[i, 21] = UNKNOWN_CONTACT
    found[-1, TR_TUMBLED] = tumbled
    return found


def through(gate, ahead):
    c, s = np.cos(gate[5]), np.sin(gate[5])
    return gate[:3] + ahead * np.array([c, s, 0.0])


def test_all_gates_and_then_one_step_more():
    referee, _ = begun()
    time = 0.0
    for gate in GATES:
        for ahead in (-0.3, -0.1, 0.1, 0.3):
            time += 0.02
            verdict = referee.judge(rows(through(gate, ahead), time=time))
    assert verdict.done
    assert verdict.completed
    assert referee.reason(verdict) == GATES_PASSED
    assert verdict.reward == -1.0
    assert referee.gates_passed == referee.gates == 4
    assert verdict.info["obs"]["target_gate"] == -1
    # A real drone stays where it is.
    np.testing.assert_allclose(verdict.obs["pos"], through(GATES[-1], 0.3), atol=1e-6)


def test_measured_gates_are_judged_and_told_once_seen():
    moved = GATES.copy()
    moved[0, :2] += [0.1, -0.1]
    referee, obs = begun(moved)
    np.testing.assert_allclose(obs["gates_pos"][0], GATES[0, :3], atol=1e-6)
    verdict = referee.judge(rows(moved[0, :3] + [-0.5, 0.0, 0.3]))
    assert verdict.obs["gates_visited"].tolist() == [True, False, False, False]
    np.testing.assert_allclose(verdict.obs["gates_pos"][0], moved[0, :3], atol=1e-6)
    assert verdict.info["current_target_gate_in_range"]


@pytest.mark.parametrize(
    ("place", "tumbled", "reason"),
    [
        ((0.0, 1.52, 1.0), 0.0, SAFETY_LIMITS),
        ((0.0, 0.0, 2.01), 0.0, SAFETY_LIMITS),
        ((1.0, 0.25, 1.0), 0.0, COLLISION),
        ((0.0, 0.0, 0.05), 1.0, TUMBLED),
        ((0.0, 0.0, -0.005), 0.0, None),
    ],
)
def test_what_ends_a_real_race(place, tumbled, reason):
    referee, _ = begun()
    verdict = referee.judge(rows(place, tumbled=tumbled))
    assert verdict.done == (reason is not None)
    if reason is not None:
        assert referee.reason(verdict) == reason
        assert verdict.collided == (reason == COLLISION)
        assert reason in lsy_why(reason, verdict.events, None, 0, 4, 1.0)


def test_without_a_pose_the_last_verdict_stands():
    referee, _ = begun()
    with pytest.raises(ValueError, match="at least one"):
        referee.judge(np.empty((0, TRACE_SIZE)))
    first = referee.judge(rows((0.0, 0.0, 1.0)))
    assert referee.judge(np.empty((0, TRACE_SIZE))) is first
    assert first.events == ()
