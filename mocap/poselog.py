"""Pose logs: every frame of a session in a file, and back, bit for bit.

``.mcap`` keeps the binary payload of :mod:`crazyarena.mocap.wire` on one channel (schema-less,
message encoding ``crazyarena-poses-v1``); ``.csv`` has one row per body or marker with all
digits of every number, for people and spreadsheets.
"""

from __future__ import annotations

import csv
import os
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Protocol

import numpy as np

from crazyarena import mcap_reading
from crazyarena.errors import InputError
from crazyarena.mocap.wire import MAX_BODIES, MAX_MARKERS, PayloadError, decode, encode
from crazyarena.types import Pose, PoseFrame

TOPIC = "/mocap/frames"
ENCODING = "crazyarena-poses-v1"
CSV_COLUMNS = (
    "timestamp", "received", "frame_id", "body", "x", "y", "z", "qx", "qy", "qz", "qw",
)  # fmt: skip
_NANO = 1_000_000_000
# A name and ten numbers need far less, characters.
_LONGEST_ROW = 4096


def encode_logged(frame: PoseFrame) -> bytes:
    """Return the payload of a logged frame: session times stand in the stamp fields."""
    return encode(
        frame.frame_id, frame.timestamp, frame.received, 0, 0, frame.bodies, frame.markers
    )


def decode_logged(payload: bytes) -> PoseFrame:
    """Inverse of :func:`encode_logged`; raises PayloadError."""
    wire = decode(payload)
    return PoseFrame(wire.captured, wire.sent, wire.frame_id, wire.bodies, wire.markers)


class _Writer(Protocol):
    def write(self, frame: PoseFrame) -> None: ...

    def close(self) -> None: ...


class McapPoses:
    """The pose channel inside an MCAP file that somebody else (the trial recorder) owns."""

    def __init__(self, writer: Any, topic: str = TOPIC) -> None:
        self._writer = writer
        self._channel = writer.register_channel(topic=topic, message_encoding=ENCODING, schema_id=0)

    def write(self, frame: PoseFrame) -> None:
        self._writer.add_message(
            channel_id=self._channel,
            log_time=max(0, round(frame.received * _NANO)),
            publish_time=max(0, round(frame.timestamp * _NANO)),
            sequence=frame.frame_id & 0xFFFFFFFF,
            data=encode_logged(frame),
        )


class _McapFile:
    def __init__(self, path: Path) -> None:
        from mcap.writer import CompressionType, Writer

        self._stream = path.open("wb")
        # Small chunks bound what a crash can lose.
        self._writer = Writer(self._stream, chunk_size=262144, compression=CompressionType.NONE)
        self._writer.start(profile="crazyarena", library="crazyarena")
        self._poses = McapPoses(self._writer)

    def write(self, frame: PoseFrame) -> None:
        self._poses.write(frame)

    def close(self) -> None:
        self._writer.finish()
        self._stream.close()


class _CsvFile:
    def __init__(self, path: Path) -> None:
        self._stream: IO[str] = path.open("w", newline="", encoding="utf-8")
        self._rows = csv.writer(self._stream)
        self._rows.writerow(CSV_COLUMNS)

    def write(self, frame: PoseFrame) -> None:
        head = (repr(float(frame.timestamp)), repr(float(frame.received)), frame.frame_id)
        if not frame.bodies and not len(frame.markers):
            self._rows.writerow((*head, "", *[""] * 7))
        for name, pose in frame.bodies.items():
            numbers = (*pose.position.tolist(), *pose.quaternion.tolist())
            self._rows.writerow((*head, name, *map(repr, numbers)))
        for marker in frame.markers.tolist():
            self._rows.writerow((*head, "", *map(repr, marker), *[""] * 4))

    def close(self) -> None:
        self._stream.close()


class PoseLogWriter:
    """Write pose frames to ``path`` (``.mcap`` or ``.csv``); a context manager."""

    def __init__(self, path: str | Path) -> None:
        path = Path(path)
        if path.suffix == ".mcap":
            self._file: _Writer = _McapFile(path)
        elif path.suffix == ".csv":
            self._file = _CsvFile(path)
        else:
            raise InputError(f"{path}: pose logs end in .mcap or .csv, found {path.suffix!r}")

    def write(self, frame: PoseFrame) -> None:
        self._file.write(frame)

    def close(self) -> None:
        self._file.close()

    def __enter__(self) -> PoseLogWriter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def read_pose_log(path: str | Path) -> Iterator[PoseFrame]:
    """Yield the frames of a pose log in the order they were written.

    Raises
    ------
    InputError: the file is missing, of another kind, or a row or message is damaged.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such pose log")
    if not os.access(path, os.R_OK):
        raise InputError(f"{path}: this pose log may not be read; check its permissions")
    if path.suffix == ".mcap":
        return _read_mcap(path)
    if path.suffix == ".csv":
        return _read_csv(path)
    raise InputError(f"{path}: pose logs end in .mcap or .csv, found {path.suffix!r}")


def _read_mcap(path: Path) -> Iterator[PoseFrame]:
    from mcap.records import Channel, Message

    channels: set[int] = set()
    count = 0
    with path.open("rb") as stream:
        try:
            # File order is what was written; it also reads files that a crash cut short.
            for record in mcap_reading.records(stream):
                if isinstance(record, Channel) and record.message_encoding == ENCODING:
                    channels.add(record.id)
                elif isinstance(record, Message) and record.channel_id in channels:
                    count += 1
                    yield decode_logged(record.data)
        except mcap_reading.Damaged as error:
            raise InputError(f"{path}: not a readable pose log: {error}") from None
        except PayloadError as error:
            raise InputError(f"{path}: not a readable pose log: frame {count}: {error}") from None
    if not channels:
        raise InputError(f"{path}: an MCAP file without poses (message encoding {ENCODING})")


def _lines(path: Path, stream: IO[str]) -> Iterator[str]:
    """Lines of a text file, none longer than a row can be."""
    number = 0
    while True:
        number += 1
        try:
            line = stream.readline(_LONGEST_ROW + 1)
        except UnicodeDecodeError as error:
            raise InputError(f"{path}: line {number} or later: not UTF-8: {error.reason}") from None
        if len(line) > _LONGEST_ROW:
            raise InputError(f"{path}: line {number}: longer than {_LONGEST_ROW} characters")
        if not line:
            return
        yield line


def _read_csv(path: Path) -> Iterator[PoseFrame]:
    with path.open(newline="", encoding="utf-8") as stream:
        rows = csv.reader(_lines(path, stream), strict=True)
        try:
            yield from _csv_frames(path, rows)
        except (ValueError, csv.Error) as error:
            raise InputError(f"{path}: line {rows.line_num}: {error}") from None


def _csv_frames(path: Path, rows: Any) -> Iterator[PoseFrame]:
    header = tuple(next(rows, ()))
    if header != CSV_COLUMNS:
        raise InputError(
            f"{path}: line 1: found columns {','.join(header)[:200]!r}; need "
            f"{','.join(CSV_COLUMNS)}"
        )
    head: tuple[str, ...] | None = None
    bodies: dict[str, Pose] = {}
    markers: list[list[float]] = []
    for row in rows:
        if len(row) != len(CSV_COLUMNS):
            raise ValueError(f"{len(row)} columns, need {len(CSV_COLUMNS)}")
        if head is not None and tuple(row[:3]) != head:
            yield _csv_frame(head, bodies, markers)
            bodies, markers = {}, []
        head = tuple(row[:3])
        if row[3]:
            if row[3] in bodies:
                raise ValueError(f"body {row[3]!r} occurs twice in a frame")
            bodies[row[3]] = _csv_pose(row[4:])
        elif row[4]:
            markers.append(_numbers(row[4:7]).tolist())
        if len(bodies) > MAX_BODIES or len(markers) > MAX_MARKERS:
            raise ValueError(f"more than {MAX_BODIES} bodies or {MAX_MARKERS} markers in a frame")
    if head is not None:
        yield _csv_frame(head, bodies, markers)


def _numbers(cells: list[str]) -> np.ndarray:
    numbers = np.array([float(cell) for cell in cells])
    if not np.isfinite(numbers).all():
        raise ValueError(f"found {','.join(cells)[:80]!r}; need finite numbers")
    return numbers


def _csv_pose(cells: list[str]) -> Pose:
    numbers = _numbers(cells)
    norm = float(np.linalg.norm(numbers[3:]))
    if abs(norm - 1.0) > 1e-3:
        raise ValueError(f"a quaternion has norm {norm:g}, not 1")
    return Pose(numbers[:3], numbers[3:])


def _csv_frame(
    head: tuple[str, ...], bodies: dict[str, Pose], markers: list[list[float]]
) -> PoseFrame:
    timestamp, received = _numbers([head[0], head[1]]).tolist()
    if not 0 <= (number := int(head[2])) < 1 << 64:
        raise ValueError(f"frame_id {head[2][:40]}: need a whole number from 0 to 2^64 - 1")
    return PoseFrame(timestamp, received, number, bodies, np.array(markers).reshape(-1, 3))
