"""The supervisor against recorded transitions and time sequences."""

from __future__ import annotations

import numpy as np
import pytest

from crazyarena.sim_backend.firmware import supervisor as s
from crazyarena.sim_backend.firmware.layout import (
    SETPOINT_SIZE,
    SP_ATT,
    SP_MODE,
    SP_RATE,
    SP_THRUST,
    ST_ACCEL,
    STATE_SIZE,
)
from crazyarena.sim_backend.firmware.parameters import default_row
from tests.recorded import arrays, vector_files

FILES = list(vector_files("transition", "row_start", "motor_ratio"))
each_file = pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)


def test_there_are_vectors():
    assert FILES


@each_file
def test_every_transition(path):
    expected = arrays(path)["transition"]
    for state in range(expected.shape[0]):
        found = [s.transition(state, word) for word in range(expected.shape[1])]
        np.testing.assert_array_equal(found, expected[state], err_msg=f"state {state}")


@each_file
def test_override_in_every_state(path):
    data = arrays(path)
    for state in range(12):
        m = s.supervisor_memory()
        m[s.SV_STATE] = state
        setpoint = np.zeros(SETPOINT_SIZE)
        setpoint[SP_MODE : SP_MODE + 7] = 1, 1, 1, 0, 0, 0, 1
        setpoint[SP_THRUST] = 7.0
        setpoint[SP_ATT : SP_ATT + 3] = setpoint[SP_RATE : SP_RATE + 3] = 3.0
        s.supervisor_override(m, setpoint)
        np.testing.assert_array_equal(
            setpoint[SP_MODE : SP_MODE + 7], data["override_mode_out"][state]
        )
        assert setpoint[SP_THRUST] == data["override_thrust_kept"][state]
        if state == s.WARNING_LEVEL_OUT:
            assert not setpoint[SP_ATT : SP_ATT + 2].any()
            assert setpoint[SP_RATE + 2] == 0.0


@each_file
def test_every_time_sequence(path):
    data = arrays(path)
    starts = data["row_start"]
    for i in range(len(starts) - 1):
        m = s.supervisor_memory(auto_arm=not data["require_arming"][i])
        p, state = default_row(s.PARAMS, 2026), np.zeros(STATE_SIZE)
        for r in range(starts[i], starts[i + 1]):
            armed = recovered = -1
            if data["arm_request"][r] >= 0:
                armed = s.supervisor_request_arming(m, bool(data["arm_request"][r]))
            if data["recover_request"][r] >= 0:
                recovered = s.supervisor_request_recovery(m)
            p[s.SVP_STOP] = data["param_stop"][r]
            m[s.SV_STOP] = data["emergency_stop"][r]
            m[s.SV_DECK_FAULT] = data["deck_fault"][r]
            if data["watchdog_tick_ms"][r]:
                s.supervisor_feed_watchdog(m, float(data["watchdog_tick_ms"][r]))
            state[ST_ACCEL : ST_ACCEL + 3] = data["acc_g"][r]
            s.supervisor_update(
                m,
                p,
                state,
                float(data["tick_ms"][r]),
                float(data["setpoint_timestamp_ms"][r]),
                float(data["motor_ratio"][r]),
                0.0,
                int(data["hl_planner_state"][r]),
                True,
            )
            found = (
                armed,
                recovered,
                m[s.SV_STATE],
                m[s.SV_CONDITIONS],
                m[s.SV_INFO],
                s.supervisor_can_fly(m),
                s.supervisor_motors_allowed(m),
            )
            expected = (
                data["arm_return"][r],
                data["recover_return"][r],
                data["out_state"][r],
                data["out_conditions"][r],
                data["out_bitfield"][r],
                data["out_can_fly"][r],
                data["out_motors_allowed"][r],
            )
            assert found == expected, f"sequence {i}, row {r - starts[i]}"
