"""A vehicle model held against flights of real vehicles: errors, lags, offsets, side by side."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyarena.errors import InputError
from crazyarena.runner.records import validate_flights as flights
from crazyarena.runner.records.validate_flights import RealFlight
from crazyarena.runner.records.validate_replay import (
    SimulatedFlight,
    fly,
    hover_strength,
    judged,
)
from crazyarena.sim_backend.vehicles import Vehicle, vehicle_rows

Array = NDArray[np.float64]

PURE_DELAY = 0.54  # s, of the comparison that knows nothing of dynamics
_CLOCKS = 0.05  # s by which the clocks of a log's streams may differ
_LAGS = 0.4  # s
_OFF_GROUND = 0.1  # m
HOVER = ("flight", "set", "none")
CONTROLLER_NAMES = {1: "PID", 2: "Mellinger"}


@dataclass(frozen=True, slots=True)
class Outcome:
    """Figures of one flight; m, s, V. Errors are root mean squares over the judged time.

    rmse: 3-D, simulated against real path; aligned: the same with the best clock offset within
    50 ms; plane: horizontal; axes: x, y, z. lag: by how much the simulation is behind reality.
    offset: mean of simulated minus real position. ideal, delayed: 3-D errors of perfect tracking
    and of the setpoint 0.54 s ago (NaN where nothing was streamed). takeoff: real and simulated
    time from the first command to 0.1 m above ground. sag: real and simulated drop of the
    battery from rest to flight. strength: of the motors, relative to the model.
    """

    name: str
    controller: str
    duration: float
    rmse: float
    aligned: float
    plane: float
    plane_aligned: float
    axes: tuple[float, ...]
    lag: float
    offset: tuple[float, ...]
    ideal: float
    delayed: float
    takeoff: tuple[float, float]
    sag: tuple[float, float]
    strength: float
    calibrated: bool


@dataclass(frozen=True, slots=True)
class Pair:
    """A flight, what the simulation made of it, and the figures of both."""

    real: RealFlight
    simulated: SimulatedFlight
    outcome: Outcome


def validate(
    paths: Sequence[Path],
    vehicle: Vehicle,
    *,
    hover: str = "flight",
    controller: str | None = None,
    high_level: bool = False,
    on_flight: Callable[[int, int], None] = lambda done, of: None,
) -> list[Pair]:
    """Fly logged flights again with a vehicle model.

    Parameters
    ----------
    paths: files and folders of flights, see :mod:`.validate_flights`.
    hover: which thrust to hover is taken from the logs: that of each ``flight``, the median of
        the ``set``, or ``none``: that of the model.
    controller: ``pid`` or ``mellinger`` where files do not say.
    high_level: setpoints came from the planner on board.

    Raises
    ------
    InputError: a file is no flight; the message names file, field and remedy.
    """
    if hover not in HOVER:
        raise InputError(f"--hover: found {hover!r}; expected one of {', '.join(HOVER)}")
    rows = vehicle_rows(vehicle)
    loaded = [flights.load(file, controller, high_level=high_level) for file in flights.find(paths)]
    strengths = [None if hover == "none" else hover_strength(flight, rows) for flight in loaded]
    if hover == "set":
        known = [value for value in strengths if value is not None]
        strengths = [float(np.median(known)) if known else None] * len(loaded)
    pairs = []
    for number, (flight, strength) in enumerate(zip(loaded, strengths, strict=True)):
        on_flight(number, len(loaded))
        simulated = fly(flight, rows, 1.0 if strength is None else strength)
        pairs.append(Pair(flight, simulated, _outcome(flight, simulated, strength is not None)))
    on_flight(len(loaded), len(loaded))
    return pairs


def _outcome(flight: RealFlight, simulated: SimulatedFlight, calibrated: bool) -> Outcome:
    time = simulated.time
    inside = judged(flight, time)
    if not inside.any():
        raise InputError(f"{flight.file}: no pose while commands were sent; check the clocks")
    at, real = time[inside], flight.pose.at(time)[inside]

    def difference(shift: float) -> Array:
        columns = simulated.position.T
        moved = np.stack([np.interp(at + shift, time, column) for column in columns], axis=-1)
        result: Array = moved - real
        return result

    plain = difference(0.0)
    shifts = np.arange(-_LAGS, _LAGS + 1e-9, 0.005)
    errors = np.array([_rms(difference(shift)) for shift in shifts])
    near = [shift for shift in shifts if abs(shift) <= _CLOCKS + 1e-9]
    best = min(near, key=lambda shift: _rms(difference(shift)))
    ideal = delayed = math.nan
    if len(flight.setpoint):
        ideal = _rms(flight.setpoint.at(at) - real)
        delayed = _rms(flight.setpoint.at(at - PURE_DELAY) - real)
    return Outcome(
        name=flight.name,
        controller=CONTROLLER_NAMES[flight.controller],
        duration=float(at[-1] - at[0]),
        rmse=_rms(plain),
        aligned=_rms(difference(best)),
        plane=_rms(plain[:, :2]),
        plane_aligned=min(_rms(difference(shift)[:, :2]) for shift in near),
        axes=tuple(float(value) for value in np.sqrt((plain**2).mean(axis=0))),
        lag=float(shifts[int(np.argmin(errors))]),
        offset=tuple(float(value) for value in plain.mean(axis=0)),
        ideal=ideal,
        delayed=delayed,
        takeoff=(
            _takeoff(flight, flight.pose.time, flight.pose.value),
            _takeoff(flight, time, simulated.position),
        ),
        sag=_sag(flight, simulated),
        strength=simulated.strength,
        calibrated=calibrated,
    )


def _rms(difference: Array) -> float:
    return float(np.sqrt((difference**2).sum(axis=1).mean()))


def _takeoff(flight: RealFlight, time: Array, position: Array) -> float:
    """s from the first command to 0.1 m above where it stood; NaN if it began or stayed there."""
    start = flight.start
    before = flight.pose.time <= start
    ground = float(np.median(flight.pose.value[before, 2])) if before.any() else position[0, 2]
    up = np.flatnonzero((time >= start) & (position[:, 2] > ground + _OFF_GROUND))
    return float(time[up[0]] - start) if len(up) and ground < 0.3 else math.nan


def _sag(flight: RealFlight, simulated: SimulatedFlight) -> tuple[float, float]:
    """V, of the real battery (NaN where not logged) and the simulated one."""
    start = flight.start
    time = simulated.time
    flown = (time > start + 3.0) & (time < start + 8.0)
    if not flown.any():
        return math.nan, math.nan
    model = float(simulated.volts[0] - simulated.volts[flown].mean())
    volts = flight.volts
    rest = volts.time < start if len(volts) else np.zeros(0, bool)
    if not rest.any():
        return math.nan, model
    real = float(np.median(volts.value[rest]) - volts.at(time[flown]).mean())
    return real, model


def medians(pairs: Sequence[Pair]) -> dict[str, dict[str, float]]:
    """Medians of the figures of each controller's flights, and how many there are."""
    result = {}
    for name in dict.fromkeys(pair.outcome.controller for pair in pairs):
        chosen = [pair.outcome for pair in pairs if pair.outcome.controller == name]

        def of(values: list[float]) -> float:
            known = [value for value in values if math.isfinite(value)]
            return float(np.median(known)) if known else math.nan

        result[name] = {
            "flights": len(chosen),
            **{
                key: of([getattr(outcome, key) for outcome in chosen])
                for key in (
                    "rmse",
                    "aligned",
                    "plane",
                    "plane_aligned",
                    "lag",
                    "ideal",
                    "delayed",
                    "strength",
                )
            },
            "takeoff_difference": of([o.takeoff[1] - o.takeoff[0] for o in chosen]),
            "sag_real": of([o.sag[0] for o in chosen]),
            "sag_simulated": of([o.sag[1] for o in chosen]),
        }
    return result


def summary(pairs: Sequence[Pair], vehicle: Vehicle, hover: str) -> dict[str, Any]:
    """Every figure as plain data, NaN as None."""

    def plain(value: Any) -> Any:
        if isinstance(value, float):
            return value if math.isfinite(value) else None
        if isinstance(value, dict):
            return {key: plain(item) for key, item in value.items()}
        if isinstance(value, list | tuple):
            return [plain(item) for item in value]
        return value

    return {
        "vehicle": vehicle.name,
        "hover": hover,
        "medians": plain(medians(pairs)),
        "flights": [plain(asdict(pair.outcome)) for pair in pairs],
    }
