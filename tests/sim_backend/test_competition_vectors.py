"""Sensor chain, timing and whole control chain of the 2022 competition against recordings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from crazyarena.sim_backend.firmware import layout as lay
from crazyarena.sim_backend.firmware import mellinger, power
from crazyarena.sim_backend.firmware import wrapper_sensors as sensors
from crazyarena.sim_backend.firmware.parameters import default_row
from tests.recorded import arrays, vector_files

WRAPPER = list(vector_files("tick_pattern", "euler_rpy", "obs", "gyro_dps"))
CLOSED_LOOP = list(vector_files("tick_pattern", "init_obs", "control_rpy", "pwm_m1_m4"))

# Columns of a recorded observation in the order of sense(): position, velocity, angles.
COLUMNS = [0, 2, 4, 1, 3, 5, 6, 7, 8]
by_stem = pytest.mark.parametrize("path", WRAPPER, ids=lambda path: path.stem)


def started(first: np.ndarray) -> np.ndarray:
    mem = np.zeros(sensors.MEM_SIZE)
    sensors.reset(mem, *first[COLUMNS][3:])
    return mem


def test_wrapper_and_flights_are_recorded():
    assert WRAPPER
    assert CLOSED_LOOP


@by_stem
def test_tick_pattern(path: Path):
    recorded = arrays(path)["tick_pattern"]
    timing = np.zeros(sensors.TIMING_SIZE)
    ticks = [sensors.controller_tick(timing, step) for step in range(len(recorded))]
    np.testing.assert_array_equal(ticks, recorded)


@by_stem
def test_steps_per_control_step(path: Path):
    data = arrays(path)
    names = [name for name in data if name.startswith("steps_per_control_")]
    assert names
    for name in names:
        rate = float(name.removeprefix("steps_per_control_").removesuffix("hz"))
        step, counts = 0, []
        for control_step in range(len(data[name])):
            first = step
            while sensors.step_due(step, control_step, rate):
                step += 1
            counts.append(step - first)
        np.testing.assert_array_equal(counts, data[name], err_msg=name)


@by_stem
def test_quaternion_from_euler_angles(path: Path):
    data = arrays(path)
    state = np.zeros(lay.STATE_SIZE)
    for angles, expected in zip(data["euler_rpy"], data["euler_quat_xyzw"], strict=True):
        mem = started(np.zeros(12))
        sensors.sense(mem, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, *angles, state)
        np.testing.assert_allclose(state[lay.ST_QUAT : lay.ST_QUAT + 4], expected, atol=1e-9)


@by_stem
def test_sensor_chain(path: Path):
    data = arrays(path)
    obs = data["obs"].astype(float)
    mem = started(obs[0])
    states = np.zeros((len(obs), lay.STATE_SIZE))
    for row, state in zip(obs, states, strict=True):
        sensors.sense(mem, *row[COLUMNS], state)

    gyro = np.abs(states[:, lay.ST_GYRO : lay.ST_GYRO + 3] - data["gyro_dps"])
    assert np.all(gyro <= 3e-4 * np.maximum(1.0, np.abs(data["gyro_dps"])))
    for at, size, name in (
        (lay.ST_ACCEL, 3, "acc_g"),
        (lay.ST_ACC, 3, "state_acc_g"),
        (lay.ST_ATT, 3, "state_att_deg"),
        (lay.ST_QUAT, 4, "state_quat_xyzw"),
    ):
        np.testing.assert_allclose(
            states[:, at : at + size], data[name], atol=1e-5, rtol=1e-6, err_msg=name
        )


def recorded_setpoints(data: dict[str, np.ndarray], episode: int) -> np.ndarray:
    """Setpoint rows of one flight; all modes are 0 before the first command."""
    rows = np.zeros((data["obs"].shape[1], lay.SETPOINT_SIZE))
    rows[:, lay.SP_POS : lay.SP_POS + 3] = data["sp_pos"][episode]
    rows[:, lay.SP_VEL : lay.SP_VEL + 3] = data["sp_vel"][episode]
    rows[:, lay.SP_ACC : lay.SP_ACC + 3] = data["sp_acc"][episode]
    rows[:, lay.SP_ATT + 2] = data["sp_yaw_deg"][episode]
    rows[:, lay.SP_RATE : lay.SP_RATE + 3] = data["sp_rate_dps"][episode]
    rows[:, lay.SP_QUAT + 2 : lay.SP_QUAT + 4] = data["sp_quat_zw"][episode]
    modes = data["sp_mode_yaw_quat"][episode]
    rows[:, lay.M_YAW] = modes[:, 0]
    rows[:, lay.M_QUAT] = modes[:, 1]
    rows[:, [lay.M_X, lay.M_Y, lay.M_Z]] = modes.any(axis=1)[:, None]
    return rows


@pytest.mark.parametrize("path", CLOSED_LOOP, ids=lambda path: path.stem)
def test_control_chain_of_whole_flights(path: Path):
    data = arrays(path)
    par = default_row(mellinger.PARAMS, 2022)
    for episode, observations in enumerate(data["obs"].astype(float)):
        mem = started(data["init_obs"][episode])
        timing = np.zeros(sensors.TIMING_SIZE)
        memory = np.zeros(mellinger.MEM_SIZE)
        state, out = np.zeros(lay.STATE_SIZE), np.zeros(lay.CONTROL_SIZE)
        setpoints = recorded_setpoints(data, episode)
        controls = np.zeros((len(observations), lay.CONTROL_SIZE))
        pwm, forces = np.zeros((len(observations), 4)), np.zeros(4)
        for k, row in enumerate(observations):
            sensors.sense(mem, *row[COLUMNS], state)
            if sensors.controller_tick(timing, k) != sensors.TICK_SKIP:
                mellinger.mellinger_2022(par, memory, state, setpoints[k], out)
            power.distribute_competition(out, pwm[k], forces)
            controls[k] = out
        assert np.abs(controls[:, :3] - data["control_rpy"][episode]).max() <= 1
        assert np.abs(controls[:, lay.CT_THRUST] - data["control_thrust"][episode]).max() <= 0.02
        # One unit of a control is up to four units of PWM at low command.
        assert np.abs(pwm - data["pwm_m1_m4"][episode]).max() <= 5
