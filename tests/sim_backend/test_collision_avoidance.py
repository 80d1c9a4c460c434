"""Collision avoidance: the changed setpoint is feasible, and vehicles never meet."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from crazyarena.sim_backend.firmware import collision_avoidance as ca
from crazyarena.sim_backend.firmware.layout import M_X, SETPOINT_SIZE, SP_POS, SP_VEL
from crazyarena.sim_backend.firmware.parameters import default_row

RADII = np.array([0.3, 0.3, 0.9])
vector = st.tuples(*[st.floats(-2.0, 2.0)] * 3)


def _apply(params, mem, own, others, sp):
    peers = np.zeros((max(len(others), 1), 3))
    peers[: len(others)] = np.reshape(others, (-1, 3))
    faces = ca.new_scratch(len(peers))
    ca.avoid_collisions(params, mem, *own, peers, len(others), sp, faces)


def _setpoint(mode, pos=(0.0, 0.0, 0.0), vel=(0.0, 0.0, 0.0)):
    sp = np.zeros(SETPOINT_SIZE)
    sp[SP_POS : SP_POS + 3] = pos
    sp[SP_VEL : SP_VEL + 3] = vel
    sp[M_X] = mode
    return sp


def _violation(params, own, others, point) -> float:
    """How far a point is outside the buffered cell, from the definition, in m."""
    worst = np.max(np.abs(point - own)) - params[ca.P_HORIZON] * params[ca.P_MAX_SPEED]
    for other in others:
        # Scaled so that ellipsoids are unit balls; the wall is one radius before the middle.
        d = (other - own) / RADII
        along = np.dot((point - own) / RADII, d / np.linalg.norm(d))
        gradient = np.linalg.norm(d / RADII) / np.linalg.norm(d)
        worst = max(worst, (along - (np.linalg.norm(d) / 2.0 - 1.0)) / gradient)
    return worst


@settings(max_examples=200)
@given(
    own=vector,
    others=st.lists(vector, max_size=8),
    goal=vector,
    vel=vector,
    mode=st.sampled_from([1.0, 2.0]),
)
def test_result_is_feasible(own, others, goal, vel, mode):
    own, others = np.array(own), [np.array(o) for o in others]
    others = [o for o in others if np.linalg.norm((o - own) / RADII) > 2.05]
    params = default_row(ca.PARAMS, 2026)
    mem = ca.new_memory()
    sp = _setpoint(mode, goal, vel)
    _apply(params, mem, own, others, sp)
    assert np.isfinite(sp).all()
    assert np.isfinite(mem).all()
    pos, speed = sp[SP_POS : SP_POS + 3], sp[SP_VEL : SP_VEL + 3]
    slack = 11.0 * params[ca.P_TOLERANCE]
    reached = pos + speed if mode == 1.0 else own + params[ca.P_HORIZON] * speed
    assert _violation(params, own, others, reached) <= slack
    if mode == 1.0:
        assert _violation(params, own, others, pos) <= slack
        np.testing.assert_array_equal(mem, pos)
    else:
        np.testing.assert_array_equal(pos, goal)
        np.testing.assert_array_equal(mem, own)


@given(own=vector, step=st.tuples(*[st.floats(-0.2, 0.2)] * 3))
def test_far_from_everybody_nothing_changes(own, step):
    goal = np.add(own, step)
    sp = _setpoint(1.0, goal)
    before = sp.copy()
    params = default_row(ca.PARAMS, 2026)
    _apply(params, ca.new_memory(), own, [np.add(own, (9.0, 0.0, 0.0))], sp)
    np.testing.assert_allclose(sp, before, atol=1e-12)


@given(goal=vector, vel=vector)
def test_other_modes_are_left_alone(goal, vel):
    sp = _setpoint(0.0, goal, vel)
    before = sp.copy()
    mem = ca.new_memory()
    _apply(default_row(ca.PARAMS, 2026), mem, (0.0, 0.0, 0.0), [(0.1, 0.0, 0.0)], sp)
    np.testing.assert_array_equal(sp, before)
    assert np.isnan(mem).all()


def test_two_vehicles_at_one_place_stay_finite():
    mem = ca.new_memory()
    sp = _setpoint(1.0, (1.0, 0.0, 1.0), (0.5, 0.0, 0.0))
    _apply(default_row(ca.PARAMS, 2026), mem, (0.0, 0.0, 1.0), [(0.0, 0.0, 1.0)], sp)
    assert np.isfinite(sp).all()


@settings(max_examples=15)
@given(count=st.integers(2, 6), phase=st.floats(0.0, 6.0), radius=st.floats(1.2, 2.0))
def test_vehicles_that_swap_places_never_meet(count, phase, radius):
    angles = phase + 2.0 * np.pi * np.arange(count) / count
    pos = np.column_stack([radius * np.cos(angles), radius * np.sin(angles), np.ones(count)])
    goals = pos * (-1.0, -1.0, 1.0)
    params = default_row(ca.PARAMS, 2026)
    memory = [ca.new_memory() for _ in range(count)]
    for _ in range(250):
        new = pos.copy()
        for i in range(count):
            sp = _setpoint(1.0, goals[i])
            _apply(params, memory[i], pos[i], np.delete(pos, i, axis=0), sp)
            # A vehicle with a bounded speed that heads for its setpoint.
            way = sp[SP_POS : SP_POS + 3] - pos[i]
            new[i] += way * min(1.0, 0.05 / max(np.linalg.norm(way), 1e-9))
        pos = new
        for i in range(count):
            for j in range(i):
                assert np.linalg.norm((pos[i] - pos[j]) / RADII) > 2.0 - 1e-3
    if count == 2:
        # More of them, in perfect symmetry, may block each other; two step to the right.
        np.testing.assert_allclose(pos, goals, atol=0.05)


def test_peer_table():
    table = np.zeros((ca.MAX_PEERS, ca.PEER_SIZE))
    peers = np.zeros((ca.MAX_PEERS, 3))
    for peer in range(1, 13):
        ca.note_peer(table, peer, float(peer), 0.0, 1.0, 1000.0 * peer)
    assert ca.current_peers(table, 10_000.0, 5000.0, peers) == 6
    np.testing.assert_array_equal(peers[:6, 0], [5, 6, 7, 8, 9, 10])
    ca.note_peer(table, 2, -2.0, 0.0, 1.0, 20_000.0)
    assert ca.current_peers(table, 20_000.0, 5000.0, peers) == 1
    np.testing.assert_array_equal(peers[0], [-2.0, 0.0, 1.0])
