"""The geometric controllers against recorded firmware output, state carried along."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from crazyarena.sim_backend.firmware import layout as lay
from crazyarena.sim_backend.firmware import mellinger
from crazyarena.sim_backend.firmware.parameters import default_row
from tests.recorded import arrays, vector_files
from tests.sim_backend.controller_rows import generation, setpoint_rows, state_rows, worst

FILES = list(vector_files("mid_z_axis_desired", "mid_i_error", "out_rpy"))


def test_both_generations_are_recorded():
    assert {generation(arrays(path)) for path in FILES} == {2022, 2026}


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_whole_sequences(path: Path):
    data = arrays(path)
    gen = generation(data)
    control = mellinger.mellinger_2022 if gen == 2022 else mellinger.mellinger_2026
    par = default_row(mellinger.PARAMS, gen)
    state, sp, ticks = state_rows(data), setpoint_rows(data), data["tick"]
    outputs = np.zeros((*ticks.shape, lay.CONTROL_SIZE))
    memory = np.zeros((*ticks.shape, mellinger.MEM_SIZE))
    for s in range(ticks.shape[0]):
        mem, out = np.zeros(mellinger.MEM_SIZE), np.zeros(lay.CONTROL_SIZE)
        for t in range(ticks.shape[1]):
            tick = ticks[s, t]
            if tick != 1 if gen == 2022 else tick % 2 == 0:
                control(par, mem, state[s, t], sp[s, t], out)
            outputs[s, t] = out
            memory[s, t] = mem

    moments = np.abs(outputs[..., :3] - data["out_rpy"])
    assert moments.max() <= 1, worst(data, moments)
    assert np.mean(moments > 0) < 0.02
    thrust = np.abs(outputs[..., lay.CT_THRUST] - data["out_thrust"])
    assert thrust.max() <= 0.6, worst(data, thrust)
    integrals = np.abs(memory[..., :6] - data["mid_i_error"])
    assert integrals.max() <= 1e-5, worst(data, integrals)
    at = mellinger.MEM_Z_DESIRED
    axis = np.abs(memory[..., at : at + 3] - data["mid_z_axis_desired"])
    assert axis.max() <= 1e-5, worst(data, axis)
