"""One-step prediction of the competition plant against recorded simulator states."""

from __future__ import annotations

import numpy as np
import pytest

from crazyarena.sim_backend.physics import competition_step as plant_step
from crazyarena.sim_backend.physics.competition_step import (
    B_OMEGA,
    B_POS,
    B_PREVIOUS_POS,
    B_RPY,
    B_VEL,
    BODY_SIZE,
)
from tests.recorded import arrays, vector_files

FREE_FLIGHT = slice(1500, 4000)
FILES = list(vector_files("rpm_applied", "init_obs", "mass_ixx_iyy_izz"))


def test_there_is_a_recording():
    assert FILES


def _place(obs: np.ndarray) -> np.ndarray:
    body = np.zeros(BODY_SIZE)
    plant_step.set_pose(body, obs[0], obs[2], obs[4], obs[6], obs[7], obs[8])
    return body


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.name)
def test_one_step_in_free_flight(path):
    data = arrays(path)
    for episode, plant in enumerate(data["mass_ixx_iyy_izz"].astype(float)):
        obs = np.vstack([data["init_obs"][episode], data["obs"][episode]]).astype(float)
        rpm = data["rpm_applied"][episode].astype(float)
        force = data.get(f"force_noise_{episode}", np.zeros((len(rpm), 3))).astype(float)
        ticks = range(*FREE_FLIGHT.indices(len(rpm)))
        assert len(ticks) > 0
        worst = np.zeros(4)
        for k in ticks:
            body, before, after = _place(obs[k]), _place(obs[k - 1]), obs[k + 1]
            # The plant also remembers where it was, and how it was turned, one step ago.
            body[B_PREVIOUS_POS:B_RPY] = before[B_PREVIOUS_POS:B_RPY]
            body[B_VEL : B_VEL + 3] = obs[k, [1, 3, 5]]
            body[B_OMEGA : B_OMEGA + 3] = obs[k, 9:12]
            plant_step.step(body, plant, *rpm[k], *force[k])
            plant_step.update_rpy(body)
            worst = np.maximum(
                worst,
                [
                    np.abs(body[B_POS : B_POS + 3] - after[[0, 2, 4]]).max(),
                    np.abs(body[B_VEL : B_VEL + 3] - after[[1, 3, 5]]).max(),
                    np.abs(body[B_RPY : B_RPY + 3] - after[6:9]).max(),
                    np.abs(body[B_OMEGA : B_OMEGA + 3] - after[9:12]).max(),
                ],
            )
        assert (worst[:3] < 1e-6).all(), worst
        # Rates follow from torques of rounded poses over a tiny inertia: the recording's single
        # precision shows at 4e-6 rad/s.
        assert worst[3] < 4e-6, worst
