"""What chance decides of one flight of the fault campaign, for every process that takes part."""

from __future__ import annotations

import random
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crazyarena.runner.campaign.circuit import Circuit
from crazyarena.runner.campaign.setting import BOOT, CLIMB, ONSET
from crazyarena.runner.rig.flight_model import flight_model
from crazyarena.safety.flight_model import MELLINGER, PID
from crazyarena.safety.limits import Limits
from crazyarena.sim_backend.vehicles import Rows, draw_vehicle, load_vehicle, vehicle_rows

Array = NDArray[np.float64]


@dataclass(slots=True)
class Plan:
    """One flight.

    Attributes
    ----------
    seed: what it was drawn with.
    start: (3,) m; vehicle: rows of the vehicle, drawn from the spread of its model.
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

    def limits(self, limits: Limits) -> Limits:
        """``limits`` for the vehicle as the guard knows it: the model, not what was drawn."""
        controller = MELLINGER if self.mellinger else PID
        return limits.for_vehicle(flight_model(load_vehicle(), controller))

    @property
    def onset(self) -> float:
        """When the fault sets in, s after the take-off."""
        return self.struck - BOOT


def draw_plan(fault: str, seed: int) -> Plan:
    """The same flight for the same fault and seed, in virtual time and over UDP."""
    rng = random.Random(f"{fault}/{seed}")
    start = np.array([rng.uniform(-0.5, 0.5), rng.uniform(-0.5, 0.5), 0.03])
    vehicle = vehicle_rows(draw_vehicle(load_vehicle(), np.random.default_rng(rng.getrandbits(64))))
    # One flight in four with the firmware's other controller, which is slower.
    mellinger = seed % 4 != 3
    speed = rng.uniform(0.8, 2.0) if mellinger else rng.uniform(0.3, 0.5)
    climb = CLIMB if mellinger else 2.0 * CLIMB
    circuit = Circuit(start, rng, speed, climb)
    struck = rng.uniform(*ONSET) + climb - CLIMB
    return Plan(seed, start, vehicle, mellinger, circuit, struck, rng)
