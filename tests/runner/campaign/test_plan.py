"""What chance decides is the same for every process that takes part."""

from __future__ import annotations

import numpy as np
import pytest

from crazyarena.errors import InputError
from crazyarena.levels import load_level
from crazyarena.runner.campaign.flight import Flight
from crazyarena.runner.campaign.plan import draw_plan, planned
from crazyarena.runner.campaign.run import fly
from crazyarena.runner.campaign.setting import BOOT
from crazyarena.safety.limits import Limits
from crazyarena.sim_backend.vehicles import VehicleChoice


@pytest.mark.parametrize(("fault", "seed"), [("wall", 1), ("mocap_jump", 3)])
def test_it_is_the_flight_of_the_simulation(fault, seed):
    plan, flight = draw_plan(fault, seed), Flight(fault, seed, load_level("level0"))
    assert plan.onset == pytest.approx(flight.onset - BOOT)
    assert plan.mellinger == flight.mellinger
    np.testing.assert_array_equal(plan.vehicle.plant[None], flight.fleet.plants)
    for time in (0.0, 1.0, 5.0):
        there = flight.circuit.at(time)
        np.testing.assert_array_equal(plan.circuit.at(time).position, there.position)
    assert plan.rng.getstate() == flight.rng.getstate()


@pytest.mark.parametrize("name", ["cf21b", "cf21plus_thrust_kit"])
def test_a_vehicle_that_floats_above_its_setpoint_is_held_below_the_ceiling(name):
    """Its controller adds half a g to what a hold asks for: 0.61 and 0.36 m outside, once."""
    outcome = fly("straight_up", 0, vehicle=VehicleChoice(name))
    assert outcome.safe
    assert outcome.excursion < 0.1


def test_another_vehicle_flies_the_same_circuit():
    plan = planned({"fault": "wall", "seed": 2, "vehicle": ["cf21b", ["body.mass=0.05"]]})
    usual = draw_plan("wall", 2)
    assert plan.model.body.mass.value == 0.05
    np.testing.assert_array_equal(plan.start, usual.start)
    assert plan.circuit.at(3.0).position == pytest.approx(usual.circuit.at(3.0).position)
    assert plan.limits(Limits()).vehicle != usual.limits(Limits()).vehicle


def test_a_vehicle_nobody_has_is_refused():
    with pytest.raises(InputError, match="cf3"):
        fly("wall", 0, vehicle=VehicleChoice("cf3"))
