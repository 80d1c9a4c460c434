"""The Kalman filter against runs of the real filter core."""

from __future__ import annotations

import numpy as np
import pytest

from crazyarena.jit import kernel
from crazyarena.sim_backend.firmware import kalman as k
from crazyarena.sim_backend.firmware.layout import (
    ST_ACC,
    ST_ACCEL,
    ST_ATT,
    ST_GYRO,
    ST_POS,
    ST_VEL,
    STATE_SIZE,
)
from crazyarena.sim_backend.firmware.parameters import default_row
from tests.recorded import arrays, vector_files

FILES = list(vector_files("meas_pos", "init_P", "rows_P", "attitude_reversion"))


@kernel(_nrt=True)
def _run(m, p, now, flying, gyro, acc, kinds, pos, quat, estimates, states, covariances):
    state = np.zeros(STATE_SIZE)
    measurement = np.zeros(7)
    for n in range(gyro.shape[0]):
        for i in range(3):
            state[ST_GYRO + i] = gyro[n, i]
            state[ST_ACCEL + i] = acc[n, i]
            measurement[i] = pos[n, i]
        for i in range(4):
            measurement[3 + i] = quat[n, i]
        k.kalman_advance(m, p, state, now + n, flying)
        if kinds[n] != k.MEAS_NONE:
            std_pos, std_quat = p[k.KP_EXT_POS_STD], p[k.KP_EXT_QUAT_STD]
            k.kalman_measure(m, kinds[n], measurement, std_pos, std_quat)
        k.kalman_complete(m, p, state, now + n)
        for i in range(13):
            estimates[n, i] = m[i]
        for i in range(STATE_SIZE):
            states[n, i] = state[i]
        for i in range(81):
            covariances[n, i] = m[k.KM_P + i]


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_every_run_reproduces_state_and_covariance(path):
    data = arrays(path)
    for run in range(len(data["flying"])):
        p = default_row(k.PARAMS, 2026)
        p[k.KP_INITIAL_X : k.KP_INITIAL_Z + 1] = data["initial_pos"][run]
        p[k.KP_INITIAL_YAW] = data["initial_yaw_rad"][run]
        m = k.kalman_memory()
        m[k.KM_REVERSION] = data["attitude_reversion"][run]
        k.kalman_init(m, p, 5000.0)
        np.testing.assert_allclose(m[k.KM_Q : k.KM_Q + 4], data["init_q_wxyz"][run], atol=1e-4)
        np.testing.assert_allclose(
            m[k.KM_P : k.KM_P + 81].reshape(9, 9), data["init_P"][run], rtol=1e-6, atol=1e-9
        )
        count = data["gyro_dps"].shape[1]
        estimates, states = np.zeros((count, 13)), np.zeros((count, STATE_SIZE))
        covariances = np.zeros((count, 81))
        _run(
            m,
            p,
            5000.0,
            bool(data["flying"][run]),
            data["gyro_dps"][run].astype(float),
            data["acc_g"][run].astype(float),
            data["meas_type"][run].astype(np.int64),
            data["meas_pos"][run].astype(float),
            data["meas_quat_xyzw"][run].astype(float),
            estimates,
            states,
            covariances,
        )
        rows = data["rows"]
        np.testing.assert_allclose(estimates[rows, :9], data["S"][run], atol=1e-4)
        q, expected = estimates[rows, 9:], data["q_wxyz"][run]
        np.testing.assert_allclose(q, expected, atol=1e-4)
        s = states[rows]
        np.testing.assert_allclose(s[:, ST_POS : ST_POS + 3], data["state_pos"][run], atol=1e-4)
        np.testing.assert_allclose(s[:, ST_VEL : ST_VEL + 3], data["state_vel"][run], atol=3e-4)
        np.testing.assert_allclose(s[:, ST_ACC : ST_ACC + 3], data["state_acc_g"][run], atol=3e-4)
        attitude = s[:, ST_ATT : ST_ATT + 3] - data["state_att_deg"][run]
        np.testing.assert_allclose((attitude + 180.0) % 360.0 - 180.0, 0.0, atol=0.02)
        expected = data["P"][run].astype(float)
        std = np.sqrt(np.einsum("tii->ti", expected))
        found = covariances[data["rows_P"]].reshape(-1, 9, 9)
        error = np.abs(found - expected) / (std[:, :, None] * std[:, None, :])
        assert error.max() < 1e-3


def test_there_are_vectors():
    assert FILES
