"""What a vehicle file says of the height at hover, against a vehicle that hovers."""

from __future__ import annotations

import numpy as np
import pytest

from crazyarena.crazyswarm_compat import commands as c
from crazyarena.sim_backend.arena import ArenaFleet
from crazyarena.sim_backend.vehicles import load_vehicle, vehicle_rows
from crazyarena.sim_backend.vehicles.hover import advice, mellinger_hover


def _low(overrides):
    """m by which a vehicle flown to 1 m hovers below it."""
    fleet = ArenaFleet(
        [(0.0, 0.0, 0.0)], vehicles=vehicle_rows(load_vehicle("cf21plus", overrides))
    )
    fleet.set_param(0, "stabilizer.controller", 2)
    heights = []
    for k in range(800):
        fleet.external_pose(0, fleet.true_pose(0))
        if k >= 100:
            fleet.send(c.Position((0.0, 0.0, 1.0)), 0)
        fleet.advance(10)
        heights.append(fleet.true_pose(0).position[2])
    return 1.0 - float(np.mean(heights[-100:]))


@pytest.mark.parametrize(
    "overrides",
    [
        [],
        ["rotors.strength=[0.8, 0.8, 0.8, 0.8]"],
        ["body.mass=0.038"],
        ["firmware.params={ctrlMel.mass: 0.040}"],
    ],
)
def test_the_height_at_hover_is_foretold(overrides):
    told = mellinger_hover(load_vehicle("cf21plus", overrides))
    # The integral makes up for 2 cm at most.
    assert _low(overrides) == pytest.approx(told.low, abs=0.025)


def test_the_mass_to_set_brings_it_up():
    weak = ["rotors.strength=[0.75, 0.75, 0.75, 0.75]"]
    hover = mellinger_hover(load_vehicle("cf21plus", weak))
    assert hover.low > 0.08
    assert abs(_low([*weak, f"firmware.params={{ctrlMel.mass: {hover.mass}}}"])) < 0.02


def test_only_what_is_far_off_is_told():
    assert advice(load_vehicle()) is None
    told = advice(load_vehicle("cf21plus", ["rotors.strength=[0.7, 0.7, 0.7, 0.7]"]))
    assert told is not None
    assert "below" in told
    assert "ctrlMel.mass" in told
