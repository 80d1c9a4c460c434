"""What chance decides of one flight of the fault campaign, for every process that takes part."""

from __future__ import annotations

import random
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyarena.runner.campaign.circuit import Circuit
from crazyarena.runner.campaign.setting import BOOT, CLIMB, ONSET
from crazyarena.runner.rig.flight_model import flight_model
from crazyarena.safety.flight_model import MELLINGER, PID
from crazyarena.safety.limits import Limits
from crazyarena.sim_backend.vehicles import (
    Rows,
    Vehicle,
    VehicleChoice,
    draw_vehicle,
    vehicle_rows,
)

Array = NDArray[np.float64]

_TAKEN_FOR = 1.1  # times its thrust, which the guard takes a vehicle flown by attitude for


@dataclass(slots=True)
class Plan:
    """One flight.

    Attributes
    ----------
    seed: what it was drawn with.
    start: (3,) m; model: of the vehicle; vehicle: rows of what was drawn from its spread.
    mellinger: which of the firmware's controllers flies.
    circuit: the contestant's flight.
    struck: s on the clock of the campaign in virtual time, when the fault sets in.
    rng: what the fault itself draws from.
    """

    seed: int
    start: Array
    model: Vehicle
    vehicle: Rows
    mellinger: bool
    circuit: Circuit
    struck: float
    rng: random.Random

    def limits(self, limits: Limits) -> Limits:
        """``limits`` for the vehicle as the guard knows it: the model, not what was drawn."""
        controller = MELLINGER if self.mellinger else PID
        if limits.allow_attitude:
            limits = replace(limits, thrust_to_weight=_TAKEN_FOR * self.lift)
        return limits.for_vehicle(flight_model(self.model, controller))

    @property
    def lift(self) -> float:
        """Full thrust over the weight, of the model."""
        return flight_model(self.model).lift

    @property
    def onset(self) -> float:
        """When the fault sets in, s after the take-off."""
        return self.struck - BOOT


def draw_plan(fault: str, seed: int, choice: VehicleChoice | None = None) -> Plan:
    """The same flight for the same fault and seed, in virtual time and over UDP.

    Raises InputError for a vehicle that cannot be read.
    """
    rng = random.Random(f"{fault}/{seed}")
    start = np.array([rng.uniform(-0.5, 0.5), rng.uniform(-0.5, 0.5), 0.03])
    model = (choice or VehicleChoice()).load()
    vehicle = vehicle_rows(draw_vehicle(model, np.random.default_rng(rng.getrandbits(64))))
    # One flight in four with the firmware's other controller, which is slower.
    mellinger = seed % 4 != 3
    speed = rng.uniform(0.8, 2.0) if mellinger else rng.uniform(0.3, 0.5)
    climb = CLIMB if mellinger else 2.0 * CLIMB
    circuit = Circuit(start, rng, speed, climb)
    struck = rng.uniform(*ONSET) + climb - CLIMB
    return Plan(seed, start, model, vehicle, mellinger, circuit, struck, rng)


def planned(config: Mapping[str, Any]) -> Plan:
    """The plan of ``fault``, ``seed`` and ``vehicle`` (name or None, list of overrides), as one
    process tells another."""
    name, overrides = config["vehicle"]
    return draw_plan(config["fault"], config["seed"], VehicleChoice(name, tuple(overrides)))
