"""What chance decides of one flight of the fault campaign, for every process that takes part."""

from __future__ import annotations

import random
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from crazyarena.runner.campaign.circuit import Circuit
from crazyarena.runner.campaign.setting import BOOT, CLIMB, ONSET
from crazyarena.sim_backend.physics.arena_plant import AP_STRENGTH
from crazyarena.sim_backend.physics.competition_step import P_MASS
from crazyarena.sim_backend.vehicles import Rows, default_rows

Array = NDArray[np.float64]


@dataclass(slots=True)
class Plan:
    """One flight.

    Attributes
    ----------
    seed: what it was drawn with.
    start: (3,) m; vehicle: rows of the vehicle.
    mellinger: which of the firmware's controllers flies.
    circuit: the contestant's flight.
    struck: s on the clock of the campaign in virtual time, when the fault sets in.
    rng: what the fault itself draws from.
    """

    seed: int
    start: Array
    vehicle: Rows
    mellinger: bool
    circuit: Circuit
    struck: float
    rng: random.Random

    @property
    def onset(self) -> float:
        """When the fault sets in, s after the take-off."""
        return self.struck - BOOT


def draw_plan(fault: str, seed: int) -> Plan:
    """The same flight for the same fault and seed, in virtual time and over UDP."""
    rng = random.Random(f"{fault}/{seed}")
    start = np.array([rng.uniform(-0.5, 0.5), rng.uniform(-0.5, 0.5), 0.03])
    vehicle = default_rows()
    plant = vehicle.plant.copy()
    plant[P_MASS] *= rng.uniform(0.95, 1.1)
    plant[AP_STRENGTH : AP_STRENGTH + 4] = [rng.uniform(0.95, 1.05) for _ in range(4)]
    # One flight in four with the firmware's other controller, which is slower.
    mellinger = seed % 4 != 3
    speed = rng.uniform(0.8, 2.0) if mellinger else rng.uniform(0.3, 0.5)
    climb = CLIMB if mellinger else 2.0 * CLIMB
    circuit = Circuit(start, rng, speed, climb)
    struck = rng.uniform(*ONSET) + climb - CLIMB
    vehicle = replace(vehicle, plant=plant)
    return Plan(seed, start, vehicle, mellinger, circuit, struck, rng)
