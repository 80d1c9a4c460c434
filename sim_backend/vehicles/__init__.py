"""Vehicle models: what the firmware assumes, what the body is, and where every number is from."""

from crazyarena.sim_backend.vehicles.choice import (
    VehicleChoice,
    VehicleSupply,
    level_supply,
    resolve,
    vehicle_file,
)
from crazyarena.sim_backend.vehicles.load import (
    DEFAULT_VEHICLE,
    dump_vehicle,
    load_vehicle,
    shipped_vehicles,
)
from crazyarena.sim_backend.vehicles.rows import Rows, default_rows, vehicle_rows
from crazyarena.sim_backend.vehicles.schema import Vehicle
from crazyarena.sim_backend.vehicles.spread import draw_vehicle

__all__ = [
    "DEFAULT_VEHICLE",
    "Rows",
    "Vehicle",
    "VehicleChoice",
    "VehicleSupply",
    "default_rows",
    "draw_vehicle",
    "dump_vehicle",
    "level_supply",
    "load_vehicle",
    "resolve",
    "shipped_vehicles",
    "vehicle_file",
    "vehicle_rows",
]
