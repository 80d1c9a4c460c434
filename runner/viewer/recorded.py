"""Recorded flights as a replay shows them."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyarena.errors import InputError
from crazyarena.runner.records import export
from crazyarena.runner.records.mcap_records import Records, read_records
from crazyarena.runner.records.recorded_level import recorded_level
from crazyarena.runner.records.shown_scene import arena_data, nominal_track
from crazyarena.safety.fence import Fence

Array = NDArray[np.float64]

MOST_FLIGHTS = 100
_MOST_UPDATES = 20_000


@dataclass
class Flight:
    """One flight.

    Attributes
    ----------
    name: for people. complete: False for the remains of one whose process died.
    time: (n,) s, rising; position (n, 3) m, quaternion (n, 4) x, y, z, w, velocity (n, 3) m/s,
        setpoint (n, 3) m or NaN.
    scene: what stands still (docs/viewer.md). updates: (time s, entities) of what changes.
    told_time: (m,) s; told: (m, 2) next gate (-1 when all are passed), and whether its exact pose
        is told.
    events: dictionaries with time, event, detail, by time.
    """

    name: str
    file: Path
    complete: bool
    time: Array
    position: Array
    quaternion: Array
    velocity: Array
    setpoint: Array
    scene: dict[str, Any]
    updates: list[tuple[float, list[Any]]] = field(default_factory=list)
    told_time: Array = field(default_factory=lambda: np.empty(0))
    told: Array = field(default_factory=lambda: np.empty((0, 2)))
    events: list[dict[str, Any]] = field(default_factory=list)
    fence: Fence | None = None

    @property
    def speed(self) -> Array:
        """(n,) m/s."""
        return np.linalg.norm(self.velocity, axis=1)


def flights(runs: list[Path]) -> list[Flight]:
    """Every recording of results folders, of folders of those, or named itself.

    Raises
    ------
    InputError: there is none, one cannot be read, or there are more than :data:`MOST_FLIGHTS`.
    """
    files: list[Path] = []
    for run in runs:
        if run.is_dir() and not any(run.glob("*.mcap*")):
            inner = sorted({file.parent for file in run.rglob("*.mcap*")})
            if not inner:
                raise InputError(f"{run}: no recordings in this folder or below it")
            for folder in inner:
                files += export.recordings(folder)
        else:
            files += export.recordings(run)
    files = list(dict.fromkeys(files))
    if len(files) > MOST_FLIGHTS:
        raise InputError(
            f"replay: {len(files)} recordings; at most {MOST_FLIGHTS} are shown beside each other. "
            "Name some of them"
        )
    return [read_flight(file, name) for file, name in zip(files, _names(files), strict=True)]


def _names(files: list[Path]) -> list[str]:
    """Short names that differ."""
    stems = [file.name.partition(".")[0] for file in files]
    if len(set(stems)) == len(stems):
        return stems
    return [f"{file.resolve().parent.name}/{stem}" for file, stem in zip(files, stems, strict=True)]


def read_flight(file: Path, name: str | None = None) -> Flight:
    """Read a recording, finished or cut short; raises InputError if it holds no flight."""
    records = read_records(file)
    recording = export.read(file, records)
    states = recording.tables.get("state")
    if states is None or not len(states):
        raise InputError(f"{file}: holds no flight: no row of topic /state")
    columns = {column: k for k, column in enumerate(recording.columns["state"])}
    time = _column(states, columns, "time", 1, file)[:, 0]
    if not (np.isfinite(time).all() and (np.diff(time) >= 0.0).all()):
        raise InputError(f"{file}: topic /state: its times do not rise")
    level = recorded_level(recording.metadata)
    updates = _updates(records)
    scene: dict[str, Any] = {
        "title": recording.metadata.get("level", ""),
        "track": updates[0][1] if updates and updates[0][0] <= time[0] else [],
    }
    fence = None
    if level is not None:
        scene |= {"nominal": nominal_track(level), "arena": arena_data(level.arena)}
        try:
            fence = Fence.from_level(level)
        except InputError:
            fence = Fence.from_arena(level.arena)
    verdicts = recording.tables.get("referee", np.empty((0, 0)))
    told_time, told = np.empty(0), np.empty((0, 2))
    if len(verdicts):
        named = {column: k for k, column in enumerate(recording.columns["referee"])}
        if {"time", "target_gate", "in_range"} <= set(named):
            told_time = verdicts[:, named["time"]]
            told = verdicts[:, [named["target_gate"], named["in_range"]]]
    setpoint = np.full((len(time), 3), np.nan)
    if "setpoint_position_2" in columns:
        setpoint = _column(states, columns, "setpoint_position", 3, file)
    return Flight(
        name or file.name.partition(".")[0],
        file,
        recording.complete,
        time,
        _column(states, columns, "position", 3, file),
        _column(states, columns, "orientation", 4, file),
        _column(states, columns, "velocity", 3, file),
        setpoint,
        scene,
        updates[1:] if scene["track"] else updates,
        told_time,
        told,
        sorted(recording.events, key=lambda event: event["time"]),
        fence,
    )


def _column(rows: Array, columns: dict[str, int], name: str, size: int, file: Path) -> Array:
    first = columns.get(name if size == 1 else f"{name}_0")
    if first is None or first + size > rows.shape[1]:
        raise InputError(f"{file}: topic /state has no field {name!r} of {size} numbers")
    return rows[:, first : first + size]


def _updates(records: Records) -> list[tuple[float, list[Any]]]:
    """Entities by the time they are of, s."""
    found: list[tuple[float, list[Any]]] = []
    for number, channel in records.channels.items():
        if channel.topic != "/scene":
            continue
        for data in records.payloads.get(number, [])[:_MOST_UPDATES]:
            try:
                entities = json.loads(data)["entities"]
                stamp = entities[0]["timestamp"] if entities else {"sec": 0, "nsec": 0}
                found.append((float(stamp["sec"]) + 1e-9 * float(stamp["nsec"]), entities))
            except (ValueError, TypeError, KeyError, IndexError, RecursionError, OverflowError):
                continue
    return sorted(found, key=lambda update: update[0])
