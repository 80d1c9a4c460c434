"""Vehicle models: files, errors, rows, draws; and what the plant makes of them."""

from __future__ import annotations

import math

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from crazyarena.errors import InputError
from crazyarena.sim_backend.firmware import power
from crazyarena.sim_backend.physics import arena_plant as ap
from crazyarena.sim_backend.physics import competition_step as cs
from crazyarena.sim_backend.physics import rigid_body as rb
from crazyarena.sim_backend.vehicles import (
    default_rows,
    draw_vehicle,
    dump_vehicle,
    load_vehicle,
    shipped_vehicles,
    vehicle_rows,
)
from crazyarena.sim_backend.vehicles.schema import Quantity, Vehicle

DT = 1e-3


def quantities(model, path=""):
    for name in type(model).model_fields:
        value = getattr(model, name)
        if isinstance(value, Quantity):
            yield f"{path}{name}", value
        elif hasattr(type(value), "model_fields"):
            yield from quantities(value, f"{path}{name}.")


def test_the_shipped_vehicles_are_these():
    assert shipped_vehicles() == ("cf2022", "cf21", "cf21b", "cf21plus", "cf21plus_thrust_kit")


@pytest.mark.parametrize("name", shipped_vehicles())
def test_a_shipped_vehicle_says_where_every_number_is_from_and_loads_back(name):
    vehicle = load_vehicle(name)
    assert vehicle.name == name
    assert [path for path, quantity in quantities(vehicle) if not quantity.origin] == []
    assert vehicle.battery.open_circuit.origin
    assert Vehicle.model_validate(yaml.safe_load(dump_vehicle(vehicle))) == vehicle


@pytest.mark.parametrize("name", shipped_vehicles())
def test_a_shipped_vehicle_can_hover(name):
    rows = vehicle_rows(load_vehicle(name))
    most = 4.0 * ap.thrust_of_volts(rows.plant, 3.3)
    assert 1.2 < most / (rows.plant[rb.P_MASS] * 9.81) < 4.0


@pytest.mark.parametrize("name", shipped_vehicles())
@given(share=st.floats(0.0, 1.0))
@settings(max_examples=30)
def test_every_firmware_inverts_its_thrust_curve(name, share):
    row = vehicle_rows(load_vehicle(name)).platform
    low, high = row[power.PF_MIN_FORCE], row[power.PF_MAX_FORCE]
    force = low + share * (high - low)
    volts = power.motor_volts_2026(row, force)
    curve = row[power.PF_THRUST : power.PF_THRUST + 4]
    assert volts > 0.0
    assert np.polyval(curve[::-1], volts) == pytest.approx(force, rel=1e-8)


def test_the_vehicle_of_2022_is_that_of_the_competition_profile():
    rows = vehicle_rows(load_vehicle("cf2022"))
    theirs = rb.competition_plant()
    ours = rows.plant[: rb.FULL_PLANT_SIZE].copy()
    ours[rb.P_GRAVITY] = theirs[rb.P_GRAVITY]
    np.testing.assert_allclose(ours, theirs, rtol=1e-6)
    for pwm in (20000.0, 40000.0, 65535.0):
        rpm = power.COMPETITION_PWM_TO_RPM * pwm + power.COMPETITION_RPM_OFFSET
        lift = ap.thrust_of_volts(rows.plant, 3.0 * pwm / 65535.0)
        assert lift == pytest.approx(power.COMPETITION_KF * rpm**2, rel=1e-5)


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("body.mas=0.03", "body.mas: unknown field, did you mean 'mass'"),
        ("body.mass=-1", "body.mass: expected a number > 0"),
        ("body.mass=heavy", "body.mass: expected a finite number, found 'heavy'"),
        ("body.mass.spread=2", "body.mass.spread: expected a number < 1"),
        ("rotors.strength=[1, 1, 1]", "rotors.strength.value: expected 4 values, found 3"),
        ("battery.open_circuit=[[0, 3], [1, 4]]", "falling volts"),
        ("battery.open_circuit=[[0, 4], [0.5, 3]]", "shares from 0 to 1"),
        ("firmware.thrust=[0, 0, -1, 0.1]", "a thrust that rises with the voltage"),
        ("firmware.min_force=1", "firmware.min_force: expected less than max_force"),
        ("nonsense", "expected field=value"),
    ],
)
def test_a_wrong_field_is_named(override, words):
    with pytest.raises(InputError) as raised:
        load_vehicle("cf21plus", [override])
    assert words in str(raised.value)


def test_a_parameter_that_the_firmware_has_not_is_named():
    vehicle = load_vehicle("cf21plus", ["firmware.params={ctrlMel.mas: 0.03}"])
    with pytest.raises(InputError, match=r"firmware.params: .*'ctrlMel.mas'"):
        vehicle_rows(vehicle)


def test_an_unknown_name_is_answered_with_the_nearest():
    with pytest.raises(InputError, match="did you mean 'cf21plus'"):
        load_vehicle("cf21pluss")


def test_a_file_of_ones_own(tmp_path):
    file = tmp_path / "mine.yaml"
    data = yaml.safe_load(dump_vehicle(load_vehicle()))
    del data["name"]
    data["body"]["mass"] = 0.0347
    file.write_text(yaml.safe_dump(data))
    assert load_vehicle(file).name == "mine"
    assert load_vehicle("mine.yaml", folder=tmp_path).body.mass.value == 0.0347
    del data["rotors"]["lag_up"]
    file.write_text(yaml.safe_dump(data))
    with pytest.raises(InputError, match=r"mine.yaml:.*rotors.lag_up: missing"):
        load_vehicle(file)


def test_an_override_is_known_exactly():
    mass = load_vehicle("cf21plus", ["body.mass=0.035"]).body.mass
    assert (mass.value, mass.spread) == (0.035, 0.0)
    assert load_vehicle("cf21plus", ["body.mass.spread=0.1"]).body.mass.value == 0.0318


def test_draws_have_the_spread_of_the_file_and_repeat():
    vehicle = load_vehicle()
    rng = np.random.default_rng(5)
    drawn = [draw_vehicle(vehicle, rng) for _ in range(600)]
    again = draw_vehicle(vehicle, np.random.default_rng(5))
    assert again == drawn[0]
    cut = 0.8796  # of the standard deviation, by cutting at two
    for path, quantity in quantities(vehicle):
        group, name = path.split(".")
        values = np.array([getattr(getattr(one, group), name).value for one in drawn])
        nominal = np.array(quantity.value)
        if name == "drawn":
            assert values.min() >= 0.0
            assert values.max() <= 2.0 * quantity.spread
            continue
        share = values / np.where(nominal == 0.0, 1.0, nominal)
        wanted = cut * math.hypot(quantity.spread, quantity.each)
        assert share.std(axis=0).max() == pytest.approx(wanted, abs=0.1 * wanted + 1e-12)
    strengths = np.array([one.rotors.strength.value for one in drawn])
    apart = (strengths - strengths.mean(axis=1, keepdims=True)).std()
    assert apart == pytest.approx(cut * 0.02 * math.sqrt(0.75), rel=0.15)


def still(plant, volts=4.0):
    body = np.zeros(ap.ARENA_BODY_SIZE)
    body[cs.B_QUAT + 3] = 1.0
    body[ap.AB_VOLTS] = volts
    return body


def run(body, plant, motors, ticks):
    for _ in range(ticks):
        ap.arena_step(body, plant, motors, 0.0, 0.0, 0.0, DT)


def test_rotors_rise_and_fall_with_their_own_lag():
    rows = vehicle_rows(load_vehicle("cf21plus", ["rotors.lag_up=0.05", "rotors.lag_down=0.1"]))
    plant = rows.plant
    plant[ap.AP_RESISTANCE] = plant[ap.AP_IDLE_CURRENT] = 0.0
    plant[ap.AP_OPEN : ap.AP_OPEN + ap.OPEN_POINTS] = 4.0
    body = still(plant)
    on, off = np.full(4, 50000.0), np.zeros(4)
    top = math.sqrt(ap.thrust_of_volts(plant, 4.0 * 50000.0 / 65535.0))
    run(body, plant, on, 50)
    assert body[ap.AB_ROTOR] == pytest.approx(top * (1.0 - math.exp(-1.0)), rel=1e-6)
    run(body, plant, on, 2000)
    run(body, plant, off, 100)
    assert body[ap.AB_ROTOR] == pytest.approx(top * math.exp(-1.0), rel=1e-6)


def test_a_weak_motor_lifts_less_and_draws_the_same():
    weak = vehicle_rows(load_vehicle("cf21plus", ["rotors.strength=[0.5, 1, 1, 1]"])).plant
    strong = default_rows().plant
    ends = []
    for plant in (weak, strong):
        body = still(plant)
        run(body, plant, np.full(4, 40000.0), 500)
        ends.append(body)
    assert ends[0][ap.AB_FORCE] == pytest.approx(0.5 * ends[1][ap.AB_FORCE], rel=1e-12)
    assert ends[0][ap.AB_CHARGE] == ends[1][ap.AB_CHARGE]


def test_a_hovering_battery_sags_by_what_real_ones_do():
    """The drop at take-off of real vehicles that hover at 45 g of nominal lift: 0.5 to 0.6 V."""
    plant = vehicle_rows(load_vehicle("cf21plus")).plant
    body = still(plant, volts=4.1)
    body[ap.AB_CHARGE] = 0.1 * plant[ap.AP_CAPACITY]
    volts = 2.96
    for _ in range(600):
        command = np.full(4, 65535.0 * volts / body[ap.AB_VOLTS])
        run(body, plant, command, 1)
    free = ap.open_circuit_volts(plant, body[ap.AB_CHARGE] / plant[ap.AP_CAPACITY])
    assert 0.45 < free - body[ap.AB_VOLTS] < 0.65


def test_the_momentum_of_the_rotors_is_kept():
    """Without drag and yaw torque, body and rotors exchange momentum about z and lose none."""
    rows = vehicle_rows(
        load_vehicle(
            "cf21plus", ["rotors.yaw_torque=0", "body.drag=[0, 0, 0]", "rotors.lag_down=0.2"]
        )
    )
    plant = rows.plant
    body = still(plant)
    run(body, plant, np.array([60000.0, 0.0, 60000.0, 0.0]), 300)
    sense = np.array([1.0, -1.0, 1.0, -1.0])
    rotors = plant[ap.AP_MOMENTUM] * (sense * body[ap.AB_ROTOR : ap.AB_ROTOR + 4]).sum()
    assert rotors > 1e-5
    assert plant[rb.P_INERTIA + 2] * body[cs.B_OMEGA + 2] == pytest.approx(-rotors, rel=1e-9)


def test_turning_spinning_rotors_needs_a_torque():
    """Two rotors of one sense: rolling gives a pitch rate at spin / inertia times the roll rate."""
    plant = vehicle_rows(load_vehicle("cf21plus", ["body.inertia=[2e-5, 2e-5, 2e-5]"])).plant
    plant[ap.AP_LAG_DOWN] = 1.0
    body = still(plant)
    body[ap.AB_ROTOR] = body[ap.AB_ROTOR + 2] = 0.3
    body[cs.B_OMEGA] = 1.0
    ap.arena_step(body, plant, np.zeros(4), 0.0, 0.0, 0.0, DT)
    spin = plant[ap.AP_MOMENTUM] * 0.6
    assert body[cs.B_OMEGA + 1] == pytest.approx(DT * spin / 2e-5, rel=2e-3)
