"""Recordings to tables: the numeric topics of an MCAP file as arrays, CSV or NPZ."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from crazyarena.errors import InputError
from crazyarena.plain_text import file_name, shown, shown_in, shown_line
from crazyarena.whole_file import write_whole

if TYPE_CHECKING:
    from crazyarena.runner.records.mcap_records import Records

_FIELD = re.compile(r"^float64(?:\[(\d{1,6})\])?\s+(\w+)$", re.ASCII)
_MOST_COLUMNS = 10_000
FOXGLOVE = ".foxglove.mcap"
"""How copies for viewers are named, which are no recordings."""


@dataclass
class Recording:
    """What one file holds.

    Attributes
    ----------
    tables: rows (n, m) float64 by topic (``state``, ``command``, ``referee``).
    columns: names of the m columns, by topic; arrays as ``position_0`` ...
    events: dictionaries with time, tick, event, detail.
    metadata: strings by name, from the record ``crazyarena``.
    complete: False for the remains of a flight whose process died.
    """

    tables: dict[str, NDArray[np.float64]]
    columns: dict[str, list[str]]
    events: list[dict[str, Any]]
    metadata: dict[str, str]
    complete: bool


def _columns(schema: bytes, where: str) -> list[str]:
    try:
        text = schema.decode()
    except UnicodeDecodeError as error:
        raise InputError(f"{where}: schema: byte {error.start} is not UTF-8 text") from None
    names: list[str] = []
    for line in text.splitlines():
        match = _FIELD.match(line.strip())
        if match:
            size, name = match.groups()
            if len(names) + int(size or 1) > _MOST_COLUMNS:
                raise InputError(f"{where}: schema: more than {_MOST_COLUMNS} columns")
            names += [name] if size is None else [f"{name}_{i}" for i in range(int(size))]
    return names


def recordings(run: Path) -> list[Path]:
    """Recordings of a results folder (or the file itself), sorted; raises InputError if none."""
    if run.is_file():
        return [run]
    if not run.exists():
        raise InputError(f"{run}: no such file or folder. Pass a results folder or an .mcap file")
    whole = {file for file in run.glob("*.mcap") if not file.name.endswith(FOXGLOVE)}
    # A process killed between finishing the one and removing the other leaves both.
    parts = {part for part in run.glob("*.mcap.part") if part.with_suffix("") not in whole}
    files = sorted(whole | parts)
    if not files:
        raise InputError(f"{run}: no .mcap recording in this folder (flown with --no-record?)")
    return files


def read(file: Path, records: Records | None = None) -> Recording:
    """Read a recording, finished or cut short; ``records``: what it holds, if that is read.

    Raises
    ------
    InputError: it is none, holds what no recording of ours holds, or unpacks to more than one
        can; with the place.
    """
    from crazyarena.runner.records.mcap_records import read_records

    found = read_records(file) if records is None else records
    tables: dict[str, NDArray[np.float64]] = {}
    columns: dict[str, list[str]] = {}
    events: list[dict[str, Any]] = []
    for number, channel in found.channels.items():
        topic = shown_line(channel.topic.strip("/"))
        schema = found.schemas.get(channel.schema_id)
        messages = found.payloads.get(number, [])
        if topic == "event":
            events = [
                _event(data, f"{file}: topic /event: message {i}")
                for i, data in enumerate(messages)
            ]
        elif schema is None and channel.schema_id == 0:
            continue  # of another program
        elif schema is None:
            raise InputError(f"{file}: topic /{topic}: its schema {channel.schema_id} is missing")
        elif channel.message_encoding == "cdr" and schema.name.startswith("crazyarena/"):
            names = _columns(schema.data, f"{file}: topic /{topic}")
            tables[topic] = _table(messages, len(names), f"{file}: topic /{topic}")
            columns[topic] = names
    return Recording(tables, columns, events, found.metadata, found.complete)


def _event(data: bytes, where: str) -> dict[str, Any]:
    try:
        fields = json.loads(data)
        return {
            **{name: shown_in(value) for name, value in fields.items()},
            "time": float(fields["time"]),
            "tick": int(fields["tick"]),
            "event": shown_line(str(fields["event"])),
            "detail": shown(str(fields["detail"])),
        }
    except (
        ValueError,
        TypeError,
        KeyError,
        AttributeError,
        OverflowError,
        RecursionError,
    ) as error:
        reason = shown_line(f"{type(error).__name__}: {error}")
        raise InputError(f"{where}: no event of a recording: {reason}") from None


def _table(messages: list[bytes], width: int, where: str) -> NDArray[np.float64]:
    for index, data in enumerate(messages):
        if len(data) != 4 + 8 * width:
            raise InputError(
                f"{where}: message {index} has {len(data)} bytes; its schema says {4 + 8 * width}"
            )
    raw = b"".join(data[4:] for data in messages)
    return np.frombuffer(raw, "<f8").reshape(len(messages), width)


def write_csv(recording: Recording, stem: Path) -> list[Path]:
    """One file a topic that has rows, ``<stem>_<topic>.csv``; returns the files."""
    written = []
    for topic, table in recording.tables.items():
        if not len(table):
            continue
        file = stem.with_name(f"{stem.name}_{file_name(topic)}.csv")
        header = ",".join(recording.columns[topic])
        np.savetxt(file, table, fmt="%.17g", delimiter=",", header=header, comments="")
        written.append(file)
    file = stem.with_name(f"{stem.name}_event.csv")
    lines = ["time,tick,event,detail"]
    for e in recording.events:
        detail = str(e["detail"]).replace('"', '""')
        lines.append(f'{e["time"]!r},{e["tick"]},{e["event"]},"{detail}"')
    write_whole(file, "\n".join(lines) + "\n")
    return [*written, file]


def write_npz(recording: Recording, stem: Path) -> list[Path]:
    """``<stem>.npz`` with arrays ``<topic>``, ``<topic>_columns``, events and metadata."""
    file = stem.with_name(f"{stem.name}.npz")
    arrays: dict[str, Any] = {file_name(t): table for t, table in recording.tables.items()}
    arrays |= {f"{file_name(t)}_columns": np.array(n) for t, n in recording.columns.items()}
    arrays["events_json"] = np.array(json.dumps(recording.events))
    arrays["metadata_json"] = np.array(json.dumps(recording.metadata))
    np.savez_compressed(file, **arrays)
    return [file]
