"""What chance decides is the same for every process that takes part."""

from __future__ import annotations

import numpy as np
import pytest

from crazyarena.levels import load_level
from crazyarena.runner.campaign.flight import Flight
from crazyarena.runner.campaign.plan import draw_plan
from crazyarena.runner.campaign.setting import BOOT


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
