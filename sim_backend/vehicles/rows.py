"""A vehicle model as the rows that the kernels read."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from crazyarena.errors import InputError
from crazyarena.sim_backend.arena_params import PARAM_INDEX, PARAMS
from crazyarena.sim_backend.firmware.parameters import default_row
from crazyarena.sim_backend.firmware.power import platform_row
from crazyarena.sim_backend.physics import arena_plant as ap
from crazyarena.sim_backend.physics.rigid_body import plant_row
from crazyarena.sim_backend.vehicles.load import load_vehicle
from crazyarena.sim_backend.vehicles.schema import Vehicle

Array = NDArray[np.float64]
GRAVITY = 9.81
_DEG = 180.0 / math.pi


@dataclass(frozen=True, slots=True)
class Rows:
    """What the kernels know of one vehicle.

    plant: (ARENA_PLANT_SIZE,) of :mod:`..physics.arena_plant`.
    platform: (PLATFORM_SIZE,) of :mod:`..firmware.power`.
    params: (len(PARAMS),) of :mod:`..arena_params`, after boot.
    noise: standard deviations of a sample: gyro deg/s, accelerometer g, as the firmware reads.
    offset: (3,) m, of the tracked body's origin from the centre of mass, body axes.
    drawn: share of the battery's charge that is gone when the vehicle is switched on.
    rotor_speed: rad/s per root of N.
    """

    plant: Array
    platform: Array
    params: Array
    noise: tuple[float, float]
    offset: Array
    drawn: float
    rotor_speed: float


def vehicle_rows(vehicle: Vehicle) -> Rows:
    """Rows of a vehicle.

    Raises
    ------
    InputError: ``firmware.params`` names a parameter that the firmware does not have.
    """
    firmware = vehicle.firmware
    return Rows(
        plant=_plant(vehicle),
        platform=platform_row(
            firmware.thrust.value,
            firmware.max_force.value,
            firmware.min_force.value,
            firmware.arm.value,
            firmware.yaw_torque.value,
        ),
        params=_params(vehicle),
        noise=(
            vehicle.sensors.gyro.value * _DEG,
            vehicle.sensors.accelerometer.value / GRAVITY,
        ),
        offset=np.array(vehicle.markers.offset.value),
        drawn=vehicle.battery.drawn.value,
        rotor_speed=vehicle.rotors.speed.value,
    )


def _plant(vehicle: Vehicle) -> Array:
    body, rotors, battery = vehicle.body, vehicle.rotors, vehicle.battery
    row = np.zeros(ap.ARENA_PLANT_SIZE)
    row[: ap.FULL_PLANT_SIZE] = plant_row(
        body.mass.value,
        body.inertia.value,
        GRAVITY,
        body.arm.value,
        rotors.yaw_torque.value,
        body.drag.value,
    )
    row[ap.AP_LAG_UP], row[ap.AP_LAG_DOWN] = rotors.lag_up.value, rotors.lag_down.value
    row[ap.AP_STRENGTH : ap.AP_STRENGTH + 4] = rotors.strength.value
    row[ap.AP_THRUST : ap.AP_THRUST + 4] = rotors.thrust.value
    row[ap.AP_CAPACITY] = 3600.0 * battery.capacity.value
    row[ap.AP_RESISTANCE] = battery.resistance.value
    row[ap.AP_CURRENT] = battery.current.value
    row[ap.AP_IDLE_CURRENT] = battery.idle_current.value
    row[ap.AP_MOMENTUM] = rotors.inertia.value * rotors.speed.value
    row[ap.AP_GROUND] = rotors.ground.value
    shares, volts = np.array(battery.open_circuit.table).T
    grid = np.linspace(0.0, 1.0, ap.OPEN_POINTS)
    row[ap.AP_OPEN : ap.AP_OPEN + ap.OPEN_POINTS] = np.interp(grid, shares, volts)
    return row


WRITTEN = ("locSrv.extPosStdDev", "locSrv.extQuatStdDev")
"""Parameters of a model that no firmware boots with: whoever flies writes them."""


def told_params(vehicle: Vehicle) -> dict[str, float]:
    """``group.name`` -> value of the parameters that a vehicle flies with where they need not be
    its firmware's own: a ground station writes them, a simulated vehicle has them at once."""
    return {
        "locSrv.extPosStdDev": vehicle.estimation.position_std.value,
        "locSrv.extQuatStdDev": vehicle.estimation.quaternion_std.value,
        **vehicle.firmware.params,
    }


def _params(vehicle: Vehicle) -> Array:
    row = default_row(PARAMS, 2026)
    for name, value in told_params(vehicle).items():
        if name not in PARAM_INDEX:
            raise InputError(
                f"vehicle {vehicle.name}: firmware.params: the firmware has no parameter {name!r}"
            )
        row[PARAM_INDEX[name]] = value
    return row


@cache
def default_rows() -> Rows:
    """Rows of the default vehicle; not to be written to."""
    return vehicle_rows(load_vehicle())
