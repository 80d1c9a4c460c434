"""Recordings to tables: the numeric topics of an MCAP file as arrays, CSV or NPZ."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyarena.errors import InputError
from crazyarena.mcap_reading import LARGEST, chunk_records

_FIELD = re.compile(r"^float64(?:\[(\d+)\])?\s+(\w+)$")


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


def _columns(schema: str) -> list[str]:
    names: list[str] = []
    for line in schema.splitlines():
        match = _FIELD.match(line.strip())
        if match:
            size, name = match.groups()
            names += [name] if size is None else [f"{name}_{i}" for i in range(int(size))]
    return names


def recordings(run: Path) -> list[Path]:
    """Recordings of a results folder (or the file itself), sorted; raises InputError if none."""
    if run.is_file():
        return [run]
    if not run.exists():
        raise InputError(f"{run}: no such file or folder. Pass a results folder or an .mcap file")
    files = sorted([*run.glob("*.mcap"), *run.glob("*.mcap.part")])
    if not files:
        raise InputError(f"{run}: no .mcap recording in this folder (flown with --no-record?)")
    return files


def read(file: Path) -> Recording:
    """Read a recording, finished or cut short; raises InputError if it is none."""
    from mcap.exceptions import McapError
    from mcap.records import Channel, Chunk, DataEnd, Message, Metadata, Schema
    from mcap.stream_reader import StreamReader

    schemas: dict[int, Any] = {}
    channels: dict[int, Any] = {}
    payloads: dict[int, list[bytes]] = {}
    metadata: dict[str, str] = {}
    complete = False

    def take(records: Iterable[Any]) -> None:
        nonlocal complete
        for record in records:
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Message):
                payloads.setdefault(record.channel_id, []).append(record.data)
            elif isinstance(record, Chunk):
                take(chunk_records(record))
            elif isinstance(record, Metadata) and record.name == "crazyarena":
                metadata.update(record.metadata)
            elif isinstance(record, DataEnd):
                complete = True
                return

    with open(file, "rb") as stream:
        try:
            take(StreamReader(stream, emit_chunks=True, record_size_limit=LARGEST).records)
        except McapError as error:
            if not channels:
                raise InputError(f"{file}: not an MCAP recording: {error}") from error
        except Exception as error:
            # The reader stops with all sorts of errors where a dying process stopped writing.
            if not channels:
                raise InputError(f"{file}: not an MCAP recording: {error}") from error
    tables, columns, events = {}, {}, []
    for number, channel in channels.items():
        topic = channel.topic.strip("/")
        schema = schemas.get(channel.schema_id)
        messages = payloads.get(number, [])
        try:
            if topic == "event":
                events = [json.loads(data) for data in messages]
            elif (
                channel.message_encoding == "cdr"
                and schema is not None
                and schema.name.startswith("crazyarena/")
            ):
                names = _columns(schema.data.decode())
                raw = b"".join(data[4:] for data in messages)
                tables[topic] = np.frombuffer(raw, "<f8").reshape(-1, len(names))
                columns[topic] = names
        except (ValueError, RecursionError) as error:
            raise InputError(f"{file}: topic /{topic[:60]} is spoilt: {error}") from None
    return Recording(tables, columns, events, metadata, complete)


def write_csv(recording: Recording, stem: Path) -> list[Path]:
    """One file a topic that has rows, ``<stem>_<topic>.csv``; returns the files."""
    written = []
    for topic, table in recording.tables.items():
        if not len(table):
            continue
        file = stem.with_name(f"{stem.name}_{topic}.csv")
        header = ",".join(recording.columns[topic])
        np.savetxt(file, table, fmt="%.17g", delimiter=",", header=header, comments="")
        written.append(file)
    file = stem.with_name(f"{stem.name}_event.csv")
    lines = ["time,tick,event,detail"]
    for e in recording.events:
        detail = str(e["detail"]).replace('"', '""')
        lines.append(f'{e["time"]!r},{e["tick"]},{e["event"]},"{detail}"')
    file.write_text("\n".join(lines) + "\n")
    return [*written, file]


def write_npz(recording: Recording, stem: Path) -> list[Path]:
    """``<stem>.npz`` with arrays ``<topic>``, ``<topic>_columns``, events and metadata."""
    file = stem.with_name(f"{stem.name}.npz")
    arrays: dict[str, Any] = dict(recording.tables)
    arrays |= {f"{topic}_columns": np.array(names) for topic, names in recording.columns.items()}
    arrays["events_json"] = np.array(json.dumps(recording.events))
    arrays["metadata_json"] = np.array(json.dumps(recording.metadata))
    np.savez_compressed(file, **arrays)
    return [file]
