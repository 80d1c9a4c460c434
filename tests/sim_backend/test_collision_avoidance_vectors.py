"""The buffered Voronoi cell core against recorded cases."""

from __future__ import annotations

import numpy as np
import pytest

from crazyarena.sim_backend.firmware import collision_avoidance as ca
from crazyarena.sim_backend.firmware.layout import M_X, SETPOINT_SIZE, SP_POS, SP_VEL
from crazyarena.sim_backend.firmware.parameters import default_row
from tests.recorded import arrays, vector_files

FILES = list(vector_files("n_others", "others", "sidestep", "last_in", "out_pos"))
TOLERANCE = 1e-4


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.stem)
def test_recorded_cases(path):
    data = {
        name: array.astype(float) if array.dtype == np.float32 else array
        for name, array in arrays(path).items()
    }
    params = default_row(ca.PARAMS, 2026)
    faces = ca.new_scratch()
    wrong = []
    for i in range(len(data["mode"])):
        params[ca.P_ELLIPSOID : ca.P_ELLIPSOID + 3] = data["ellipsoid"][i]
        params[ca.P_BOX_MIN : ca.P_BOX_MIN + 3] = data["bbox_min"][i]
        params[ca.P_BOX_MAX : ca.P_BOX_MAX + 3] = data["bbox_max"][i]
        params[ca.P_HORIZON] = data["horizon"][i]
        params[ca.P_MAX_SPEED] = data["max_speed"][i]
        params[ca.P_SIDESTEP] = data["sidestep"][i]
        params[ca.P_TOLERANCE] = data["tol"][i]
        params[ca.P_ITERATIONS] = data["iters"][i]
        mem = data["last_in"][i].copy()
        sp = np.zeros(SETPOINT_SIZE)
        sp[SP_POS : SP_POS + 3] = data["sp_pos"][i]
        sp[SP_VEL : SP_VEL + 3] = data["sp_vel"][i]
        sp[M_X] = data["mode"][i]
        count = int(data["n_others"][i])
        ca.avoid_collisions(params, mem, *data["pos"][i], data["others"][i], count, sp, faces)
        got = np.concatenate([sp[SP_POS : SP_POS + 3], sp[SP_VEL : SP_VEL + 3], mem])
        expected = np.concatenate([data[k][i] for k in ("out_pos", "out_vel", "last_out")])
        if not np.allclose(got, expected, rtol=0.0, atol=TOLERANCE, equal_nan=True):
            wrong.append((i, got, expected))
    assert not wrong, f"{len(wrong)} cases, the first: {wrong[0]}"


def test_cases_are_recorded():
    assert FILES
