"""Two groups of flights beside each other, as in the published sim-to-real comparison.

Flights are aligned by their own time (0 is the start of the run) and compared over the time that
all of them cover: mean path of each group, their difference, its root mean square per axis, and
the times of gates and goal.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyarena.bounded_read import read_json
from crazyarena.errors import InputError
from crazyarena.levels.schema import Level
from crazyarena.plain_text import shown_line
from crazyarena.runner.records import export
from crazyarena.runner.records.recorded_level import recorded_level

Array = NDArray[np.float64]

_STEP = 0.01  # s, of the common time line


@dataclass(frozen=True, slots=True)
class Flight:
    """One recorded flight: time (n,) s, position (n, 3) m, gate times, and how long it took.

    vehicle: model that flew, or that the real one was taken for; empty if the recording is silent.
    level: its name, likewise; course: None for one of another contract.
    """

    file: Path
    time: Array
    position: Array
    gate_times: Array
    duration: float
    termination: str
    missed: int
    vehicle: str = ""
    level: str = ""
    course: Course | None = None


@dataclass(frozen=True, slots=True)
class Course:
    """What a flight was to do: the level as recorded; true gates (n, 7), obstacles (m, 6)."""

    level: Level
    gates: Array
    obstacles: Array

    def same(self, other: Course) -> bool:
        """Whether the level has the same track, start and goal."""
        a, b = self.level, other.level
        return (a.track, a.start, a.goal) == (b.track, b.start, b.goal)


@dataclass(frozen=True, slots=True)
class Comparison:
    """Group a against group b on a common time line.

    Attributes
    ----------
    time: (n,) s. mean_a, mean_b: (n, 3) m, mean path of each group; std_a, std_b: (n, 3).
    difference: (n, 3) m, b minus a; distance: (n,) m, its length.
    """

    names: tuple[str, str]
    groups: tuple[list[Flight], list[Flight]]
    time: Array
    mean_a: Array
    mean_b: Array
    std_a: Array
    std_b: Array

    @property
    def difference(self) -> Array:
        return self.mean_b - self.mean_a

    @property
    def distance(self) -> Array:
        return np.linalg.norm(self.difference, axis=1)

    @property
    def vehicles(self) -> tuple[str, str]:
        """Vehicle models of each group, by name."""
        first, second = (
            ", ".join(sorted({flight.vehicle or "unknown" for flight in group}))
            for group in self.groups
        )
        return first, second

    def advice(self) -> str:
        """The command that would explain by the vehicle what differs."""
        a, b = self.vehicles
        runs = " ".join(dict.fromkeys(str(flight.file) for flight in self.groups[1]))
        if a != b and "unknown" not in (a, b) and "," not in b:
            return f"Other vehicles flew: crazyarena dry-run ... --vehicle {b}"
        return f"Does the vehicle explain it? crazyarena identify {runs} -o my_vehicle.yaml"

    def summary(self) -> dict[str, Any]:
        """Every figure of the table, as plain data; lengths m, times s."""
        a, b = self.groups
        duration_a = float(np.mean([f.duration for f in a]))
        duration_b = float(np.mean([f.duration for f in b]))
        gates = min(len(f.gate_times) for f in (*a, *b))
        gate_a = np.mean([f.gate_times[:gates] for f in a], axis=0)
        gate_b = np.mean([f.gate_times[:gates] for f in b], axis=0)
        return {
            "flights": [len(a), len(b)],
            "compared_time": float(self.time[-1]),
            "mean_distance": float(self.distance.mean()),
            "max_distance": float(self.distance.max()),
            "rmse": np.sqrt((self.difference**2).mean(axis=0)).tolist(),
            "mean_difference": self.difference.mean(axis=0).tolist(),
            "spread": [float(self.std_a.mean()), float(self.std_b.mean())],
            "duration": [duration_a, duration_b],
            "vehicles": list(self.vehicles),
            "duration_ratio": duration_b / duration_a if duration_a > 0 else float("nan"),
            "gate_time_difference": (gate_b - gate_a).tolist(),
            "missed_ticks": [
                float(np.mean([f.missed for f in a])),
                float(np.mean([f.missed for f in b])),
            ],
        }

    def document(self) -> dict[str, Any]:
        """What ``compare.json`` says: the summary, and which recordings were compared."""
        runs = [[str(flight.file.resolve()) for flight in group] for group in self.groups]
        return {**self.summary(), "names": list(self.names), "runs": runs}


def load(run: Path) -> list[Flight]:
    """Flights of a results folder, of a folder of such folders, or of one recording."""
    if run.is_dir() and not any(run.glob("*.mcap*")):
        folders = sorted({file.parent for file in run.rglob("*.mcap")})
        if not folders:
            raise InputError(f"{run}: no recordings in this folder or below it")
        return [flight for folder in folders for flight in load(folder)]
    return [_flight(file) for file in export.recordings(run)]


def _flight(file: Path) -> Flight:
    recording = export.read(file)
    states = recording.tables.get("state")
    if states is None or len(states) < 2:
        raise InputError(f"{file}: holds no flight")
    columns = recording.columns["state"]
    first = columns.index("position_0")
    time = states[:, columns.index("time")]
    verdicts = recording.tables.get("referee")
    duration = float(time[-1])
    if verdicts is not None and len(verdicts):
        duration = float(verdicts[-1, recording.columns["referee"].index("time")])
    flown = time <= duration
    termination = _termination(file)
    events = [e["event"] for e in recording.events]
    return Flight(
        file,
        time[flown],
        states[flown][:, first : first + 3],
        np.array([e["time"] for e in recording.events if e["event"] == "gate passed"]),
        duration,
        termination,
        events.count("deadline missed"),
        recording.metadata.get("vehicle", ""),
        recording.metadata.get("level", ""),
        _course(recording.metadata),
    )


def _course(metadata: dict[str, str]) -> Course | None:
    level = recorded_level(metadata)
    if level is None:
        return None
    try:
        gates, obstacles = (
            np.array(json.loads(metadata[name]), dtype=np.float64).reshape(-1, width)
            for name, width in (("gates", 7), ("obstacles", 6))
        )
    except (KeyError, ValueError, TypeError):
        return None
    fits = len(gates) == len(level.track.gates) and len(obstacles) == len(level.track.obstacles)
    if not (fits and np.isfinite(gates).all() and np.isfinite(obstacles).all()):
        return None
    return Course(level, gates, obstacles)


def refuse_different_levels(groups: Sequence[Sequence[Flight]]) -> None:
    """Raise InputError if not all flights flew the same course, as far as recordings tell."""
    flights = [flight for group in groups for flight in group]
    first = next((flight for flight in flights if flight.level), None)
    for flight in flights:
        if first is None or not flight.level:
            continue
        differ = flight.level != first.level
        if not differ and flight.course is not None and first.course is not None:
            differ = not flight.course.same(first.course)
        if differ:
            what = (
                f"{first.level} and {flight.level}"
                if flight.level != first.level
                else f"{flight.level} with another track, start or goal"
            )
            raise InputError(
                f"compare: different levels: {what} ({shown_line(str(first.file))}, "
                f"{shown_line(str(flight.file))}). To compare them all the same: "
                "--different-levels"
            )


def _termination(file: Path) -> str:
    """How the flight of a recording ended, by the ``result.json`` beside it; empty if untold."""
    result = file.parent / "result.json"
    if not result.is_file():
        return ""
    document = read_json(result, "result")
    episodes = document.get("episodes") if isinstance(document, dict) else None
    if not isinstance(episodes, list):
        raise InputError(f"{result}: field episodes: need a list")
    for index, episode in enumerate(episodes):
        try:
            if episode["files"].get("recording") == file.name:
                return shown_line(str(episode["termination"]))
        except (KeyError, TypeError, AttributeError) as error:
            reason = shown_line(f"{type(error).__name__}: {error}")
            raise InputError(f"{result}: episodes[{index}]: {reason}") from None
    return ""


def compare(
    a: Sequence[Path],
    b: Sequence[Path],
    names: tuple[str, str] = ("a", "b"),
    different_levels: bool = False,
) -> Comparison:
    """Compare the flights of two groups of runs.

    Raises
    ------
    InputError: a group holds no flights, or they flew ``different_levels`` and may not.
    """
    groups = tuple([flight for run in group for flight in load(run)] for group in (a, b))
    for name, flights in zip(names, groups, strict=True):
        if not flights:
            raise InputError(f"compare: no flights in group {name}")
    if not different_levels:
        refuse_different_levels(groups)
    begin = max(float(f.time[0]) for group in groups for f in group)
    end = min(float(f.time[-1]) for group in groups for f in group)
    if end - begin < _STEP:
        raise InputError("compare: the flights have no time in common")
    time = np.arange(begin, end, _STEP)
    paths = [np.stack([_resampled(f, time) for f in group]) for group in groups]
    return Comparison(
        names,
        (groups[0], groups[1]),
        time,
        paths[0].mean(axis=0),
        paths[1].mean(axis=0),
        paths[0].std(axis=0),
        paths[1].std(axis=0),
    )


def _resampled(flight: Flight, time: Array) -> Array:
    return np.stack([np.interp(time, flight.time, axis) for axis in flight.position.T], axis=1)


def table(comparison: Comparison) -> Any:
    """Rich table of :meth:`Comparison.summary`."""
    from rich import box
    from rich.markup import escape
    from rich.table import Table

    s = comparison.summary()
    s["vehicles"] = list(map(escape, s["vehicles"]))
    a, b = map(escape, comparison.names)
    shown = Table(box=box.SIMPLE, header_style="bold", show_header=True, pad_edge=False)
    shown.add_column(f"{b} against {a}")
    shown.add_column("", justify="right")
    rows = [
        ("flights", f"{s['flights'][1]} / {s['flights'][0]}"),
        (f"vehicle of {a}, {b}", " / ".join(s["vehicles"])),
        ("time compared", f"{s['compared_time']:.2f} s"),
        ("mean distance of the mean paths", f"{100 * s['mean_distance']:.2f} cm"),
        ("largest", f"{100 * s['max_distance']:.2f} cm"),
        ("RMSE x, y, z", ", ".join(f"{100 * v:.2f}" for v in s["rmse"]) + " cm"),
        ("mean difference x, y, z", ", ".join(f"{100 * v:+.2f}" for v in s["mean_difference"])
         + " cm"),
        (f"spread of {a}, {b}", ", ".join(f"{100 * v:.2f}" for v in s["spread"]) + " cm"),
        (f"duration of {a}, {b}", ", ".join(f"{v:.3f}" for v in s["duration"]) + " s"),
        ("duration", f"{100 * (s['duration_ratio'] - 1):+.2f} %"),
        ("gate times", ", ".join(f"{1e3 * v:+.0f}" for v in s["gate_time_difference"]) + " ms"),
        (f"missed ticks of {a}, {b}", ", ".join(f"{v:.1f}" for v in s["missed_ticks"])),
    ]  # fmt: skip
    for row in rows:
        shown.add_row(*row)
    return shown
