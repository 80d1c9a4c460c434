"""Which vehicle was asked for, before it is read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from crazyarena.levels.schema import Level
from crazyarena.levels.schema import Vehicle as NominalVehicle
from crazyarena.sim_backend.vehicles.load import DEFAULT_VEHICLE, load_vehicle
from crazyarena.sim_backend.vehicles.schema import Vehicle


@dataclass(frozen=True, slots=True)
class VehicleChoice:
    """A vehicle by name or file, None for what a level or the default says, and fields that are
    overridden (``body.mass=0.035``)."""

    name: str | None = None
    overrides: Sequence[str] = ()

    def load(self, default: str = DEFAULT_VEHICLE) -> Vehicle:
        """The vehicle; raises InputError as :func:`.load.load_vehicle`."""
        return load_vehicle(self.name or default, self.overrides)


def resolve(level: Level, choice: VehicleChoice) -> tuple[Level, Vehicle]:
    """The vehicle that flies an arena level, and the level with that vehicle's nominal numbers.

    What the level itself says of mass and inertia holds, over the vehicle's; where it says
    nothing, the level's are the vehicle's, so that a contestant is told of what flies.

    Raises
    ------
    InputError: the vehicle cannot be read.
    """
    vehicle = choice.load(level.vehicle.model or DEFAULT_VEHICLE)
    told = level.vehicle.model_fields_set - {"model"}
    mass, inertia = vehicle.body.mass, vehicle.body.inertia
    ours = dict(zip(("mass", "ixx", "iyy", "izz"), (mass.value, *inertia.value), strict=True))
    own = {name: getattr(level.vehicle, name) for name in told}
    nominal = NominalVehicle(model=vehicle.name, **{**ours, **own})
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


def vehicle_file(folder: Path, vehicle: Vehicle) -> Path:
    """Write a vehicle into a folder, for a process that is to read it."""
    from crazyarena.sim_backend.vehicles.load import dump_vehicle

    file = folder / "vehicle.yaml"
    file.write_text(dump_vehicle(vehicle))
    return file
