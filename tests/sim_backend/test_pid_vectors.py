"""The cascaded PID controllers against recorded firmware output, state carried along."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from crazyarena.sim_backend.firmware import layout as lay
from crazyarena.sim_backend.firmware import pid
from crazyarena.sim_backend.firmware.parameters import default_row
from tests.recorded import arrays, vector_files
from tests.sim_backend.controller_rows import generation, setpoint_rows, state_rows, worst

FILES = list(vector_files("mid_rate_desired_dps", "mid_actuator_thrust", "out_rpy"))


def test_both_generations_are_recorded():
    assert {generation(arrays(path)) for path in FILES} == {2022, 2026}


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_whole_sequences(path: Path):
    data = arrays(path)
    gen = generation(data)
    control = pid.pid_2022 if gen == 2022 else pid.pid_2026
    par = default_row(pid.PARAMS, gen)
    state, sp, ticks = state_rows(data), setpoint_rows(data), data["tick"]
    outputs = np.zeros((*ticks.shape, lay.CONTROL_SIZE))
    memory = np.zeros((*ticks.shape, pid.MEM_SIZE))
    for s in range(ticks.shape[0]):
        mem, out = np.zeros(pid.MEM_SIZE), np.zeros(lay.CONTROL_SIZE)
        for t in range(ticks.shape[1]):
            control(par, mem, state[s, t], sp[s, t], ticks[s, t], out)
            outputs[s, t] = out
            memory[s, t] = mem

    moments = np.abs(outputs[..., :3] - data["out_rpy"])
    assert moments.max() <= 2, worst(data, moments)
    thrust = np.abs(outputs[..., lay.CT_THRUST] - data["out_thrust"])
    assert thrust.max() <= 0.05, worst(data, thrust)
    thrust = np.abs(memory[..., pid.MEM_THRUST] - data["mid_actuator_thrust"])
    assert thrust.max() <= 0.05, worst(data, thrust)
    attitude = memory[..., pid.MEM_ATTITUDE : pid.MEM_ATTITUDE + 3]
    attitude = np.abs(attitude - data["mid_attitude_desired_deg"])
    assert attitude.max() <= 0.01, worst(data, attitude)
    rates = memory[..., pid.MEM_RATE : pid.MEM_RATE + 3]
    rates = np.abs(rates - data["mid_rate_desired_dps"])
    assert rates.max() <= 0.1, worst(data, rates)
    if "mid_sp_vel_after" in data:
        velocity = memory[..., pid.MEM_VEL : pid.MEM_VEL + 3] - data["mid_sp_vel_after"]
        velocity = np.where((ticks % 10 == 0)[..., None], np.abs(velocity), 0.0)
        assert velocity.max() <= 1e-4, worst(data, velocity)
