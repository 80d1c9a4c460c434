"""Which vehicle was asked for, before it is read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from crazyarena.levels.schema import Level
from crazyarena.levels.schema import Vehicle as NominalVehicle
from crazyarena.sim_backend.vehicles.load import DEFAULT_VEHICLE, dump_vehicle, load_vehicle
from crazyarena.sim_backend.vehicles.schema import Vehicle
from crazyarena.sim_backend.vehicles.spread import draw_vehicle

_STREAM = 0x5EED  # of vehicles, apart from what else a seed stands for


@dataclass(frozen=True, slots=True)
class VehicleChoice:
    """A vehicle by name or file, None for what a level or the default says, and fields that are
    overridden (``body.mass=0.035``)."""

    name: str | None = None
    overrides: Sequence[str] = ()

    def load(self, default: str = DEFAULT_VEHICLE) -> Vehicle:
        """The vehicle; raises InputError as :func:`.load.load_vehicle`."""
        return load_vehicle(self.name or default, self.overrides)


class VehicleSupply:
    """The vehicles that fly, one after the other.

    Parameters
    ----------
    vehicle: the nominal one.
    seed: None: always that one. Otherwise each is drawn from its spread, and the first depends
        on the seed alone.
    """

    def __init__(self, vehicle: Vehicle, seed: int | None = None) -> None:
        self.vehicle = vehicle
        self._rng = None if seed is None else np.random.default_rng([seed, _STREAM])

        self.flown = vehicle

    @property
    def spread(self) -> bool:
        """Whether vehicles differ."""
        return self._rng is not None

    def next(self) -> Vehicle:
        """The vehicle that flies now."""
        if self._rng is not None:
            self.flown = draw_vehicle(self.vehicle, self._rng)
        return self.flown

    def told(self) -> dict[str, Any]:
        """What matters most of the vehicle that flies, as plain data, SI."""
        rotors, body = self.flown.rotors, self.flown.body
        return {
            "mass": body.mass.value,
            "strength": list(rotors.strength.value),
            "lag_up": rotors.lag_up.value,
            "lag_down": rotors.lag_down.value,
            "drag": list(body.drag.value),
            "drawn": self.flown.battery.drawn.value,
        }


def resolve(level: Level, choice: VehicleChoice) -> tuple[Level, Vehicle]:
    """The vehicle that flies an arena level, and the level with that vehicle's nominal numbers.

    What the level itself says of mass and inertia holds, over the vehicle's; where it says
    nothing, the level's are the vehicle's, so that a contestant is told of what flies.

    Raises
    ------
    InputError: the vehicle cannot be read.
    """
    name = choice.name or level.vehicle.model or DEFAULT_VEHICLE
    vehicle = choice.load(name)
    told = level.vehicle.model_fields_set - {"model", "spread"}
    mass, inertia = vehicle.body.mass, vehicle.body.inertia
    ours = dict(zip(("mass", "ixx", "iyy", "izz"), (mass.value, *inertia.value), strict=True))
    own = {name: getattr(level.vehicle, name) for name in told}
    nominal = NominalVehicle(model=name, spread=level.vehicle.spread, **{**ours, **own})
    body = vehicle.body.model_copy(
        update={
            "mass": mass.model_copy(update={"value": nominal.mass}),
            "inertia": inertia.model_copy(
                update={"value": (nominal.ixx, nominal.iyy, nominal.izz)}
            ),
        }
    )
    return (
        level.model_copy(update={"vehicle": nominal}),
        vehicle.model_copy(update={"body": body}),
    )


def level_supply(
    level: Level, seed: int, choice: VehicleChoice | None = None, spread: bool | None = None
) -> VehicleSupply:
    """The vehicles that fly a level, drawn from their spread if the level or ``spread`` says so."""
    _, vehicle = resolve(level, choice or VehicleChoice())
    wide = level.vehicle.spread if spread is None else spread
    return VehicleSupply(vehicle, seed if wide else None)


def vehicle_file(folder: Path, vehicle: Vehicle) -> Path:
    """Write a vehicle into a folder, for a process that is to read it."""
    file = folder / "vehicle.yaml"
    file.write_text(dump_vehicle(vehicle))
    return file
