"""From a vehicle's file to what safety has to know of it."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from crazyarena.errors import BackendError
from crazyarena.safety.flight_model import (
    BRAKING,
    GRAVITY,
    MELLINGER,
    PID,
    FlightModel,
    ModelFacts,
    Point,
)
from crazyarena.safety.limits import Limits
from crazyarena.sim_backend.arena_params import PARAM_INDEX
from crazyarena.sim_backend.vehicles import Vehicle, vehicle_rows
from crazyarena.sim_backend.vehicles.hover import mellinger_hover, push

# s, of the attitude loops, found in simulation; that of the rotors counts in part, as the loops
# make up for most of it.
_TILTING = {MELLINGER: 0.16, PID: 0.12}
# rad/s and damping ratio of a tilt that swings to what is asked for, fitted to link losses flown
# with weak, strong, heavy and slow vehicles.
_SWINGING = {MELLINGER: (13.5, 0.85), PID: (13.0, 0.87)}
_OF_LAG = 0.2
_LEAST_LAG = 0.01  # s
_LOADED = 3.2  # V, under load, from which motors are reckoned with
_LIFTING = 1.05  # times its weight: less is not flying
_FULL_SCALE = 65535.0
# What height and stiffness under Mellinger's controller depend on.
_READ = tuple(
    f"ctrlMel.{name}"
    for name in ["mass", "massThrust", "kp_z", "kd_z", "kp_xy", "kd_xy", "ki_xy", "kR_xy", "kw_xy"]
)
_THRUST_SCALE = 1000.0  # of the PID's vertical loop


def flight_model(
    vehicle: Vehicle, controller: int = MELLINGER, told: Mapping[str, float] | None = None
) -> FlightModel:
    """What safety has to know of ``vehicle`` under a controller.

    ``told`` are firmware parameters that differ from those of the vehicle's file.
    """
    params = vehicle_rows(vehicle).params

    def param(name: str) -> float:
        return float(told[name]) if told and name in told else float(params[PARAM_INDEX[name]])

    mass = vehicle.body.mass.value
    weight = mass * GRAVITY
    lifted = _most(vehicle, _LOADED)
    lift = lifted / weight
    rotors = vehicle.rotors
    lag = max(rotors.lag_up.value, rotors.lag_down.value)
    common = FlightModel(
        controller=controller,
        agility=GRAVITY * math.sqrt(max(lift * lift - 1.0, 1e-4)),
        tilting=_TILTING.get(controller, max(_TILTING.values())) + _OF_LAG * lag,
        thrusting=max(lag, _LEAST_LAG),
        swinging=_SWINGING.get(controller, _SWINGING[PID]),
        lean=0.0,
        winding=0.0,
        drag=max(vehicle.body.drag.value[:2]) / mass,
        lift=lift,
        spent=_voltage(vehicle, _LIFTING * weight),
    )
    if controller == MELLINGER:
        share = push(vehicle, param("ctrlMel.massThrust")) / mass
        kp, kd = param("ctrlMel.kp_xy"), param("ctrlMel.kd_xy")
        kp_z, kd_z = param("ctrlMel.kp_z"), param("ctrlMel.kd_z")
        feed = share * param("ctrlMel.mass")
        return replace(
            common,
            stiffness=(share * kp, share * kp, share * kp_z),
            damping=(share * kd, share * kd, share * kd_z),
            feed=(feed, feed, feed),
            lean=param("ctrlMel.kw_xy") / (2.0 * param("ctrlMel.kR_xy")),
            winding=param("ctrlMel.ki_xy") / param("ctrlMel.mass"),
            low=mellinger_hover(vehicle, told).low,
        )
    tilt = math.radians(1.0) * GRAVITY  # m/s2 of a degree
    climb = _THRUST_SCALE / _FULL_SCALE * 4.0 * vehicle.firmware.max_force.value / mass
    climb *= sum(rotors.strength.value) / 4.0
    damping: Point = (
        tilt * param("velCtlPid.vxKp"),
        tilt * param("velCtlPid.vyKp"),
        climb * param("velCtlPid.vzKp"),
    )
    stiffness: Point = (
        damping[0] * param("posCtlPid.xKp"),
        damping[1] * param("posCtlPid.yKp"),
        damping[2] * param("posCtlPid.zKp"),
    )
    leaning = min(param("posCtlPid.rLimit"), param("posCtlPid.pLimit"))
    return replace(
        common,
        stiffness=stiffness,
        damping=damping,
        feed=(0.0, 0.0, 0.0),
        follows_velocity=False,
        agility=min(common.agility, GRAVITY * math.tan(math.radians(leaning))),
        low=0.0,
    )


def foretold(vehicle: Vehicle, controller: int, parameter: Callable[[str], float]) -> ModelFacts:
    """What a vehicle's file and the parameters of the vehicle itself foretell.

    ``parameter`` reads one; raises BackendError where it cannot. What the file sets is written
    before a flight, and counts before what the vehicle has now.
    """
    told = dict[str, float]()
    for name in _READ:
        with suppress(BackendError):
            told[name] = float(parameter(name))
    told.update(vehicle.firmware.params)
    hover = mellinger_hover(vehicle, told)
    params = vehicle_rows(vehicle).params
    thrust, mass = (
        told.get(name, float(params[PARAM_INDEX[name]]))
        for name in ("ctrlMel.massThrust", "ctrlMel.mass")
    )
    return ModelFacts(
        vehicle.name,
        flight_model(vehicle, controller, told),
        hover.mass,
        thrust * hover.mass / mass,
    )


def gentlest(models: Sequence[FlightModel], limits: Limits, keep: Collection[str] = ()) -> Limits:
    """``limits`` for a fleet: those of the vehicle that stops latest; ``keep`` stay."""
    fitted = [limits.for_vehicle(model, keep) for model in dict.fromkeys(models)]
    return max(fitted, key=lambda n: n.reaction + 1.0 / n.braking, default=limits)


def known(controller: float) -> int:
    """The controller as models know it; the gentlest, PID, for one that nobody has measured."""
    return int(controller) if int(controller) in BRAKING else PID


def _most(vehicle: Vehicle, volts: float) -> float:
    """N, of all motors, at a voltage: a full command, or what the firmware thinks is one."""
    firmware, rotors = vehicle.firmware, vehicle.rotors
    asked = np.polynomial.Polynomial(firmware.thrust.value)
    # Full command is the voltage at which the firmware expects its largest force.
    roots = (asked - firmware.max_force.value).roots()
    full = max((float(r.real) for r in roots if abs(r.imag) < 1e-9), default=volts)
    thrust = np.polynomial.Polynomial(rotors.thrust.value)
    return float(sum(rotors.strength.value) * thrust(min(volts, full)))


def _voltage(vehicle: Vehicle, force: float) -> float:
    """V, under load, at which all motors at full command have ``force`` N; 0 if always."""
    rotors = vehicle.rotors
    need = force / sum(rotors.strength.value)
    roots = (np.polynomial.Polynomial(rotors.thrust.value) - need).roots()
    real = [float(r.real) for r in roots if abs(r.imag) < 1e-9 and r.real > 0.0]
    return max(real, default=0.0)
