"""What safety takes from the vehicle's file."""

from __future__ import annotations

import math
from dataclasses import astuple

import pytest

from crazyarena.runner.rig.flight_model import flight_model, gentlest, known
from crazyarena.runner.rig.safeguard import limits_for
from crazyarena.safety.flight_model import MELLINGER, PID, FlightModel
from crazyarena.safety.limits import Limits
from crazyarena.sim_backend.vehicles import load_vehicle, shipped_vehicles

WEAK = ["rotors.strength=[0.68, 0.68, 0.68, 0.68]"]
STRONG = ["rotors.strength=[1.3, 1.3, 1.3, 1.3]"]


def flat(model: FlightModel):
    return [x for part in astuple(model) for x in (part if isinstance(part, tuple) else (part,))]


def test_the_default_is_the_default_vehicle():
    assert flat(flight_model(load_vehicle())) == pytest.approx(flat(FlightModel()), rel=2e-3)
    standard, own = Limits(), Limits().for_vehicle(flight_model(load_vehicle()))
    assert own.braking == standard.braking
    assert own.reaction == pytest.approx(standard.reaction, abs=0.01)
    assert own.battery_land == standard.battery_land


@pytest.mark.parametrize("name", shipped_vehicles())
@pytest.mark.parametrize("controller", [PID, MELLINGER])
def test_every_shipped_vehicle_can_be_guarded(name, controller):
    limits = Limits().for_vehicle(flight_model(load_vehicle(name), controller))
    assert 3.0 < limits.braking <= 6.0
    assert 0.15 <= limits.reaction < 0.3


def test_a_weak_vehicle_is_trusted_with_less_than_a_strong_one():
    weak, strong = (
        Limits().for_vehicle(flight_model(load_vehicle("cf21plus", fields)))
        for fields in (WEAK, STRONG)
    )
    assert weak.vehicle.lift == pytest.approx(0.68 / 1.3 * strong.vehicle.lift)
    assert weak.braking < 3.5 < strong.braking == 6.0
    assert weak.reaction > strong.reaction == 0.15
    assert weak.setpoint_acceleration < 4.0 < strong.setpoint_acceleration == 12.0
    assert weak.vehicle.low > 0.1 > 0.0 > strong.vehicle.low
    # Its motors are spent at a voltage at which others fly on.
    assert weak.battery_land > 3.05 > strong.battery_land == 3.0
    assert weak.battery_warn > weak.battery_land


def test_mass_and_gains_of_the_firmware_count():
    heavy = flight_model(load_vehicle("cf21plus", ["body.mass=0.04"]))
    assert heavy.stiffness[0] == pytest.approx(FlightModel().stiffness[0] * 0.0318 / 0.04, rel=1e-3)
    told = flight_model(load_vehicle(), told={"ctrlMel.kp_xy": 0.5, "ctrlMel.mass": 0.0329})
    assert told.stiffness[0] == pytest.approx(FlightModel().stiffness[0] * 1.25, rel=1e-3)
    assert told.low == pytest.approx(0.0, abs=0.003)
    # The PID asks for a tilt: its stiffness does not depend on the mass, and it ignores velocities.
    pid = flight_model(load_vehicle("cf21plus", ["body.mass=0.04"]), PID)
    assert pid.stiffness[0] == pytest.approx(math.radians(25.0) * 9.81 * 2.0)
    assert not pid.follows_velocity


def test_slow_rotors_react_later():
    slow = load_vehicle("cf21plus", ["rotors.lag_up=0.4", "rotors.lag_down=0.4"])
    assert Limits().for_vehicle(flight_model(slow)).reaction > Limits().reaction


def test_what_somebody_has_set_stays():
    weak = flight_model(load_vehicle("cf21plus", WEAK))
    limits = Limits(braking=5.0, battery_land=2.9).for_vehicle(weak, {"braking", "battery_land"})
    assert (limits.braking, limits.battery_land) == (5.0, 2.9)
    assert limits.reaction > Limits().for_vehicle(weak).reaction


def test_a_fleet_is_guarded_as_its_gentlest():
    models = [flight_model(load_vehicle("cf21plus", fields)) for fields in (STRONG, WEAK, [])]
    assert gentlest(models, Limits()) == Limits().for_vehicle(models[1])
    assert gentlest([], Limits()) == Limits()
    assert [known(value) for value in (0.0, 1.0, 2.0, 5.0)] == [0, 1, 2, 1]


def test_the_runner_keeps_its_patience():
    limits = limits_for(30.0, 15, flight_model(load_vehicle("cf21plus", WEAK)))
    assert limits.controller_hold == pytest.approx(17 / 30)
    assert limits.braking < 3.5
