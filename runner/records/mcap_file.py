"""Writes MCAP files (https://mcap.dev/spec) from whole arrays of messages at once.

The general-purpose writer takes one Python call a message; a flight has hundreds of thousands,
nearly all of them fixed-size rows of float64. Those are CDR-encoded ROS 2 messages as they
stand (a 4-byte encapsulation header, then the numbers), so a batch is framed with one NumPy
assignment. Chunks are uncompressed, with message indexes, so that viewers can seek.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

MAGIC = b"\x89MCAP0\r\n"
_HEADER, _FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _MESSAGE_INDEX, _CHUNK_INDEX = range(1, 9)
_STATISTICS, _METADATA, _METADATA_INDEX, _SUMMARY_OFFSET, _DATA_END = 11, 12, 13, 14, 15

CDR_LITTLE_ENDIAN = b"\x00\x01\x00\x00"


def _string(text: str | bytes) -> bytes:
    data = text.encode() if isinstance(text, str) else text
    return struct.pack("<I", len(data)) + data


def _map(entries: Mapping[str, str]) -> bytes:
    return _string(b"".join(_string(k) + _string(v) for k, v in entries.items()))


def _record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


@dataclass
class Channel:
    """One topic; ``message_encoding`` is ``cdr`` (schema: ros2msg) or ``json`` (jsonschema)."""

    id: int
    topic: str
    message_encoding: str
    schema_name: str
    schema_encoding: str
    schema: str

    def records(self) -> bytes:
        """Schema and channel records."""
        schema = struct.pack("<H", self.id)
        schema += _string(self.schema_name) + _string(self.schema_encoding) + _string(self.schema)
        channel = struct.pack("<HH", self.id, self.id)
        channel += _string(self.topic) + _string(self.message_encoding) + _map({})
        return _record(_SCHEMA, schema) + _record(_CHANNEL, channel)


@dataclass
class Batch:
    """Framed messages of one channel: bytes, log times (ns) and offsets into the bytes."""

    channel: int
    data: bytes | memoryview
    times: NDArray[np.uint64]
    offsets: NDArray[np.uint64]


def cdr_batch(channel: int, sequence: int, times: NDArray[np.uint64], rows: NDArray[Any]) -> Batch:
    """Frame fixed-size messages; ``rows`` (n,) is a packed structured array, or (n, m) float64."""
    n = len(times)
    payload = rows.dtype if rows.ndim == 1 else np.dtype((rows.dtype, rows.shape[1:]))
    size = payload.itemsize + 4
    framed = np.empty(
        n,
        np.dtype(
            [
                ("opcode", "u1"),
                ("length", "<u8"),
                ("channel", "<u2"),
                ("sequence", "<u4"),
                ("log_time", "<u8"),
                ("publish_time", "<u8"),
                ("encapsulation", "S4"),
                ("payload", payload),
            ]
        ),
    )
    framed["opcode"] = _MESSAGE
    framed["length"] = 22 + size
    framed["channel"] = channel
    framed["sequence"] = np.arange(sequence, sequence + n)
    framed["log_time"] = framed["publish_time"] = times
    framed["encapsulation"] = CDR_LITTLE_ENDIAN
    framed["payload"] = rows
    offsets = np.arange(n, dtype=np.uint64) * np.uint64(framed.itemsize)
    return Batch(channel, framed.view(np.uint8).data, times.astype(np.uint64), offsets)


def message(channel: int, sequence: int, time: int, payload: bytes) -> Batch:
    """Frame one message of any size."""
    content = struct.pack("<HIQQ", channel, sequence, time, time) + payload
    return Batch(
        channel,
        _record(_MESSAGE, content),
        np.array([time], dtype=np.uint64),
        np.zeros(1, dtype=np.uint64),
    )


def preamble(channels: list[Channel], library: str) -> bytes:
    """Magic, header, schemas and channels: what every file begins with."""
    head = MAGIC + _record(_HEADER, _string("") + _string(library))
    return head + b"".join(channel.records() for channel in channels)


@dataclass
class McapWriter:
    """A complete, indexed file: channels first, then chunks of batches, then :meth:`finish`."""

    stream: BinaryIO
    channels: list[Channel]
    library: str = "crazyarena"
    _position: int = 0
    _chunks: list[bytes] = field(default_factory=list)
    _metadata: list[bytes] = field(default_factory=list)
    _counts: dict[int, int] = field(default_factory=dict)
    _start: int | None = None
    _end: int = 0

    def __post_init__(self) -> None:
        self._write(preamble(self.channels, self.library))

    def _write(self, data: bytes | memoryview) -> int:
        start = self._position
        self.stream.write(data)
        self._position += len(data)
        return start

    def metadata(self, name: str, entries: Mapping[str, str]) -> None:
        """Store a named set of strings."""
        record = _record(_METADATA, _string(name) + _map(entries))
        start = self._write(record)
        self._metadata.append(
            _record(_METADATA_INDEX, struct.pack("<QQ", start, len(record)) + _string(name))
        )

    def chunk(self, batches: list[Batch]) -> None:
        """Write one chunk; empty batches are left out."""
        batches = [batch for batch in batches if len(batch.times)]
        if not batches:
            return
        base = 0
        index: dict[int, list[NDArray[np.uint64]]] = {}
        for batch in batches:
            entries = np.stack([batch.times, batch.offsets + np.uint64(base)], axis=1)
            index.setdefault(batch.channel, []).append(entries)
            self._counts[batch.channel] = self._counts.get(batch.channel, 0) + len(batch.times)
            base += len(batch.data)
        start = min(int(batch.times.min()) for batch in batches)
        end = max(int(batch.times.max()) for batch in batches)
        self._start = start if self._start is None else min(self._start, start)
        self._end = max(self._end, end)
        crc = 0
        for batch in batches:
            crc = zlib.crc32(batch.data, crc)
        head = struct.pack("<QQQI", start, end, base, crc) + _string("") + struct.pack("<Q", base)
        # Written piece by piece: joining megabytes costs as much as recording them.
        chunk_start = self._write(struct.pack("<BQ", _CHUNK, len(head) + base) + head)
        for batch in batches:
            self._write(batch.data)
        chunk_length = self._position - chunk_start
        offsets = b""
        index_start = self._position
        for channel, parts in index.items():
            pairs = np.concatenate(parts).astype("<u8").tobytes()
            at = self._write(_record(_MESSAGE_INDEX, struct.pack("<H", channel) + _string(pairs)))
            offsets += struct.pack("<HQ", channel, at)
        content = struct.pack("<QQQQ", start, end, chunk_start, chunk_length) + _string(offsets)
        content += struct.pack("<Q", self._position - index_start) + _string("")
        content += struct.pack("<QQ", base, base)
        self._chunks.append(_record(_CHUNK_INDEX, content))

    def finish(self) -> None:
        """Write the summary section; nothing may be added afterwards."""
        self._write(_record(_DATA_END, struct.pack("<I", 0)))
        counts = b"".join(struct.pack("<HQ", k, v) for k, v in sorted(self._counts.items()))
        n = len(self.channels)
        statistics = struct.pack(
            "<QHIIIIQQ",
            sum(self._counts.values()),
            n,
            n,
            0,
            len(self._metadata),
            len(self._chunks),
            self._start or 0,
            self._end,
        ) + _string(counts)
        schemas = b""
        channels = b""
        for channel in self.channels:
            records = channel.records()
            split = 9 + struct.unpack_from("<Q", records, 1)[0]
            schemas += records[:split]
            channels += records[split:]
        groups = (
            (_SCHEMA, schemas),
            (_CHANNEL, channels),
            (_STATISTICS, _record(_STATISTICS, statistics)),
            (_CHUNK_INDEX, b"".join(self._chunks)),
            (_METADATA_INDEX, b"".join(self._metadata)),
        )
        summary_start = self._position
        summary = b""
        offsets = b""
        for opcode, data in groups:
            if data:
                at = summary_start + len(summary)
                offsets += _record(_SUMMARY_OFFSET, struct.pack("<BQQ", opcode, at, len(data)))
                summary += data
        offset_start = summary_start + len(summary)
        footer = struct.pack("<BQQQ", _FOOTER, 20, summary_start, offset_start)
        crc = zlib.crc32(summary + offsets + footer)
        self._write(summary + offsets + footer + struct.pack("<I", crc) + MAGIC)
