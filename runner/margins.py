"""How far vehicle, cameras and link may be from nominal until a submission fails.

What ``crazyarena dry-run --margins`` does: one number at a time is worsened until the flight is
no longer completed, and rotor lag and drag are varied together. Nothing else differs between the
flights: one draw of the level, one vehicle, one seed of the noise.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rich.console import Console

from crazyarena.errors import InputError
from crazyarena.levels import load_level
from crazyarena.levels.schema import Profile
from crazyarena.mocap.camera_model import CameraModel
from crazyarena.runner.dry_run import DryRun
from crazyarena.runner.trial.options import FlightOptions
from crazyarena.sim_backend.vehicles import Vehicle, VehicleChoice

LAGS = (0.03, 0.05, 0.06, 0.08, 0.10, 0.12)  # s
DRAGS = (0.5, 1.0, 1.5)  # times the vehicle's
COMPUTE = "fixed=2"  # ms a step, unless somebody asks for something else: figures must repeat
_STEPS = 5  # of a bisection


@dataclass(frozen=True, slots=True)
class Conditions:
    """What differs from nominal.

    lag: of the rotors, s (None: the vehicle's); drag, strength: times the vehicle's; latency: of
    the cameras, s; noise: of their positions, m (None: theirs).
    """

    lag: float | None = None
    drag: float = 1.0
    strength: float = 1.0
    latency: float | None = None
    noise: float | None = None

    def overrides(self, vehicle: Vehicle) -> list[str]:
        """Fields of the vehicle, as ``--vehicle-set`` takes them."""
        told = []
        if self.lag is not None:
            told += [f"rotors.lag_up={self.lag:g}", f"rotors.lag_down={self.lag:g}"]
        for name, factor, values in (
            ("body.drag", self.drag, vehicle.body.drag.value),
            ("rotors.strength", self.strength, vehicle.rotors.strength.value),
        ):
            if factor != 1.0:
                told.append(f"{name}={[factor * value for value in values]}")
        return told

    def cameras(self) -> CameraModel | None:
        """The camera system, None for the usual one."""
        if self.latency is None and self.noise is None:
            return None
        usual = CameraModel()
        return CameraModel(
            latency=usual.latency if self.latency is None else self.latency,
            position_noise=usual.position_noise if self.noise is None else self.noise,
        )


@dataclass(frozen=True, slots=True)
class Axis:
    """A number that is worsened from ``nominal`` to ``worst``; ``set`` puts it into conditions."""

    name: str
    nominal: float
    worst: float
    unit: str
    scale: float
    set: Callable[[float], Conditions]


@dataclass(frozen=True, slots=True)
class Margin:
    """The last value along an axis that was completed, and how it ends a little further on;
    ``end`` None: even the worst one was completed."""

    axis: Axis
    value: float
    end: str | None


@dataclass
class Margins:
    """Outcome: how the nominal flight ended, margins, verdicts by (lag, drag), whether it was
    completed and, if not, why."""

    nominal: str
    margins: list[Margin]
    verdicts: dict[tuple[float, float], str]
    completed: bool
    why: str = ""

    def summary(self) -> dict[str, Any]:
        """As plain data, SI."""
        return {
            "nominal": self.nominal,
            "margins": {
                m.axis.name: {"nominal": m.axis.nominal, "largest": m.value, "beyond": m.end}
                for m in self.margins
            },
            "verdicts": [
                {"lag": lag, "drag": drag, "termination": end}
                for (lag, drag), end in self.verdicts.items()
            ],
        }


def axes(vehicle: Vehicle) -> list[Axis]:
    """What is worsened, from what a vehicle has."""
    cameras = CameraModel()
    lag = max(vehicle.rotors.lag_up.value, vehicle.rotors.lag_down.value)
    return [
        Axis("rotor lag", lag, 0.3, "ms", 1e3, lambda v: Conditions(lag=v)),
        Axis("drag", 1.0, 5.0, "x", 1.0, lambda v: Conditions(drag=v)),
        Axis("weakness", 0.0, 0.5, "%", 100.0, lambda v: Conditions(strength=1.0 - v)),
        Axis("camera latency", cameras.latency, 0.09, "ms", 1e3, lambda v: Conditions(latency=v)),
        Axis(
            "camera noise", cameras.position_noise, 0.05, "mm", 1e3, lambda v: Conditions(noise=v)
        ),
    ]


def largest(
    end_of: Callable[[float], str | None], nominal: float, worst: float
) -> tuple[float, str | None]:
    """Last value from ``nominal``, which completes (None), towards ``worst`` that completes, by
    bisection; and how the first one ends that does not, None if even the worst completes."""
    end = end_of(worst)
    if end is None:
        return worst, None
    good, bad = nominal, worst
    for _ in range(_STEPS):
        middle = 0.5 * (good + bad)
        ended = end_of(middle)
        if ended is None:
            good = middle
        else:
            bad, end = middle, ended
    return good, end


class MarginRun:
    """One call of the command; arguments as :class:`~crazyarena.runner.dry_run.DryRun`.

    Raises
    ------
    InputError: the level has no vehicle model.
    """

    def __init__(
        self,
        submission: Path | None,
        level: str,
        *,
        overrides: Sequence[str] = (),
        seed: int | None = None,
        options: FlightOptions | None = None,
        vehicle: VehicleChoice | None = None,
        say: Callable[[str], None] = lambda text: None,
    ) -> None:
        if load_level(level, overrides).profile is not Profile.ARENA:
            raise InputError(
                f"--margins: level {level} runs in the competition's simulation, which has no "
                "vehicle to vary. Add --set profile=arena"
            )
        options = options or FlightOptions()
        if options.compute is None:
            options = replace(options, compute=COMPUTE)
        self._submission, self._level = submission, level
        self._choice = vehicle or VehicleChoice()
        self._common: dict[str, Any] = {
            "overrides": overrides,
            "episodes": 1,
            "seed": seed,
            "record": False,
            "figure": False,
            "console": Console(quiet=True),
            "options": options,
            "spread": False,
        }
        self._say = say
        self._why = ""

    def run(self) -> Margins:
        """Fly everything; margins are empty if the nominal flight is not completed."""
        vehicle = self._dry(Conditions(), ()).model
        assert vehicle is not None
        nominal = self._end(Conditions(), vehicle)
        result = Margins(nominal or "completed", [], {}, nominal is None, self._why)
        if nominal is None:
            for axis in axes(vehicle):
                self._say(f"margins: {axis.name}")
                value, end = largest(
                    lambda v, axis=axis: self._end(axis.set(v), vehicle),  # type: ignore[misc]
                    axis.nominal,
                    axis.worst,
                )
                result.margins.append(Margin(axis, value, end))
        for lag in LAGS:
            self._say(f"margins: rotor lag {lag:g} s")
            for drag in DRAGS:
                end = self._end(Conditions(lag=lag, drag=drag), vehicle)
                result.verdicts[lag, drag] = end or "completed"
        return result

    def _dry(self, conditions: Conditions, more: Sequence[str], out: Path | None = None) -> DryRun:
        choice = replace(self._choice, overrides=(*self._choice.overrides, *more))
        return DryRun(
            self._submission,
            self._level,
            out=out,
            vehicle=choice,
            cameras=conditions.cameras(),
            **self._common,
        )

    def _end(self, conditions: Conditions, vehicle: Vehicle) -> str | None:
        """How a flight ended; None if it was completed and clean."""
        with tempfile.TemporaryDirectory(prefix="crazyarena-margins-") as folder:
            run = self._dry(conditions, conditions.overrides(vehicle), Path(folder))
            result = run.run()
        self._why = "" if result.clean else result.episodes[0].why
        return None if result.clean else result.episodes[0].termination.lower()


def tables(result: Margins) -> list[Any]:
    """Rich tables of the margins and of the verdicts."""
    from rich import box
    from rich.table import Table

    shown = []
    if result.margins:
        table = Table("largest", "", "nominal", "beyond", box=box.SIMPLE, pad_edge=False)
        for m in result.margins:
            more = "> " if m.end is None else ""
            scale, unit = m.axis.scale, m.axis.unit
            table.add_row(
                m.axis.name,
                f"{more}{scale * m.value:.3g} {unit}",
                f"{scale * m.axis.nominal:.3g} {unit}",
                "not tried" if m.end is None else m.end,
            )
        shown.append(table)
    table = Table("rotor lag", *(f"drag x {drag:g}" for drag in DRAGS), box=box.SIMPLE)
    for lag in LAGS:
        table.add_row(f"{lag:.2f} s", *(result.verdicts[lag, drag] for drag in DRAGS))
    return [*shown, table]
