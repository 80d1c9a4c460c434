"""Pose logs: every frame of a session in a file, and back, bit for bit.

``.mcap`` keeps the binary payload of :mod:`crazyarena.mocap.wire` on one channel (schema-less,
message encoding ``crazyarena-poses-v1``); ``.csv`` has one row per body or marker with all
digits of every number, for people and spreadsheets.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Protocol

import numpy as np

from crazyarena.errors import InputError
from crazyarena.mocap.wire import PayloadError, decode, encode
from crazyarena.types import Pose, PoseFrame

TOPIC = "/mocap/frames"
ENCODING = "crazyarena-poses-v1"
CSV_COLUMNS = (
    "timestamp", "received", "frame_id", "body", "x", "y", "z", "qx", "qy", "qz", "qw",
)  # fmt: skip
_NANO = 1_000_000_000


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
        self._stream: IO[str] = path.open("w", newline="")
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
    if path.suffix == ".mcap":
        return _read_mcap(path)
    if path.suffix == ".csv":
        return _read_csv(path)
    raise InputError(f"{path}: pose logs end in .mcap or .csv, found {path.suffix!r}")


def _read_mcap(path: Path) -> Iterator[PoseFrame]:
    from mcap.exceptions import McapError
    from mcap.reader import NonSeekingReader

    with path.open("rb") as stream:
        try:
            # File order is what was written; it also reads files that a crash cut short.
            reader = NonSeekingReader(stream)
            for _, channel, message in reader.iter_messages(log_time_order=False):
                if channel.message_encoding == ENCODING:
                    yield decode_logged(message.data)
        except (McapError, PayloadError) as error:
            raise InputError(f"{path}: not a readable pose log: {error}") from None


def _read_csv(path: Path) -> Iterator[PoseFrame]:
    with path.open(newline="") as stream:
        rows = csv.reader(stream)
        header = tuple(next(rows, ()))
        if header != CSV_COLUMNS:
            raise InputError(
                f"{path}: line 1: found columns {','.join(header)!r}; need {','.join(CSV_COLUMNS)}"
            )
        head: tuple[str, ...] | None = None
        bodies: dict[str, Pose] = {}
        markers: list[list[float]] = []
        for row in rows:
            try:
                if len(row) != len(CSV_COLUMNS):
                    raise ValueError(f"{len(row)} columns, need {len(CSV_COLUMNS)}")
                if head is not None and tuple(row[:3]) != head:
                    yield _csv_frame(head, bodies, markers)
                    bodies, markers = {}, []
                head = tuple(row[:3])
                if row[3]:
                    numbers = np.array([float(cell) for cell in row[4:]])
                    bodies[row[3]] = Pose(numbers[:3], numbers[3:])
                elif row[4]:
                    markers.append([float(cell) for cell in row[4:7]])
            except ValueError as error:
                raise InputError(f"{path}: line {rows.line_num}: {error}") from None
        if head is not None:
            yield _csv_frame(head, bodies, markers)


def _csv_frame(
    head: tuple[str, ...], bodies: dict[str, Pose], markers: list[list[float]]
) -> PoseFrame:
    return PoseFrame(
        float(head[0]), float(head[1]), int(head[2]), bodies, np.array(markers).reshape(-1, 3)
    )
