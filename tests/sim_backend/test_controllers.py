"""Rules of the controllers and of power distribution that hold without recordings."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crazyarena.sim_backend.firmware import layout as lay
from crazyarena.sim_backend.firmware import lowpass, mellinger, parameters, pid, power
from crazyarena.sim_backend.firmware import wrapper_sensors as sensors
from crazyarena.sim_backend.vehicles import default_rows

PLATFORM = default_rows().platform
MELLINGER = {2022: mellinger.mellinger_2022, 2026: mellinger.mellinger_2026}
both = pytest.mark.parametrize("generation", [2022, 2026])


def level_state() -> np.ndarray:
    state = np.zeros(lay.STATE_SIZE)
    state[lay.ST_QUAT + 3] = 1.0
    return state


def position_setpoint() -> np.ndarray:
    sp = np.zeros(lay.SETPOINT_SIZE)
    sp[[lay.M_X, lay.M_Y, lay.M_Z, lay.M_YAW]] = lay.MODE_ABS
    return sp


class Mellinger:
    """One controller with its memory."""

    def __init__(self, generation: int, **gains: float) -> None:
        self.par = parameters.default_row(mellinger.PARAMS, generation)
        for name, value in gains.items():
            self.par[parameters.index(mellinger.PARAMS, f"ctrlMel.{name}")] = value
        self.mem = np.zeros(mellinger.MEM_SIZE)
        self.out = np.zeros(lay.CONTROL_SIZE)
        self.kernel = MELLINGER[generation]

    def __call__(self, state: np.ndarray, sp: np.ndarray) -> np.ndarray:
        self.kernel(self.par, self.mem, state, sp, self.out)
        return self.out


@both
def test_hover_thrust_is_the_weight(generation: int):
    control = Mellinger(generation)
    out = control(level_state(), position_setpoint())
    mass = control.par[parameters.index(mellinger.PARAMS, "ctrlMel.mass")]
    assert out[lay.CT_THRUST] == pytest.approx(132000.0 * mass * 9.81)
    assert not out[:3].any()


@both
def test_setting_a_gain_takes_effect_at_once(generation: int):
    light, heavy = Mellinger(generation, mass=0.02), Mellinger(generation, mass=0.04)
    state, sp = level_state(), position_setpoint()
    assert heavy(state, sp)[lay.CT_THRUST] == pytest.approx(2.0 * light(state, sp)[lay.CT_THRUST])


@both
def test_left_yaw_asks_for_the_counterclockwise_motors(generation: int):
    sp = position_setpoint()
    sp[lay.SP_ATT + 2] = 20.0
    out = Mellinger(generation)(level_state(), sp)
    assert out[lay.CT_YAW] < 0.0
    motors = np.zeros(4)
    power.mix(out, motors)
    # M2 and M4 turn clockwise: their reaction is counterclockwise.
    assert min(motors[1], motors[3]) > max(motors[0], motors[2])


@both
def test_falling_setpoint_clears_integrals_but_not_rates(generation: int):
    control = Mellinger(generation)
    state, sp = level_state(), position_setpoint()
    sp[lay.SP_POS : lay.SP_POS + 3] = 0.3
    state[lay.ST_GYRO : lay.ST_GYRO + 3] = 50.0
    control(state, sp)
    assert control.mem[mellinger.MEM_I_POS] > 0.0
    sp[lay.SP_ACC + 2] = -30.0
    out = control(state, sp)
    assert out[lay.CT_THRUST] < 0.0
    assert not out[:3].any()
    assert not control.mem[:6].any()
    assert control.mem[mellinger.MEM_RATE] == pytest.approx(math.radians(50.0))


@both
def test_undefined_attitude_gives_no_moments(generation: int):
    sp = position_setpoint()
    sp[lay.SP_ACC + 2] = -9.81
    out = Mellinger(generation)(level_state(), sp)
    assert not out[:3].any()


def test_level_out_selects_hover_in_2026():
    sp = np.zeros(lay.SETPOINT_SIZE)
    sp[[lay.M_Z, lay.M_ROLL, lay.M_PITCH]] = lay.MODE_ABS
    sp[lay.M_YAW] = lay.MODE_VELOCITY
    sp[lay.SP_ATT] = 15.0
    old, new = Mellinger(2022), Mellinger(2026)
    assert old(level_state(), sp)[lay.CT_ROLL] != 0.0
    assert not new(level_state(), sp)[:3].any()


def test_pid_of_2026_restarts_when_a_mode_changes():
    par = parameters.default_row(pid.PARAMS, 2026)
    mem, out = np.zeros(pid.MEM_SIZE), np.zeros(lay.CONTROL_SIZE)
    state, sp = level_state(), position_setpoint()
    sp[lay.SP_POS + 2] = 0.5
    for tick in range(1, 500):
        pid.pid_2026(par, mem, state, sp, tick, out)
    climbing = out[lay.CT_THRUST]
    sp[lay.M_QUAT] = lay.MODE_ABS
    pid.pid_2026(par, mem, state, sp, 500, out)
    assert out[lay.CT_THRUST] < climbing


def test_pid_thrust_limits():
    state, sp = level_state(), position_setpoint()
    sp[lay.SP_POS + 2] = 100.0
    thrusts = []
    for generation, control in ((2022, pid.pid_2022), (2026, pid.pid_2026)):
        par = parameters.default_row(pid.PARAMS, generation)
        mem, out = np.zeros(pid.MEM_SIZE), np.zeros(lay.CONTROL_SIZE)
        for tick in range(1, 3000):
            control(par, mem, state, sp, tick, out)
        thrusts.append(out[lay.CT_THRUST])
    assert thrusts == pytest.approx([36000.0 + 32767.0, 65535.0])


@both
def test_default_rows_follow_their_declarations(generation: int):
    for params in (mellinger.PARAMS, pid.PARAMS, power.PARAMS):
        row = parameters.default_row(params, generation)
        assert row.shape == (len(params),)
        assert np.isfinite(row).all()
        names = [param.name for param in params]
        assert len(set(names)) == len(names)
        for i, name in enumerate(names):
            assert parameters.index(params, name) == i


def test_unknown_generation_or_name():
    with pytest.raises(ValueError, match="2024"):
        parameters.default_row(mellinger.PARAMS, 2024)
    with pytest.raises(KeyError):
        parameters.index(mellinger.PARAMS, "ctrlMel.kp_q")


commands = st.floats(-40000.0, 120000.0).map(math.trunc)


@given(st.tuples(commands, commands, commands, commands), st.sampled_from([0.0, 2000.0]))
def test_capping_keeps_differences_above_idle(requested: tuple[int, ...], idle: float):
    motors = np.array(requested, dtype=float)
    capped = power.cap_2026(motors, idle)
    assert capped == (max(requested) > 65535)
    assert idle <= motors.min()
    assert motors.max() <= 65535.0
    shift = max(0, max(requested) - 65535)
    for before, after in zip(requested, motors, strict=True):
        assert after == max(before - shift, idle)


@given(st.floats(float(PLATFORM[power.PF_MIN_FORCE]), 1e3))
def test_motor_volts_invert_the_thrust_curve(force: float):
    v = power.motor_volts_2026(PLATFORM, force)
    lifted = -0.02476537916 + 0.0652379352 * v - 0.02679250497 * v**2 + 0.006776789304 * v**3
    assert lifted == pytest.approx(force, rel=1e-9)


@given(st.floats(9000.0, 60000.0), st.floats(3.0, 4.2), st.floats(0.05, 1.0))
def test_a_lower_battery_needs_a_larger_command(command: float, supply: float, drop: float):
    fresh, tired = np.full(4, command), np.full(4, command)
    power.compensate_2026(PLATFORM, supply, fresh)
    power.compensate_2026(PLATFORM, supply - drop, tired)
    assert (tired > fresh).all()


@given(
    st.floats(0.05, 0.4),
    st.floats(-1e-3, 1e-3),
    st.floats(-1e-3, 1e-3),
    st.floats(-5e-4, 5e-4),
)
def test_force_torque_mode_produces_what_was_asked(
    thrust: float, torque_x: float, torque_y: float, torque_z: float
):
    motors = np.zeros(4)
    power.mix_force_torque_2026(PLATFORM, thrust, torque_x, torque_y, torque_z, motors)
    if motors.min() == 0.0:
        return
    f = motors / 65535.0 * PLATFORM[power.PF_MAX_FORCE]
    arm, tolerance = PLATFORM[power.PF_ARM], 4 * PLATFORM[power.PF_MAX_FORCE] / 65535.0
    assert f.sum() == pytest.approx(thrust, abs=tolerance)
    # M3 and M4 are on the left, M2 and M3 at the back; M1 and M3 react clockwise.
    assert arm * (f[2] + f[3] - f[0] - f[1]) == pytest.approx(torque_x, abs=tolerance)
    assert arm * (f[1] + f[2] - f[0] - f[3]) == pytest.approx(torque_y, abs=tolerance)
    yaw = PLATFORM[power.PF_TORQUE] * (f[1] + f[3] - f[0] - f[2])
    assert yaw == pytest.approx(torque_z, abs=tolerance)


def test_motors_of_2022_lose_authority_one_by_one():
    control = np.array([20001.0, 0.0, 0.0, 60000.0])
    motors = np.zeros(4)
    power.distribute_2022(control, 0.0, motors)
    np.testing.assert_array_equal(motors, [50000.0, 50000.0, 65535.0, 65535.0])
    power.compensate_2022(4.2, motors)
    assert (motors[:2] < 50000.0).all()


@given(st.floats(-1e3, 1e3), st.sampled_from([(500.0, 30.0), (1000.0, 80.0)]))
@settings(max_examples=30)
def test_a_settled_filter_stays(value: float, rates: tuple[float, float]):
    coef, delay = np.zeros(lowpass.COEF_SIZE), np.zeros(lowpass.DELAY_SIZE)
    lowpass.coefficients(*rates, coef)
    assert lowpass.reset(coef, delay, 0, value) == pytest.approx(value, rel=1e-5, abs=1e-30)
    for _ in range(50):
        assert lowpass.apply(coef, delay, 0, value) == pytest.approx(value, rel=1e-4, abs=1e-30)


def test_a_filter_survives_a_value_that_is_not_a_number():
    coef, delay = np.zeros(lowpass.COEF_SIZE), np.zeros(lowpass.DELAY_SIZE)
    lowpass.coefficients(1000.0, 80.0, coef)
    delay[:] = math.inf
    for _ in range(200):
        filtered = lowpass.apply(coef, delay, 0, 1.0)
    assert filtered == pytest.approx(1.0, rel=1e-4)


angles = st.tuples(st.floats(-3.1, 3.1), st.floats(-1.5, 1.5), st.floats(-3.1, 3.1))


@given(angles)
@settings(max_examples=50)
def test_resting_sensors(rpy: tuple[float, float, float]):
    mem, state = np.zeros(sensors.MEM_SIZE), np.zeros(lay.STATE_SIZE)
    sensors.reset(mem, 0.0, 0.0, 0.0, *rpy)
    for _ in range(200):
        sensors.sense(mem, 1.0, 2.0, 3.0, 0.0, 0.0, 0.0, *rpy, state)
    assert not state[lay.ST_GYRO : lay.ST_GYRO + 3].any()
    assert state[lay.ST_ACC + 2] == 1.0
    assert np.linalg.norm(state[lay.ST_ACCEL : lay.ST_ACCEL + 3]) == pytest.approx(1.0, abs=1e-4)
    assert np.linalg.norm(state[lay.ST_QUAT : lay.ST_QUAT + 4]) == pytest.approx(1.0)
    assert state[lay.ST_ATT + 1] == pytest.approx(-math.degrees(rpy[1]))


def test_competition_controller_runs_at_an_uneven_312_hz():
    timing = np.zeros(sensors.TIMING_SIZE)
    ticks = np.array([sensors.controller_tick(timing, step) for step in range(16500)])
    assert (ticks != sensors.TICK_SKIP).sum() / 33.0 == pytest.approx(311.9, abs=0.1)


@given(st.sampled_from([25.0, 30.0, 50.0, 60.0, 100.0]), st.integers(1, 200))
@settings(max_examples=30)
def test_control_steps_share_out_all_steps(rate: float, periods: int):
    step = 0
    for control_step in range(periods):
        while sensors.step_due(step, control_step, rate):
            step += 1
    assert step == pytest.approx(periods * sensors.STEP_RATE / rate, abs=1.0)
