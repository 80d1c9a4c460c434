from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from crazyarena.sim_backend.physics import competition_step as c
from crazyarena.sim_backend.physics import rigid_body as rb
from crazyarena.sim_backend.vehicles import default_rows

ARENA_PLANT = default_rows().plant[: rb.FULL_PLANT_SIZE]
rate = st.floats(-30.0, 30.0)


def body_at(omega=(0, 0, 0), velocity=(0, 0, 0), rpy=(0, 0, 0)):
    body = np.zeros(c.BODY_SIZE)
    body[c.B_VEL : c.B_VEL + 3] = velocity
    body[c.B_QUAT : c.B_QUAT + 4] = Rotation.from_euler("xyz", rpy).as_quat()
    body[c.B_OMEGA : c.B_OMEGA + 3] = omega
    return body


@given(st.tuples(rate, rate, rate))
@settings(max_examples=25, deadline=None)
def test_torque_free_motion_keeps_angular_momentum(omega):
    plant = ARENA_PLANT
    body = body_at(omega)
    inertia = plant[rb.P_INERTIA : rb.P_INERTIA + 3]

    def momentum():
        turn = Rotation.from_quat(body[c.B_QUAT : c.B_QUAT + 4])
        return turn.apply(inertia * body[c.B_OMEGA : c.B_OMEGA + 3])

    before = momentum()
    for _ in range(500):
        rb.step(body, plant, *np.zeros(4), *np.zeros(6), 0.0002)
    np.testing.assert_allclose(momentum(), before, atol=0.02 * np.linalg.norm(before) + 1e-12)


@pytest.mark.parametrize(
    ("rotors", "axis", "sign"),
    [
        ((1, 1, 0, 0), 0, 1),  # left side up: roll right
        ((0, 1, 1, 0), 1, 1),  # back up: nose down
        ((1, 0, 1, 0), 2, 1),
        ((0, 1, 0, 1), 2, -1),
    ],
)
def test_rotors_turn_the_vehicle_the_right_way(rotors, axis, sign):
    body = body_at()
    rb.step(body, ARENA_PLANT, *(0.05 * np.array(rotors, float)), *np.zeros(6), 0.001)
    turned = body[c.B_OMEGA : c.B_OMEGA + 3]
    assert np.sign(turned[axis]) == sign
    assert np.abs(np.delete(turned, axis)).max() < 1e-12


def test_drag_gives_a_terminal_speed():
    plant = ARENA_PLANT
    body = body_at()
    for _ in range(40000):
        rb.step(body, plant, *np.zeros(4), *np.zeros(6), 0.001)
    weight = plant[rb.P_MASS] * plant[rb.P_GRAVITY]
    assert body[c.B_VEL + 2] == pytest.approx(-weight / plant[rb.P_DRAG + 2], rel=1e-3)


@given(st.tuples(rate, rate, rate), st.tuples(*[st.floats(-5, 5)] * 3))
@settings(max_examples=50, deadline=None)
def test_a_pose_step_can_be_taken_back(omega, velocity):
    body = body_at(omega, velocity, (0.3, -0.2, 1.0))
    before = body.copy()
    c.advance_pose(body, 0.002)
    c.advance_pose(body, -0.002)
    np.testing.assert_allclose(body, before, atol=1e-14)
