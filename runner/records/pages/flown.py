"""A recorded flight as a page shows it: thinned out, with what stands around it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyarena.errors import InputError
from crazyarena.levels.schema import Level
from crazyarena.runner.records import export
from crazyarena.runner.records.bodies import bodies, distances
from crazyarena.runner.records.marks import Mark, marks
from crazyarena.runner.records.mcap_records import Records, read_records
from crazyarena.runner.records.pages.charts import thinned
from crazyarena.runner.records.pages.page import data
from crazyarena.runner.records.recorded_level import recorded_level

Array = NDArray[np.float64]

_ROWS = 2000
# Corners of a box that differ in one sign.
_EDGES = [(a, a | bit) for bit in (1, 2, 4) for a in range(8) if not a & bit]


@dataclass
class Flown:
    """time (n,) s; position, velocity, setpoint (n, 3) SI; entities of ``foxglove.SceneUpdate``."""

    time: Array
    position: Array
    velocity: Array
    setpoint: Array
    entities: list[dict[str, Any]]
    events: list[dict[str, Any]]
    metadata: dict[str, str]
    level: Level | None
    complete: bool

    @property
    def passes(self) -> list[tuple[float, str]]:
        """When which gate was passed."""
        passed = (event for event in self.events if event["event"] == "gate passed")
        return [(event["time"], event["detail"]) for event in passed]

    @property
    def gate_times(self) -> list[float]:
        return [time for time, _ in self.passes]

    @property
    def marks(self) -> list[Mark]:
        return marks(self.events)

    def margins(self) -> dict[str, Array]:
        """Distance to the nearest gate and obstacle, m, (n,) each."""
        finite = np.nan_to_num(self.position, nan=1e9, posinf=1e9, neginf=-1e9)
        found = distances(finite, self.entities)
        kinds = {}
        for kind in ("gate", "obstacle"):
            mine = [far for name, far in found.items() if name.startswith(kind)]
            if mine:
                kinds[f"nearest {kind}"] = np.min(mine, axis=0)
        return kinds


class NothingFlown(InputError):
    """A recording of an episode that was over before its first step."""


def read_flown(file: Path) -> Flown:
    """Read a recording; raises InputError if it is none, NothingFlown if it holds no flight."""
    records = read_records(file)
    recording = export.read(file, records)
    states = recording.tables.get("state")
    if states is None or not len(states):
        raise NothingFlown(f"{file}: holds no flight: no row of topic /state")
    named = {column: k for k, column in enumerate(recording.columns["state"])}
    rows = states[thinned(len(states), _ROWS)]

    def columns(name: str) -> Array:
        first = named.get(f"{name}_0")
        if first is None or first + 3 > rows.shape[1]:
            return np.full((len(rows), 3), np.nan)
        return np.array(rows[:, first : first + 3])

    if "time" not in named:
        raise InputError(f"{file}: topic /state has no field 'time'")
    time = np.array(rows[:, named["time"]])
    if not np.isfinite(time).all() or (np.diff(time) < 0.0).any():
        raise InputError(f"{file}: topic /state: its times do not rise")
    setpoint = columns("setpoint_position")
    commands, names = recording.tables.get("command"), recording.columns.get("command", [])
    if commands is not None and {"time", "sent"} <= set(names):
        sent = commands[commands[:, names.index("sent")] > 0, names.index("time")]
        began = float(sent[0]) if len(sent) else np.inf
        ended = float(commands[-1, names.index("time")]) + 0.1 if len(commands) else np.inf
        setpoint[(time < began) | (time > ended)] = np.nan
    return Flown(
        time,
        columns("position"),
        columns("velocity"),
        setpoint,
        _entities(records),
        sorted(recording.events, key=lambda event: event["time"]),
        recording.metadata,
        recorded_level(recording.metadata),
        recording.complete,
    )


def _entities(found: Records) -> list[dict[str, Any]]:
    """Those of the first scene of a recording."""
    for number, channel in found.channels.items():
        payloads = found.payloads.get(number)
        if channel.topic == "/scene" and payloads:
            try:
                entities = json.loads(payloads[0])["entities"]
            except (ValueError, TypeError, KeyError, RecursionError):
                return []
            return (
                [e for e in entities if isinstance(e, dict)] if isinstance(entities, list) else []
            )
    return []


def scene(flights: Sequence[tuple[Flown, str]]) -> str:
    """The 3-D view of flights, each in a colour of the page, around what the first flew in."""
    first = flights[0][0]
    low, high = _bounds(first)
    solids: list[dict[str, Any]] = []
    told: list[dict[str, Any]] = []
    for entity in first.entities[:200]:
        name = str(entity.get("id", ""))
        colour = "c1" if name.startswith("gate") else "c2" if name == "goal" else "c3"
        for body in bodies(entity):
            corners = np.round(body.corners(), 3)
            for a, b in _EDGES:
                solids.append({"points": corners[[a, b]].tolist(), "colour": colour})
        top = next(bodies(entity), None)
        if name.startswith("gate") and top is not None:
            label = name.removeprefix("gate ")
            told.append({"point": top.centre.tolist(), "text": label, "colour": "c1"})
    paths = []
    for flown, colour in flights:
        few = thinned(len(flown.time), 600)
        points = np.round(np.clip(flown.position[few], low - 5.0, high + 5.0), 3)
        times = np.round(flown.time[few], 3)
        paths.append({"points": points.tolist(), "time": times.tolist(), "colour": colour})
    if len(flights) == 1:
        for mark in first.marks[:20]:
            if mark.kind != "late":
                place = [float(np.interp(mark.time, first.time, axis)) for axis in first.position.T]
                told.append({"point": place, "text": mark.text, "colour": "bad", "cross": True})
    last = max(float(flown.time[-1]) for flown, _ in flights)
    content = {"low": low.tolist(), "high": high.tolist(), "solids": solids, "paths": paths,
               "marks": told}  # fmt: skip
    return (
        f'<div class="scene">{data("scene-data", content)}<canvas></canvas>'
        f'<input type="range" min="0" max="{last:.3f}" step="0.01" value="{last:.3f}" '
        'aria-label="time"><output></output></div>'
    )


def _bounds(flown: Flown) -> tuple[Array, Array]:
    if flown.level is not None:
        return np.array(flown.level.arena.low), np.array(flown.level.arena.high)
    path = flown.position[np.isfinite(flown.position).all(axis=1)]
    # What stands there is to be seen, however short the flight was.
    stands = [body.corners() for entity in flown.entities[:200] for body in bodies(entity)]
    path = np.vstack([path, *stands])
    if not len(path):
        return np.array([-1.0, -1.0, 0.0]), np.array([1.0, 1.0, 1.0])
    return np.minimum(path.min(axis=0) - 0.5, 0.0), path.max(axis=0) + 0.5
