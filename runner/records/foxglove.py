"""Recordings in Foxglove's own message types, for viewers that understand those and MCAP.

Recordings themselves keep their bytes; this is a copy of one with every message as JSON, see
https://docs.foxglove.dev/docs/visualization/message-schemas and ``docs/foxglove_layout.json``.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyarena.errors import InputError
from crazyarena.levels.schema import Level
from crazyarena.runner.records import export, mcap_file
from crazyarena.runner.records.bodies import distances
from crazyarena.runner.records.foxglove_schemas import NUMBERS, SCHEMAS
from crazyarena.runner.records.marks import marks
from crazyarena.runner.records.mcap_records import Records, read_records
from crazyarena.runner.records.recorded_level import recorded_level
from crazyarena.runner.records.scene import _box, _cylinder, _entity, _vector
from crazyarena.runner.records.shown_scene import nominal_track
from crazyarena.whole_file import whole_file

Array = NDArray[np.float64]

WORLD, DRONE = "map", "drone"
_RATE = 100.0  # Hz, of poses
_PATH = 2000  # points
_INFO, _WARNING, _ERROR = 2, 3, 4
_LEVELS = {"late": _WARNING, "violation": _WARNING, "contact": _ERROR, "safety": _ERROR}

TOPICS = {
    "/tf": "foxglove.FrameTransform",
    "/drone/pose": "foxglove.PoseInFrame",
    "/drone/setpoint": "foxglove.PoseInFrame",
    "/drone/model": "foxglove.SceneUpdate",
    "/drone/path": "foxglove.SceneUpdate",
    "/drone/numbers": NUMBERS,
    "/track": "foxglove.SceneUpdate",
    "/arena": "foxglove.SceneUpdate",
    "/events": "foxglove.Log",
}

_Message = tuple[int, str, dict[str, Any]]


def write_foxglove(file: Path, out: Path) -> Path:
    """Write a recording's flight to ``out``; returns it.

    Raises
    ------
    InputError: the recording holds no flight. StorageError: the disk refuses.
    """
    found = sorted(_messages(file), key=lambda each: each[0])
    channels = [
        mcap_file.Channel(number, topic, "json", name, "jsonschema", json.dumps(SCHEMAS[name]))
        for number, (topic, name) in enumerate(TOPICS.items(), 1)
    ]
    numbers = {channel.topic: channel.id for channel in channels}
    counts = dict.fromkeys(numbers, 0)
    batches = []
    for time, topic, content in found:
        words = json.dumps(content, allow_nan=False, separators=(",", ":")).encode()
        batches.append(mcap_file.message(numbers[topic], counts[topic], time, words))
        counts[topic] += 1
    with whole_file(out) as stream:
        writer = mcap_file.McapWriter(stream, channels)
        for first in range(0, len(batches), 2000):
            writer.chunk(batches[first : first + 2000])
        writer.finish()
    return out


def _messages(file: Path) -> Iterator[_Message]:
    records = read_records(file)
    recording = export.read(file, records)
    states = recording.tables.get("state")
    if states is None or not len(states):
        raise InputError(f"{file}: holds no flight: no row of topic /state")
    named = {column: k for k, column in enumerate(recording.columns["state"])}
    try:
        time = states[:, named["time"]]
        position = states[:, named["position_0"] : named["position_0"] + 3]
        turn = states[:, named["orientation_0"] : named["orientation_0"] + 4]
        velocity = states[:, named["velocity_0"] : named["velocity_0"] + 3]
    except KeyError as error:
        raise InputError(f"{file}: topic /state has no field {error}") from None
    sound = np.isfinite(np.column_stack([time, position, turn, velocity])).all(axis=1)
    sound &= (time >= 0.0) & (time < 1e6)
    rows = np.flatnonzero(sound)
    if not len(rows):
        raise InputError(f"{file}: topic /state: no row is finite")
    # One row of each hundredth of a second, and the last.
    slots = np.floor(time[rows] * _RATE + 1e-6)
    kept = rows[np.unique(np.append(np.flatnonzero(np.diff(slots, prepend=-1.0)), len(rows) - 1))]
    scenes = list(_scenes(records))
    yield from scenes
    began = float(time[kept[0]])
    level = recorded_level(recording.metadata)
    if level is not None:
        yield 0, "/arena", _update(_fence(level), *nominal_track(level))
    yield _ns(began), "/drone/model", _update(_drone(began))
    yield _ns(began), "/drone/path", _update(_path(position[kept], began))
    track: list[dict[str, Any]] = next((m[2]["entities"] for m in scenes), [])
    yield from _flight(time[kept], position[kept], turn[kept], velocity[kept], track)
    yield from _setpoints(recording, time[kept], states[kept], named)
    yield from _log(recording.events)


def _flight(
    time: Array, place: Array, turn: Array, velocity: Array, track: list[dict[str, Any]]
) -> Iterator[_Message]:
    speed = np.linalg.norm(velocity, axis=1)
    far = distances(place, track)
    nearest = np.min(list(far.values()), axis=0) if far else None
    for i, when in enumerate(time.tolist()):
        stamp, at = _stamp(when), _ns(when)
        spot, way = _vector(*place[i]), dict(zip("xyzw", turn[i].tolist(), strict=True))
        yield at, "/tf", {
            "timestamp": stamp, "parent_frame_id": WORLD, "child_frame_id": DRONE,
            "translation": spot, "rotation": way,
        }  # fmt: skip
        pose = {"position": spot, "orientation": way}
        yield at, "/drone/pose", {"timestamp": stamp, "frame_id": WORLD, "pose": pose}
        numbers = {"timestamp": stamp, "speed": float(speed[i])}
        if nearest is not None:
            numbers["nearest"] = float(nearest[i])
        yield at, "/drone/numbers", numbers


def _setpoints(
    recording: export.Recording, time: Array, states: Array, named: dict[str, int]
) -> Iterator[_Message]:
    """What was commanded, from the first command to the end of the run."""
    first = named.get("setpoint_position_0")
    commands, names = recording.tables.get("command"), recording.columns.get("command", [])
    if first is None or commands is None or not {"time", "sent"} <= set(names):
        return
    sent = commands[commands[:, names.index("sent")] > 0, names.index("time")]
    if not len(sent):
        return
    ended = commands[-1, names.index("time")] + 0.1
    for i in np.flatnonzero((time >= sent[0]) & (time <= ended)):
        spot, yaw = states[i, first : first + 3], 0.0
        if (turned := named.get("setpoint_yaw")) is not None:
            yaw = float(states[i, turned])
        if np.isfinite([*spot, yaw]).all():
            way = {"x": 0.0, "y": 0.0, "z": math.sin(yaw / 2), "w": math.cos(yaw / 2)}
            pose = {"position": _vector(*spot), "orientation": way}
            content = {"timestamp": _stamp(time[i]), "frame_id": WORLD, "pose": pose}
            yield _ns(time[i]), "/drone/setpoint", content


def _log(events: list[dict[str, Any]]) -> Iterator[_Message]:
    for event in events:
        when = float(event["time"])
        if not 0.0 <= when < 1e6:
            continue
        found = marks([event])
        level = _LEVELS[found[0].kind] if found else _INFO
        told = f"{event['event']}: {event['detail']}" if event["detail"] else event["event"]
        yield _ns(when), "/events", {
            "timestamp": _stamp(when), "level": level, "message": told, "name": "crazyarena",
            "file": "", "line": 0,
        }  # fmt: skip


def _scenes(found: Records) -> Iterator[_Message]:
    """The updates of the track, as they were recorded."""
    for number, channel in found.channels.items():
        if channel.topic != "/scene":
            continue
        for payload in found.payloads.get(number, []):
            try:
                content = json.loads(payload)
                entities = [e for e in content["entities"] if isinstance(e, dict)]
                stamp = entities[0]["timestamp"] if entities else {"sec": 0, "nsec": 0}
                at = int(stamp["sec"]) * 10**9 + int(stamp["nsec"])
                words = json.dumps(content, allow_nan=False)
            except (ValueError, TypeError, KeyError, IndexError, RecursionError, OverflowError):
                continue  # of another program
            if 0 <= at < 2**62 and words:
                yield at, "/track", {"deletions": [], "entities": entities}


def _update(*entities: dict[str, Any]) -> dict[str, Any]:
    return {"deletions": [], "entities": list(entities)}


def _line(points: list[dict[str, float]], colour: dict[str, float], kind: int) -> dict[str, Any]:
    """kind: 0 a strip of lines, 2 a list of pairs."""
    rest = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
    return {
        "type": kind, "pose": {"position": _vector(0, 0, 0), "orientation": rest},
        "thickness": 2.0, "scale_invariant": True, "points": points, "color": colour,
        "colors": [], "indices": [],
    }  # fmt: skip


def _path(position: Array, began: float) -> dict[str, Any]:
    few = np.unique(np.linspace(0, len(position) - 1, _PATH).astype(int))
    entity = _entity("path")
    entity["timestamp"] = _stamp(began)
    red = {"r": 0.85, "g": 0.15, "b": 0.15, "a": 1.0}
    entity["lines"] = [_line([_vector(*position[i]) for i in few], red, 0)]
    return entity


def _fence(level: Level) -> dict[str, Any]:
    """Edges of the outer limits."""
    low, high = level.arena.low, level.arena.high
    corners = [[(high if k >> axis & 1 else low)[axis] for axis in range(3)] for k in range(8)]
    pairs = [(a, a | bit) for bit in (1, 2, 4) for a in range(8) if not a & bit]
    points = [_vector(*corners[end]) for pair in pairs for end in pair]
    entity = _entity("fence")
    entity["lines"] = [_line(points, {"r": 0.2, "g": 0.7, "b": 0.3, "a": 0.8}, 2)]
    return entity


def _drone(began: float) -> dict[str, Any]:
    """A Crazyflie's outline in its own frame: a body, four arms, four rotors; front is red."""
    dark = {"r": 0.15, "g": 0.15, "b": 0.18, "a": 1.0}
    rest = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
    cubes = [_box({"position": _vector(0, 0, 0), "orientation": rest}, (0.03, 0.03, 0.015), dark)]
    rotors = []
    for x, y in ((1, 1), (-1, 1), (-1, -1), (1, -1)):
        half = math.atan2(y, x) / 2
        turned = {"x": 0.0, "y": 0.0, "z": math.sin(half), "w": math.cos(half)}
        middle = {"position": _vector(0.016 * x, 0.016 * y, 0), "orientation": turned}
        cubes.append(_box(middle, (0.05, 0.006, 0.004), dark))
        end = {"position": _vector(0.0325 * x, 0.0325 * y, 0.008), "orientation": rest}
        red = 0.9 if x > 0 else 0.3
        rotors.append(_cylinder(end, 0.0225, 0.003, {"r": red, "g": 0.3, "b": 0.3, "a": 0.8}))
    entity = _entity("drone", cubes=cubes, cylinders=rotors)
    return {**entity, "timestamp": _stamp(began), "frame_id": DRONE, "frame_locked": True}


def _ns(time: float) -> int:
    return round(float(time) * 1e9)


def _stamp(time: float) -> dict[str, int]:
    seconds, rest = divmod(_ns(time), 10**9)
    return {"sec": seconds, "nsec": rest}
