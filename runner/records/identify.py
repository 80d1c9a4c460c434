"""A vehicle model from logs of one's own flights.

First every stream tells what it can by itself (:mod:`.identify_fit`). What is left, and can be
seen in the path alone, is found by flying the logs again (:mod:`.validate_replay`) and fitting
the path. Numbers are judged by flights that they were not fitted to.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from crazyarena.errors import InputError
from crazyarena.runner.records import identify_fit as fit
from crazyarena.runner.records import validate_flights as flights
from crazyarena.runner.records.validate_flights import RealFlight
from crazyarena.runner.records.validate_replay import fly, judged
from crazyarena.sim_backend.vehicles import Vehicle, vehicle_rows
from crazyarena.sim_backend.vehicles.schema import Quantity

Array = NDArray[np.float64]

GRAMS = (5.0, 500.0)
_SATURATED = 0.02  # share of the time with a motor at its full command that is worth a warning
_FAST_PATH = 0.3  # m/s, root mean square, below which a path tells neither drag nor delay
_BEST_KNOWN = 0.35  # relative standard error above which a fitted path tells nothing
_FACTOR = 4.0  # by which a number may be off at first
NEVER = {
    "body.inertia": "motors and turning rates tell torque over inertia only; weigh and swing it, "
    "or take that of the kind of vehicle",
    "rotors.thrust": "its shape over the voltage needs a thrust stand; strength scales it",
    "rotors.yaw_torque": "needs a thrust stand",
}
_MASS = "flights tell strength over mass only; weigh the vehicle and pass --mass"


@dataclass(frozen=True, slots=True)
class Finding:
    """One number of the model.

    value, before: as in the file, SI; error: standard error as a share of the value (the scatter
    over flights where there are several); source: what told it; flights: how many did.
    """

    name: str
    value: tuple[float, ...]
    before: tuple[float, ...]
    error: float
    source: str
    flights: int


@dataclass
class Identified:
    """What flights told.

    vehicle: the model with what was found; findings: what that is; refused: name of a number ->
    why it cannot be told; warnings: in plain words; errors: root mean square 3-D position error
    (m) by flight, with the first model and with one fitted to other flights (to all of them if
    there is only one: ``unseen`` is False then).
    """

    vehicle: Vehicle
    findings: list[Finding]
    refused: dict[str, str]
    warnings: list[str]
    errors: dict[str, tuple[float, float]] = field(default_factory=dict)
    unseen: bool = True


@dataclass
class _Model:
    """A vehicle on its way, and how it came about."""

    vehicle: Vehicle
    findings: list[Finding]
    refused: dict[str, str]


def identify(
    paths: Sequence[Path],
    vehicle: Vehicle,
    *,
    mass: float | None = None,
    controller: str | None = None,
    high_level: bool = False,
    say: Callable[[str], None] = lambda text: None,
) -> Identified:
    """Fit a vehicle model to logged flights.

    Parameters
    ----------
    paths: files and folders of flights, see :mod:`.validate_flights`.
    vehicle: what is not told by them is taken from here.
    mass: of the vehicle as it flew, kg.
    controller, high_level: as in :func:`.validate.validate`.

    Raises
    ------
    InputError: a file is no flight, or the mass is none of a vehicle.
    """
    if mass is not None:
        if not GRAMS[0] <= 1e3 * mass <= GRAMS[1]:
            raise InputError(
                f"--mass: found {1e3 * mass:g} g; expected {GRAMS[0]:g} to {GRAMS[1]:g} g"
            )
        vehicle = _with(vehicle, "body.mass", (mass,), 0.0, "weighed")
    logs = [flights.load(file, controller, high_level=high_level) for file in flights.find(paths)]
    warnings = _warnings(logs)
    model = _fitted(logs, vehicle, say)
    model.refused.update(NEVER)
    if mass is None:
        model.refused["body.mass"] = _MASS
    result = Identified(model.vehicle, model.findings, model.refused, warnings)
    result.unseen = len(logs) > 1
    _judge(result, logs, vehicle, say)
    return result


def _warnings(logs: Sequence[RealFlight]) -> list[str]:
    told = []
    for log in logs:
        full = fit.saturation(log)
        if full > _SATURATED:
            told.append(
                f"{log.name}: a motor is at its full command for {100 * full:.0f} % of the time; "
                "what it does there tells nothing of its strength"
            )
        seconds = log.end - log.start
        if seconds < 8.0:
            told.append(f"{log.name}: too short: {seconds:.1f} s; fly 20 s or more")
        elif _speed(log) < _FAST_PATH:
            told.append(f"{log.name}: too slow: {_speed(log):.2f} m/s; fly 0.5 m/s or more")
    return told


def _speed(log: RealFlight) -> float:
    try:
        moving = fit.velocity(log.pose)
    except fit.NotTold:
        return 0.0
    inside = judged(log, moving.time)
    return float(np.sqrt((moving.value[inside] ** 2).sum(axis=1).mean())) if inside.any() else 0.0


def _fitted(logs: Sequence[RealFlight], vehicle: Vehicle, say: Callable[[str], None]) -> _Model:
    """The model after all that these flights tell."""
    model = _Model(vehicle, [], {})
    # The lag first: what a motor's command amounts to depends on it a little.
    for number in (_lag, _strength, _resistance, _drag):
        number(model, logs)
    _by_path(model, logs, say)
    return model


def _gather(
    logs: Sequence[RealFlight], tell: Callable[[RealFlight], fit.Told]
) -> tuple[Array, Array, int]:
    """Values (m,) and relative errors (m,) over all flights that tell, and how many do.

    Raises
    ------
    NotTold: none does.
    """
    told, reason = [], "no flights"
    for log in logs:
        try:
            told.append(tell(log))
        except fit.NotTold as why:
            reason = str(why)
    if not told:
        raise fit.NotTold(reason)
    values = np.array([one.value for one in told])
    value = np.median(values, axis=0)
    if len(told) > 2:
        error = values.std(axis=0, ddof=1) / np.abs(value)
    else:
        error = np.array([one.error for one in told]).max(axis=0) / np.abs(value)
    return value, error, len(told)


def _note(
    model: _Model,
    name: str,
    value: Sequence[float] | np.ndarray,
    error: float,
    source: str,
    count: int,
) -> None:
    before = _value(model.vehicle, name)
    told = tuple(float(one) for one in value)
    origin = f"identified from {count} flight{'s' if count > 1 else ''}: {source}"
    model.vehicle = _with(model.vehicle, name, told, float(error), origin)
    model.findings.append(Finding(name, told, before, float(error), source, count))


def _lag(model: _Model, logs: Sequence[RealFlight]) -> None:
    plant = vehicle_rows(model.vehicle).plant
    try:
        value, error, count = _gather(logs, lambda log: fit.lag(log, plant))
    except fit.NotTold as why:
        model.refused["rotors.lag_up"] = str(why)
        return
    speeds = any(fit.rate(log.rotors) >= fit.FAST for log in logs)
    source = "rotor speeds" if speeds else "gyro and motor commands"
    for at, name in enumerate(("rotors.lag_up", "rotors.lag_down")):
        _note(model, name, value[at : at + 1], error[at], source, count)


def _strength(model: _Model, logs: Sequence[RealFlight]) -> None:
    plant = vehicle_rows(model.vehicle).plant
    try:
        value, error, count = _gather(logs, lambda log: fit.strength(log, plant))
    except fit.NotTold as why:
        model.refused["rotors.strength"] = str(why)
        return
    _note(model, "rotors.strength", value, error.max(), "motor commands and voltage", count)


def _resistance(model: _Model, logs: Sequence[RealFlight]) -> None:
    plant = vehicle_rows(model.vehicle).plant
    try:
        value, error, count = _gather(logs, lambda log: fit.resistance(log, plant))
        if value[0] <= 0.0:
            raise fit.NotTold("the voltage does not fall with the current")
    except fit.NotTold as why:
        model.refused["battery.resistance"] = str(why)
        return
    _note(model, "battery.resistance", value, error[0], "motor commands and voltage", count)


def _drag(model: _Model, logs: Sequence[RealFlight]) -> None:
    try:
        value, error, count = _gather(logs, fit.drag)
    except fit.NotTold as why:
        model.refused["body.drag"] = str(why)
        return
    mass, vertical = model.vehicle.body.mass.value, model.vehicle.body.drag.value[2]
    both = (*np.maximum(mass * value, 0.0), vertical)
    _note(model, "body.drag", both, error.max(), "accelerometer and attitude (z kept)", count)


# What is left, from the path


def _by_path(model: _Model, logs: Sequence[RealFlight], say: Callable[[str], None]) -> None:
    """Fit what no stream told to the paths, where they tell it."""
    free = [name for name in ("rotors.strength", "rotors.lag_up", "body.drag")
            if name in model.refused]  # fmt: skip
    moving = [log for log in logs if _speed(log) >= _FAST_PATH]
    if not free or not moving:
        return
    say(f"fitting {', '.join(free)} to the path of {len(moving)} flights")
    start = model.vehicle

    def scaled(at: Array) -> Vehicle:
        vehicle = start
        for name, one in zip(free, at, strict=True):
            for part in (name, "rotors.lag_down") if name == "rotors.lag_up" else (name,):
                # Steps of the fit are shares of what it is given, which must not be 0.
                factor = float(np.exp(one - 1.0))
                value = tuple(factor * one for one in _value(start, part))
                if name == "body.drag":
                    value = (*value[:2], _value(start, part)[2])
                vehicle = _with(vehicle, part, value, 0.0, "")
        return vehicle

    def residual(at: Array) -> Array:
        rows = vehicle_rows(scaled(at))
        return np.concatenate([_residual(log, rows) for log in moving])

    bound = float(np.log(_FACTOR))
    best = least_squares(
        residual, np.ones(len(free)), bounds=(1.0 - bound, 1.0 + bound), diff_step=0.08,
        xtol=5e-3, ftol=1e-3, max_nfev=8,
    )  # fmt: skip
    errors = _path_errors(best)
    for at, name in enumerate(free):
        if errors[at] > _BEST_KNOWN or abs(best.x[at] - 1.0) > 0.98 * bound:
            model.refused[name] += "; the path does not tell it either"
            continue
        del model.refused[name]
        found = scaled(best.x)
        source = "the path alone"
        if name == "rotors.lag_up":
            source = "the path alone: all delays together"
            _note(model, "rotors.lag_down", _value(found, "rotors.lag_down"), errors[at], source,
                  len(moving))  # fmt: skip
        _note(model, name, _value(found, name), errors[at], source, len(moving))


def _residual(log: RealFlight, rows: Any) -> Array:
    """Simulated minus real position where it is judged, in one row, ten times a second."""
    flown = fly(log, rows)
    time = flown.time[judged(log, flown.time)]
    at = np.arange(time[0], time[-1], 0.1)
    columns = [np.interp(at, flown.time, axis) for axis in flown.position.T]
    return np.asarray((np.stack(columns, axis=-1) - log.pose.at(at)).ravel() / np.sqrt(len(at)))


def _path_errors(best: Any) -> Array:
    """Standard errors of the logarithms; a second of a path counts once."""
    seconds = max(len(best.fun) / 30.0, 1.0)
    inverse = np.linalg.pinv(best.jac.T @ best.jac)
    return np.asarray(np.sqrt(float(best.fun @ best.fun) / seconds * np.diag(inverse)))


# Judging


def _judge(
    result: Identified, logs: Sequence[RealFlight], first: Vehicle, say: Callable[[str], None]
) -> None:
    """Errors of every flight with the first model, and with one that has not seen it."""
    say("flying the flights again")
    halves = (list(logs[0::2]), list(logs[1::2]))
    quiet: Callable[[str], None] = lambda text: None  # noqa: E731
    if result.unseen:
        others = (_fitted(halves[1], first, quiet), _fitted(halves[0], first, quiet))
    else:
        others = (_Model(result.vehicle, [], {}),) * 2
    before = vehicle_rows(first)
    for number, log in enumerate(logs):
        after = vehicle_rows(others[number % 2].vehicle)
        result.errors[log.name] = (_error(log, before), _error(log, after))


def _error(log: RealFlight, rows: Any) -> float:
    return float(np.sqrt((_residual(log, rows) ** 2).sum()))


# Fields of a vehicle by name


def _value(vehicle: Vehicle, name: str) -> tuple[float, ...]:
    group, key = name.split(".")
    value = getattr(getattr(vehicle, group), key).value
    return tuple(value) if isinstance(value, tuple) else (value,)


def _with(
    vehicle: Vehicle, name: str, value: Sequence[float], spread: float, origin: str
) -> Vehicle:
    """The vehicle with one number changed."""
    group, key = name.split(".")
    old: Quantity[Any] = getattr(getattr(vehicle, group), key)
    new = tuple(value) if isinstance(old.value, tuple) else value[0]
    changed = {"value": new, "spread": min(spread, 0.99), "each": 0.0, "origin": origin}
    part = getattr(vehicle, group).model_copy(update={key: old.model_copy(update=changed)})
    return vehicle.model_copy(update={group: part})
