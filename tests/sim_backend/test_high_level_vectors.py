"""The high-level commander against recorded scenarios of both firmware generations."""

from __future__ import annotations

import numpy as np
import pytest

from crazyarena.sim_backend.firmware import high_level as hl
from crazyarena.sim_backend.firmware.layout import (
    SETPOINT_SIZE,
    SP_ACC,
    SP_ATT,
    SP_JERK,
    SP_MODE,
    SP_POS,
    SP_RATE,
    SP_VEL,
    ST_ATT,
    ST_POS,
    ST_VEL,
    STATE_SIZE,
)
from crazyarena.sim_backend.firmware.parameters import default_row
from crazyarena.sim_backend.firmware.planner import PL_STATE
from tests.recorded import arrays, vector_files

FILES = list(vector_files("scenario_kind", "ev_type", "traj_memory", "sp_rate_dps"))


def _generation(data: dict[str, np.ndarray]) -> int:
    return 2022 if "is_stopped" in data else 2026


class Replay:
    """One vehicle that is put through the events of a scenario."""

    def __init__(self, data: dict[str, np.ndarray]) -> None:
        generation = _generation(data)
        self.mem = hl.new_memory(generation)
        self.params = default_row(hl.PARAMS, generation)
        self.memory = data["traj_memory"].copy()
        self.state = np.zeros(STATE_SIZE)
        self.sp = np.zeros(SETPOINT_SIZE)
        for definition in data["traj_def"].tolist():
            assert hl.define_trajectory(self.mem, *definition) == hl.OK

    def execute(self, kind: int, a: list[float], t: float) -> int:
        mem = self.mem
        if kind == 0:
            return hl.stop(mem)
        if kind == 1:
            return hl.takeoff(mem, a[0], a[1], 0.0, True, t)
        if kind == 2:
            return hl.takeoff(mem, a[0], a[1], a[2], False, t)
        if kind == 3:
            return hl.takeoff_with_velocity(mem, self.params, a[0], bool(a[2]), a[1], 0.0, True, t)
        if kind == 4:
            return hl.land(mem, a[0], a[1], 0.0, True, t)
        if kind == 5:
            return hl.land(mem, a[0], a[1], a[2], False, t)
        if kind == 6:
            return hl.land_with_velocity(mem, self.params, a[0], bool(a[2]), a[1], 0.0, True, t)
        if kind in (7, 10):
            linear = kind == 10
            return hl.go_to(mem, self.memory, *a[:5], bool(a[5]), linear, t)
        if kind == 8:
            relative, reverse, turned = (bool(x) for x in a[2:5])
            return hl.start_trajectory(
                mem, self.memory, int(a[0]), a[1], relative, turned, reverse, t
            )
        if kind == 9:
            hl.tell_state(mem, self.state)
            return hl.OK
        if kind == 11:
            return hl.spiral(mem, bool(a[0]), bool(a[1]), *a[2:7], t)
        if kind == 12:
            return hl.disable(mem)
        assert kind == 13, f"unknown event type {kind}"
        hl.block(mem, bool(a[0]))
        return hl.OK


def _check(name: str, got: np.ndarray, expected: np.ndarray, tolerance: object) -> None:
    error = np.abs(got - expected) / tolerance
    worst = np.unravel_index(np.argmax(np.where(np.isnan(error), np.inf, error)), error.shape)
    assert error[worst] <= 1.0, f"{name}{worst}: {got[worst]} instead of {expected[worst]}"


@pytest.mark.parametrize(
    ("path", "scenario"),
    [(path, i) for path in FILES for i in range(len(arrays(path)["scenario_kind"]))],
    ids=lambda x: x if isinstance(x, int) else x.stem,
)
def test_scenario(path, scenario):
    data = arrays(path)
    old = _generation(data) == 2022
    name = str(data["scenario_names"][data["scenario_kind"][scenario]])
    first, last = data["row_start"][scenario : scenario + 2]
    rows = slice(first, last)
    events: dict[int, list[int]] = {}
    for j in np.flatnonzero((data["ev_row"] >= first) & (data["ev_row"] < last)):
        events.setdefault(int(data["ev_row"][j]), []).append(int(j))
    tell_always = old and bool(data["tell_state_every_row"][scenario])
    replay = Replay(data)
    state, sp = replay.state, replay.sp
    out = np.zeros((last - first, SETPOINT_SIZE))
    valid = np.zeros(last - first, dtype=int)
    planner = np.zeros(last - first, dtype=int)
    for row in range(first, last):
        t = float(data["t"][row])
        state[ST_POS : ST_POS + 3] = data["state_pos"][row]
        state[ST_VEL : ST_VEL + 3] = data["state_vel"][row]
        state[ST_ATT + 2] = data["state_yaw_deg"][row]
        for j in events.get(row, ()):
            args = data["ev_args"][j].astype(float).tolist()
            result = replay.execute(int(data["ev_type"][j]), args, t)
            assert result == data["ev_return"][j], f"event {j} of {name}"
        if tell_always:
            hl.tell_state(replay.mem, state)
        before = sp.copy()
        k = row - first
        valid[k] = hl.get_setpoint(replay.mem, replay.memory, t, state, sp)
        if valid[k] == hl.SETPOINT_UNTOUCHED:
            np.testing.assert_array_equal(sp, before)
        elif valid[k] == hl.SETPOINT_NULL:
            assert not sp.any()
        out[k] = sp
        planner[k] = hl.is_stopped(replay.mem) if old else replay.mem[PL_STATE]

    np.testing.assert_array_equal(valid, data["valid"][rows])
    np.testing.assert_array_equal(planner, data["is_stopped" if old else "planner_state"][rows])
    good = valid == hl.SETPOINT_TRAJECTORY
    large_yaw = old and name == "compressed"
    acc = data["sp_acc"][rows][good].astype(float)
    out = out[good]
    _check("pos", out[:, SP_POS : SP_POS + 3], data["sp_pos"][rows][good], 2e-4)
    _check("vel", out[:, SP_VEL : SP_VEL + 3], data["sp_vel"][rows][good], 5e-4)
    _check("acc", out[:, SP_ACC : SP_ACC + 3], acc, 2e-3 * np.maximum(1.0, np.abs(acc)))
    yaw = data["sp_yaw_deg"][rows][good]
    _check("yaw", out[:, SP_ATT + 2], yaw, 0.3 if large_yaw else 0.02)
    rate = data["sp_rate_dps"][rows][good]
    _check("rate", out[:, SP_RATE : SP_RATE + 3], rate, 1.5 if large_yaw else 0.3)
    if not old:
        _check("jerk", out[:, SP_JERK : SP_JERK + 3], data["sp_jerk"][rows][good], 0.05)
    assert (out[:, SP_MODE : SP_MODE + 7] == (1, 1, 1, 0, 0, 1, 0)).all()


def test_both_generations_are_recorded():
    assert {_generation(arrays(path)) for path in FILES} == {2022, 2026}
