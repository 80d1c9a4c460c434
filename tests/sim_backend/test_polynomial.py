"""Polynomial pieces: boundary conditions, derivatives and flatness."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.polynomial import Polynomial

from crazyarena.sim_backend.firmware import polynomial as poly

small = st.floats(-3.0, 3.0)
ends = st.lists(small, min_size=6, max_size=6)


def _planned(duration: float, axes: list[list[float]]) -> np.ndarray:
    row = np.zeros(poly.PIECE_SIZE + poly.EVAL_SIZE)
    row[poly.PIECE_DURATION] = duration
    for axis, (p0, v0, a0, p1, v1, a1) in enumerate(axes):
        poly.plan_axis(row, 0, axis, duration, p0, v0, a0, p1, v1, a1)
    return row


def _at(row: np.ndarray, t: float, rate: float = 1.0) -> np.ndarray:
    poly.evaluate(row, 0, t, rate, row, poly.PIECE_SIZE)
    return row[poly.PIECE_SIZE :].copy()


@given(axes=st.lists(ends, min_size=4, max_size=4), duration=st.floats(0.3, 20.0))
def test_plan_meets_both_ends(axes, duration):
    row = _planned(duration, axes)
    wanted = np.array(axes)[:3]
    scale = 1.0 + 3.0 / duration**3
    for t, column in ((0.0, 0), (duration, 3)):
        point = _at(row, t)
        for k, start in enumerate((poly.EV_POS, poly.EV_VEL, poly.EV_ACC)):
            np.testing.assert_allclose(
                point[start : start + 3], wanted[:, column + k], atol=1e-9 * scale
            )
        np.testing.assert_allclose(point[poly.EV_JERK : poly.EV_JERK + 3], 0.0, atol=1e-8 * scale)
        assert abs(point[poly.EV_YAW] - axes[3][column]) < 1e-9


@given(end=ends, duration=st.floats(-5.0, 0.0))
def test_plan_without_time_is_already_there(end, duration):
    row = _planned(duration, [end] * 4)
    point = _at(row, 0.0)
    np.testing.assert_array_equal(point[poly.EV_POS : poly.EV_POS + 3], end[3])
    np.testing.assert_array_equal(point[poly.EV_VEL : poly.EV_VEL + 3], end[4])
    np.testing.assert_allclose(
        point[poly.EV_ACC : poly.EV_ACC + 3], end[5], rtol=1e-15, atol=1e-300
    )


@given(
    coefficients=st.lists(small, min_size=32, max_size=32),
    t=st.floats(-1.0, 1.5),
    rate=st.floats(-2.0, 2.0),
)
def test_evaluation_is_the_polynomial_and_its_derivatives(coefficients, t, rate):
    row = np.zeros(poly.PIECE_SIZE + poly.EVAL_SIZE)
    row[:32] = coefficients
    point = _at(row, t, rate)
    for axis in range(3):
        p = Polynomial(coefficients[8 * axis : 8 * axis + 8])
        for k in range(4):
            expected = p.deriv(k)(t) * rate**k if k else p(t)
            np.testing.assert_allclose(point[3 * k + axis], expected, rtol=1e-9, atol=1e-8)
    np.testing.assert_allclose(
        point[poly.EV_YAW], Polynomial(coefficients[24:])(t), rtol=1e-9, atol=1e-8
    )
    poly.hold(row, 0, t, row, poly.PIECE_SIZE)
    held = row[poly.PIECE_SIZE :]
    np.testing.assert_allclose(held[:3], point[:3], rtol=1e-9, atol=1e-8)
    assert not held[poly.EV_VEL : poly.EV_YAW].any()
    assert not held[poly.EV_OMEGA :].any()


def _attitude(acc: np.ndarray, yaw: float) -> np.ndarray:
    z = acc + np.array([0.0, 0.0, poly.GRAVITY])
    z = z / np.linalg.norm(z)
    y = np.cross(z, [np.cos(yaw), np.sin(yaw), 0.0])
    y = y / np.linalg.norm(y)
    return np.column_stack([np.cross(y, z), y, z])


@given(
    acc=st.tuples(small, small, small),
    jerk=st.tuples(small, small, small),
    yaw=st.floats(-7.0, 7.0),
    yaw_rate=small,
)
def test_body_rates_turn_the_thrust_axis_as_the_path_demands(acc, jerk, yaw, yaw_rate):
    h = 1e-5
    before = _attitude(np.array(acc) - h * np.array(jerk), yaw - h * yaw_rate)
    after = _attitude(np.array(acc) + h * np.array(jerk), yaw + h * yaw_rate)
    attitude = _attitude(np.array(acc), yaw)
    turn = attitude.T @ (after - before) / (2.0 * h)
    roll, pitch, around = poly.body_rates(acc, jerk, yaw, yaw_rate)
    np.testing.assert_allclose([roll, pitch], [-turn[1, 2], turn[0, 2]], atol=1e-7)
    np.testing.assert_allclose(around, attitude[2, 2] * yaw_rate, atol=1e-12)
