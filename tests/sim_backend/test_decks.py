"""Positioning decks in software: what the on-board filter makes of them."""

from __future__ import annotations

import numpy as np
import pytest

from crazyarena.crazyswarm_compat import commands as c
from crazyarena.crazyswarm_compat.positioning import positioning
from crazyarena.errors import BackendError, InputError
from crazyarena.sim_backend.arena import ArenaFleet
from crazyarena.sim_backend.decks import Flow, FlowModel, Lighthouse, LighthouseModel, make_deck
from crazyarena.sim_backend.firmware import kalman as ka
from crazyarena.sim_backend.trace import TR_TIME, TRACE_SIZE

ZERO = np.zeros(3)


def flown(deck, seconds=12.0):
    """Errors (n, 3) m of the estimate of a vehicle that flies a rectangle by itself."""
    fleet = ArenaFleet([(0.0, 0.0, 0.0)])
    fleet.decks.fit(0, deck)
    fleet.set_param(0, "stabilizer.controller", 2)
    fleet.set_param(0, "kalman.resetEstimation", 1)
    fleet.advance(200)
    fleet.set_param(0, "kalman.resetEstimation", 0)
    fleet.advance(500)
    fleet.send(c.Arm(True), 0)
    fleet.send(c.Takeoff(0.8, 2.0), 0)
    errors = []
    corners = [(1.0, 0.0), (1.0, 1.0), (0.0, 1.0), (0.0, 0.0)]
    for k in range(round(10 * seconds)):
        if k >= 25 and (k - 25) % 20 == 0:
            x, y = corners[(k - 25) // 20 % 4]
            fleet.send(c.GoTo((x, y, 0.8), 0.0, 2.0), 0)
        fleet.advance(100)
        told = fleet.telemetry(0).state
        errors.append(told.position - fleet.true_state(0).position)
    assert fleet.true_state(0).position[2] > 0.6
    return np.array(errors), fleet


def test_lighthouse_is_a_little_off_everywhere_and_does_not_drift():
    errors, fleet = flown(Lighthouse(np.random.default_rng(3)))
    distance = np.linalg.norm(errors[25:], axis=1)
    assert 0.002 < distance.mean() < 0.06
    assert distance.max() < 0.1
    half = len(distance) // 2
    assert distance[half:].mean() < 2.0 * distance[:half].mean() + 0.02
    assert fleet.telemetry(0).position_std < 0.05


def test_what_lighthouse_says_depends_on_the_place_alone():
    deck = Lighthouse(np.random.default_rng(0), LighthouseModel(noise=0.0, attitude_noise=0.0))
    fleet = ArenaFleet([(0.0, 0.0, 0.0), (2.0, 1.0, 0.0)])
    here, there = fleet.true_pose(0), fleet.true_pose(1)
    first, other, again = (deck.sense(pose, ZERO)[1] for pose in (here, there, here))
    np.testing.assert_array_equal(first, again)
    assert np.linalg.norm((first - other)[:3] - (here.position - there.position)) > 1e-3


def test_flow_drifts_but_keeps_its_height():
    errors, fleet = flown(Flow(np.random.default_rng(5), FlowModel(scale=0.05)))
    assert np.abs(errors[25:, 2]).max() < 0.03
    drift = np.linalg.norm(errors[:, :2], axis=1)
    assert drift[-30:].mean() > 0.01
    told = fleet.telemetry(0)
    # The filter knows that it knows nothing of the place; of the speed it does.
    assert told.position_std > 1.0
    assert told.velocity_std < 0.1


def test_flow_is_fused_as_velocity_and_height():
    m = ka.kalman_memory()
    p = np.zeros(16)
    ka.kalman_init(m, p, 0)
    row = np.array((0.4, -0.2, 0.7, 1e-3, 1e-3, 0.0, 0.0))
    ka.kalman_measure(m, ka.MEAS_FLOW, row, 0.01, 0.01)
    assert m[ka.KM_S + 3] == pytest.approx(0.4, rel=0.02)
    assert m[ka.KM_S + 4] == pytest.approx(-0.2, rel=0.02)
    assert m[ka.KM_S + 2] == pytest.approx(0.7, rel=0.02)
    assert m[ka.KM_S] == m[ka.KM_S + 1] == 0.0


def test_beyond_its_reach_the_laser_says_nothing():
    deck = Flow(np.random.default_rng(0))
    fleet = ArenaFleet([(0.0, 0.0, 5.0)])
    _, row = deck.sense(fleet.true_pose(0), ZERO)
    assert row[4] > 100.0


def test_parameters_say_what_is_fitted():
    fleet = ArenaFleet(np.zeros((3, 3)))
    fleet.decks.fit(0, make_deck("lighthouse", np.random.default_rng(0)))
    fleet.decks.fit(1, make_deck("flow", np.random.default_rng(0)))
    kinds = [positioning(lambda name, i=i: fleet.get_param(i, name)) for i in range(3)]
    assert [kind.decks for kind in kinds] == [("lighthouse",), ("flow",), ()]
    assert [kind.relative for kind in kinds] == [False, True, False]
    with pytest.raises(BackendError):
        fleet.get_param(2, "deck.bcFlow2")
    with pytest.raises(InputError, match="choose lighthouse or flow"):
        make_deck("gps", np.random.default_rng(0))


def test_a_deck_leaves_no_gap_in_what_is_traced():
    fleet = ArenaFleet([(0.0, 0.0, 0.0)])
    fleet.decks.fit(0, make_deck("lighthouse", np.random.default_rng(0)))
    fleet.advance(7)
    traces = np.full((1, 57, TRACE_SIZE), np.nan)
    fleet.advance(57, traces)
    assert fleet.tick == 64
    np.testing.assert_allclose(np.diff(traces[0, :, TR_TIME]), 1e-3, rtol=1e-6)
