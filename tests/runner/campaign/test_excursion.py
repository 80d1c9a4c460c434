"""How far out of the arena a vehicle gets."""

from __future__ import annotations

import numpy as np
import pytest

from crazyarena.runner.campaign.excursion import Excursion
from crazyarena.safety.fence import Fence
from crazyarena.types import VehicleState

FENCE = Fence(((-3.0, -3.0, -0.1), (3.0, 3.0, 2.0)))


def state(x: float, z: float, speed: float = 0.0) -> VehicleState:
    level = np.array([0.0, 0.0, 0.0, 1.0])
    return VehicleState(0.0, np.array([x, 0.0, z]), np.array([speed, 0.0, 0.0]), level, np.zeros(3))


def test_the_furthest_place_counts():
    excursion = Excursion(FENCE)
    for x in (2.0, 3.2, 2.5):
        excursion.see(state(x, 1.0), motors_off=False)
    assert excursion.worst == pytest.approx(0.2)
    assert not excursion.lies


def test_what_has_come_down_slides_by_friction_and_no_further():
    excursion = Excursion(FENCE)
    excursion.see(state(2.9, 0.5, 2.0), motors_off=True)
    excursion.see(state(3.0, 0.06, 2.0), motors_off=True)
    assert excursion.lies
    assert excursion.worst == pytest.approx(2.0**2 / (2 * 0.5 * 9.81))
    excursion.see(state(9.0, 0.06, 1.0), motors_off=True)
    assert excursion.worst < 0.5


def test_one_that_takes_off_again_is_followed_again():
    excursion = Excursion(FENCE)
    excursion.see(state(0.0, 0.03), motors_off=True)
    assert excursion.lies
    excursion.see(state(3.4, 0.06, 1.0), motors_off=False)
    assert not excursion.lies
    assert excursion.worst == pytest.approx(0.4)
