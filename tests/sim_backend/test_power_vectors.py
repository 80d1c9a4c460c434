"""Power distribution of the three kinds against recorded output."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from crazyarena.sim_backend.firmware import power
from crazyarena.sim_backend.vehicles import default_rows
from tests.recorded import arrays, vector_files

FILES_2022 = list(vector_files("firmware_motor_m1_m4", "scg_pwm_m1_m4"))
FILES_2026 = list(vector_files("uncapped", "compensated_capped", "ft_uncapped"))

PLATFORM = default_rows().platform


def controls(data: dict[str, np.ndarray]) -> np.ndarray:
    return np.column_stack([data["rpy"], data["thrust"]]).astype(float)


def test_both_generations_are_recorded():
    assert FILES_2022
    assert FILES_2026


@pytest.mark.parametrize("path", FILES_2022, ids=lambda path: path.stem)
def test_firmware_2022(path: Path):
    data = arrays(path)
    motors = np.zeros((len(data["rpy"]), 4))
    for row, control in zip(motors, controls(data), strict=True):
        power.distribute_2022(control, 0.0, row)
    assert np.abs(motors - data["firmware_motor_m1_m4"]).max() <= 1


@pytest.mark.parametrize("path", FILES_2022, ids=lambda path: path.stem)
def test_competition_software(path: Path):
    data = arrays(path)
    pwm = np.zeros((len(data["rpy"]), 4))
    forces = np.zeros_like(pwm)
    for i, control in enumerate(controls(data)):
        power.distribute_competition(control, pwm[i], forces[i])
    np.testing.assert_allclose(pwm, data["scg_pwm_m1_m4"], atol=1e-6)
    np.testing.assert_allclose(forces, data["scg_force_env_order"], rtol=1e-9)


@pytest.mark.parametrize("path", FILES_2026, ids=lambda path: path.stem)
def test_firmware_2026_stage_by_stage(path: Path):
    data = arrays(path)
    idle = float(data["idle_thrust"])
    assert float(data["max_thrust_total_n"]) == pytest.approx(4 * PLATFORM[power.PF_MAX_FORCE])
    motors = np.zeros(4)
    for i, control in enumerate(controls(data)):
        power.mix(control, motors)
        assert np.abs(motors - data["uncapped"][i]).max() <= 1

        motors[:] = data["uncapped"][i]
        assert power.cap_2026(motors, idle) == data["is_capped"][i]
        np.testing.assert_array_equal(motors, data["capped"][i])

        motors[:] = data["uncapped"][i]
        power.compensate_2026(PLATFORM, float(data["supply_voltage"][i]), motors)
        assert np.abs(motors - data["compensated"][i]).max() <= 1

        motors[:] = data["compensated"][i]
        assert power.cap_2026(motors, idle) == data["compensated_is_capped"][i]
        np.testing.assert_array_equal(motors, data["compensated_capped"][i])


@pytest.mark.parametrize("path", FILES_2026, ids=lambda path: path.stem)
def test_firmware_2026_in_one_go(path: Path):
    data = arrays(path)
    motors = np.zeros((len(data["rpy"]), 4))
    for i, control in enumerate(controls(data)):
        supply = float(data["supply_voltage"][i])
        power.distribute_2026(PLATFORM, control, supply, float(data["idle_thrust"]), motors[i])
    # A motor may be off by one in the compensation and once more by the shift of the largest.
    error = np.abs(motors - data["compensated_capped"])
    assert error.max() <= 2
    assert np.mean(error > 1) < 1e-3


@pytest.mark.parametrize("path", FILES_2026, ids=lambda path: path.stem)
def test_force_torque_and_per_motor_modes(path: Path):
    data = arrays(path)
    motors = np.zeros(4)
    for i, request in enumerate(data["ft_thrust_torque_si"].astype(float)):
        power.mix_force_torque_2026(PLATFORM, *request, motors)
        assert np.abs(motors - data["ft_uncapped"][i]).max() <= 1
        motors[:] = data["ft_uncapped"][i]
        power.cap_2026(motors, 0.0)
        np.testing.assert_array_equal(motors, data["ft_capped"][i])
    for i, request in enumerate(data["nf_normalized"].astype(float)):
        power.mix_normalized_2026(request, motors)
        assert np.abs(motors - data["nf_uncapped"][i]).max() <= 1


@pytest.mark.parametrize("path", FILES_2026, ids=lambda path: path.stem)
def test_battery_compensation_table(path: Path):
    data = arrays(path)
    for i, command in enumerate(data["bat_thrust"]):
        for k, supply in enumerate(data["bat_voltage"]):
            motors = np.full(4, float(command))
            power.compensate_2026(PLATFORM, float(supply), motors)
            # The recorded value still has its fraction, and single-precision noise.
            assert motors[0] == pytest.approx(data["bat_ratio"][i, k], abs=1.05)
