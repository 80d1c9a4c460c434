"""Which vehicle is simulated, as the commands that simulate one share it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from crazyarena.sim_backend.vehicles import VehicleChoice

VehicleName = Annotated[
    str | None,
    typer.Option(
        "--vehicle",
        metavar="NAME|FILE",
        help="Vehicle model: cf21plus, cf21, cf21plus_thrust_kit, cf21b, cf2022 or a file. "
        "Default: the level's, or cf21plus.",
    ),
]
VehicleSet = Annotated[
    list[str] | None,
    typer.Option(
        "--vehicle-set",
        metavar="FIELD=VALUE",
        help="Override a field of the vehicle, e.g. body.mass=0.035 (repeatable).",
    ),
]


VehicleSpread = Annotated[
    bool | None,
    typer.Option(
        "--vehicle-spread/--no-vehicle-spread",
        help="Draw a vehicle from the spread of its model for every episode. Default: as the "
        "level says (sim2real: yes).",
    ),
]


def vehicle_choice(vehicle: VehicleName = None, vehicle_set: VehicleSet = None) -> VehicleChoice:
    """A group of options: the name or file of a vehicle, and fields that differ."""
    from crazyarena.sim_backend.vehicles import VehicleChoice

    return VehicleChoice(vehicle, tuple(vehicle_set or ()))
