"""Properties of the Kalman filter that recordings do not show."""

from __future__ import annotations

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st

from crazyarena.sim_backend.firmware import kalman as k
from crazyarena.sim_backend.firmware.layout import ST_ACCEL, ST_GYRO, STATE_SIZE
from crazyarena.sim_backend.firmware.parameters import default_row


def fresh():
    m, p = k.kalman_memory(), default_row(k.PARAMS, 2026)
    k.kalman_init(m, p, 0.0)
    state = np.zeros(STATE_SIZE)
    state[ST_ACCEL + 2] = 1.0
    return m, p, state


def tick(m, p, state, now, flying, kind, pose):
    k.kalman_advance(m, p, state, float(now), flying)
    if kind != k.MEAS_NONE:
        k.kalman_measure(m, kind, pose, p[k.KP_EXT_POS_STD], p[k.KP_EXT_QUAT_STD])
    k.kalman_complete(m, p, state, float(now))


@settings(max_examples=20, deadline=None)
@example(51639)
@given(st.integers(0, 2**32 - 1))
def test_covariance_stays_symmetric_bounded_and_positive(seed):
    rng = np.random.default_rng(seed)
    m, p, state = fresh()
    # A reset would put back the initial covariance, which is only bounded from the next tick on.
    p[k.KP_MAX_POS] = p[k.KP_MAX_VEL] = np.inf
    for now in range(300):
        state[ST_GYRO : ST_GYRO + 3] = rng.normal(0, 300, 3)
        state[ST_ACCEL : ST_ACCEL + 3] = rng.normal((0, 0, 1), 1, 3)
        pose = np.concatenate((rng.normal(0, 1, 3), rng.normal(0, 1, 4)))
        pose[3:] /= np.linalg.norm(pose[3:])
        kind = int(rng.integers(0, 12))
        tick(m, p, state, now, True, kind if kind < 3 else 0, pose)
    covariance = m[k.KM_P : k.KM_P + 81].reshape(9, 9)
    assert np.isfinite(m).all()
    np.testing.assert_array_equal(covariance, covariance.T)
    assert covariance.max() <= 100.0
    assert covariance.diagonal().min() >= 1e-6
    assert np.linalg.eigvalsh(covariance).min() > -1e-5


def test_a_wrong_pose_is_believed():
    m, p, state = fresh()
    pose = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0])
    for now in range(2000):
        tick(m, p, state, now, False, k.MEAS_POSE * (now % 10 == 0), pose)
    pose[0] = 5.0
    for now in range(2000, 2200):
        tick(m, p, state, now, False, k.MEAS_POSE * (now % 10 == 0), pose)
    assert state[0] > 0.3


def test_leaving_the_limits_resets_to_the_initial_position():
    for limit, pose_x in ((k.KP_MAX_POS, 3.0), (k.KP_MAX_VEL, 3.0)):
        m, p, state = fresh()
        p[limit] = 0.5
        p[k.KP_INITIAL_Y] = 0.25
        pose = np.array([pose_x, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
        resets = 0
        for now in range(400):
            pose[0] = pose_x * now / 100.0
            tick(m, p, state, now, True, k.MEAS_POSE * (now % 10 == 0), pose)
            resets += m[k.KM_S] == 0.0 and m[k.KM_S + 1] == 0.25
        assert resets


def test_reset_parameter_works_once():
    m, p, state = fresh()
    pose = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    for now in range(100):
        tick(m, p, state, now, False, k.MEAS_POSITION, pose)
    assert state[0] > 0.9
    p[k.KP_RESET] = 1.0
    tick(m, p, state, 100, False, k.MEAS_NONE, pose)
    assert state[0] == 0.0
    assert p[k.KP_RESET] == 0.0
