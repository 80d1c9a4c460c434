from __future__ import annotations

import numpy as np
import pytest
import yaml
from munch import Munch

from crazyarena.levels import load_level
from crazyarena.levels.contract import level_info
from tests.levels.competition_files import DISTURBANCES_AS_DICT, FILES, competition_file

GATES = [
    [0.5, -2.5, 0, 0, 0, -1.57, 0],
    [2, -1.5, 0, 0, 0, 0, 1],
    [0, 0.2, 0, 0, 0, 1.57, 1],
    [-0.5, 1.5, 0, 0, 0, 0, 0],
]


def test_level0():
    info = level_info(load_level("level0"))
    assert info["ctrl_timestep"] == 1 / 30
    assert info["ctrl_freq"] == 30
    assert info["episode_len_sec"] == 33
    assert isinstance(info["episode_len_sec"], int)
    assert info["nominal_physical_parameters"] == {
        "quadrotor_mass": 0.03454,
        "quadrotor_ixx_inertia": 1.4e-5,
        "quadrotor_iyy_inertia": 1.4e-5,
        "quadrotor_izz_inertia": 2.17e-5,
    }
    assert (info["quadrotor_kf"], info["quadrotor_km"]) == (3.16e-10, 7.94e-12)
    assert info["x_reference"].tolist() == [-0.5, 0, 2.9, 0, 0.75, 0, 0, 0, 0, 0, 0, 0]
    np.testing.assert_allclose(info["u_reference"], np.full(4, 0.084623), rtol=1e-6)
    assert info["gate_dimensions"] == {
        "tall": {"shape": "square", "height": 1.0, "edge": 0.45},
        "low": {"shape": "square", "height": 0.525, "edge": 0.45},
    }
    assert info["obstacle_dimensions"] == {"shape": "cylinder", "height": 1.05, "radius": 0.05}
    # Entries recognise the standard track by comparing with literals.
    assert info["nominal_gates_pos_and_type"] == GATES
    assert all(type(row) is list for row in info["nominal_gates_pos_and_type"])
    assert info["nominal_obstacles_pos"] == [
        [1.5, -2.5, 0, 0, 0, 0],
        [0.5, -1, 0, 0, 0, 0],
        [1.5, 0, 0, 0, 0, 0],
        [-1, 0, 0, 0, 0, 0],
    ]
    for key in (
        "initial_state_randomization",
        "inertial_prop_randomization",
        "gates_and_obs_randomization",
    ):
        assert info[key] == {}
    assert info["disturbances"] is None


@pytest.mark.parametrize("name", sorted(FILES))
def test_dicts_are_those_of_the_competition_file(name):
    info = level_info(load_level(name))
    config = yaml.safe_load(FILES[name].replace("1e-6", "1.0e-6").replace("1E-6", "1.0e-6"))
    theirs = config["quadrotor_config"]
    assert info["initial_state_randomization"] == theirs.get("init_state_randomization_info", {})
    assert info["inertial_prop_randomization"] == theirs.get("inertial_prop_randomization_info", {})
    assert info["gates_and_obs_randomization"] == theirs.get(
        "gates_and_obstacles_randomization_info", {}
    )
    assert info["disturbances"] == theirs.get("disturbances")


def test_attribute_access_and_fresh_copies():
    level = load_level("level3")
    info = level_info(level)
    assert info["gates_and_obs_randomization"]["obstacles"].high == 0.15
    assert info["initial_state_randomization"].init_z.low == 0.0
    assert info["disturbances"].action[0].std == 0.001
    assert isinstance(info["disturbances"].dynamics[0], Munch)
    info["nominal_gates_pos_and_type"][0][0] = 99.0
    info["gates_and_obs_randomization"]["gates"].high = 99.0
    fresh = level_info(level)
    assert fresh["nominal_gates_pos_and_type"] == GATES
    assert fresh["gates_and_obs_randomization"]["gates"].high == 0.15


def test_disturbances_given_short(tmp_path):
    path = tmp_path / "short.yaml"
    path.write_text(competition_file(disturbances=DISTURBANCES_AS_DICT))
    assert (
        level_info(load_level(path))["disturbances"]
        == level_info(load_level("level1"))["disturbances"]
    )
    level = load_level("level0", ["disturbances.action.std=[0.001, 0.002, 0.003, 0.004]"])
    assert level_info(level)["disturbances"] == {
        "action": [{"disturbance_func": "white_noise", "std": [0.001, 0.002, 0.003, 0.004]}]
    }
