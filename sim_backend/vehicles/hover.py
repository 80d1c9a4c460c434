"""What Mellinger's controller takes a vehicle for, against what it is: its height at hover.

The controller asks for the weight of ``ctrlMel.mass`` and makes thrust of it by
``ctrlMel.massThrust``, a straight line; a vehicle that is heavier, or weaker, sinks until the
position error asks for the rest (Mellinger and Kumar, ICRA 2011, eq. 6, whose integral the firmware
limits to 2 cm of that).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from crazyarena.sim_backend.arena_params import PARAM_INDEX
from crazyarena.sim_backend.firmware.power import FULL_SCALE
from crazyarena.sim_backend.vehicles.rows import vehicle_rows
from crazyarena.sim_backend.vehicles.schema import Vehicle

_GRAVITY = 9.81
WORTH_TELLING = 0.05  # m


@dataclass(frozen=True, slots=True)
class Hover:
    """low: m by which the vehicle hovers below its setpoint (negative: above), before the integral;
    mass: kg, value of ``ctrlMel.mass`` that brings it up."""

    low: float
    mass: float


def push(vehicle: Vehicle, mass_thrust: float) -> float:
    """N that the motors make of a newton that Mellinger's controller asks for.

    By ``ctrlMel.massThrust``, the firmware's thrust curve and the strength of the motors.
    """
    strength = sum(vehicle.rotors.strength.value) / 4.0
    return mass_thrust * 4.0 * vehicle.firmware.max_force.value / FULL_SCALE * strength


def mellinger_hover(vehicle: Vehicle, told: Mapping[str, float] | None = None) -> Hover:
    """Height at hover of a vehicle under Mellinger's controller, and what to set.

    ``told`` are firmware parameters that differ from those of the vehicle's file.
    """
    params = vehicle_rows(vehicle).params

    def param(name: str) -> float:
        name = f"ctrlMel.{name}"
        return float(told[name]) if told and name in told else float(params[PARAM_INDEX[name]])

    asked = vehicle.body.mass.value / push(vehicle, param("massThrust"))
    return Hover(_GRAVITY * (asked - param("mass")) / param("kp_z"), asked)


def advice(vehicle: Vehicle) -> str | None:
    """What to set for a vehicle that would hover far from its setpoint; None for others."""
    hover = mellinger_hover(vehicle)
    if abs(hover.low) < WORTH_TELLING:
        return None
    where = "below" if hover.low > 0.0 else "above"
    return (
        f"Mellinger's controller will hold {vehicle.name} {100.0 * abs(hover.low):.0f} cm {where} "
        f"its setpoint: it takes it for another weight or other motors. Set ctrlMel.mass to "
        f"{hover.mass:.4f} (firmware.params of the vehicle's file)"
    )
