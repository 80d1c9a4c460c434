"""The records of an MCAP file that may come from anywhere, or be cut short.

Damage ends the reading, as where a dying process stopped writing; what asks for far more than it
holds is refused.
"""

from __future__ import annotations

import stat
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from crazyarena.errors import InputError
from crazyarena.mcap_reading import LARGEST, Bomb, chunk_records
from crazyarena.plain_text import shown, shown_line

_MOST_BYTES = 4 * 2**30  # of a file, and of what it unpacks to
_MOST_RECORDS = 50_000_000


@dataclass
class Records:
    """What a file holds, by the numbers of its channels and schemas.

    metadata: of the record ``crazyarena``; complete: False for the remains of a flight.
    """

    schemas: dict[int, Any] = field(default_factory=dict)
    channels: dict[int, Any] = field(default_factory=dict)
    payloads: dict[int, list[bytes]] = field(default_factory=dict)
    metadata: dict[str, str] = field(default_factory=dict)
    complete: bool = False


def read_records(file: Path) -> Records:
    """Read everything up to the end, or to where the file breaks off.

    Raises
    ------
    InputError: no MCAP file, or one that unpacks to more than any recording.
    """
    from mcap.stream_reader import StreamReader

    reading = _Reading()
    try:
        status = file.stat()
        if not stat.S_ISREG(status.st_mode):
            raise InputError(f"{file}: not an MCAP recording: a folder or a device")
        if status.st_size > _MOST_BYTES:
            raise InputError(
                f"{file}: {status.st_size / 2**30:.0f} GiB; a recording may have "
                f"{_MOST_BYTES // 2**30} GiB"
            )
        with open(file, "rb") as stream:
            reader = StreamReader(stream, emit_chunks=True, record_size_limit=LARGEST)
            try:
                reading.take(reader.records)
            except Bomb as error:
                raise InputError(f"{file}: byte {stream.tell()}: {error}") from None
            except InputError:
                raise
            except Exception as error:
                # The reader stops with all sorts of errors where a dying process stopped writing.
                if not reading.found.channels:
                    where = f"{file}: byte {stream.tell()}"
                    reason = shown_line(str(error) or type(error).__name__)
                    raise InputError(f"{where}: not an MCAP recording: {reason}") from None
    except OSError as error:
        raise InputError(f"{file}: cannot read it: {error.strerror or error}") from None
    return reading.found


class _Reading:
    def __init__(self) -> None:
        self.found = Records()
        self._count = 0
        self._unpacked = 0

    def take(self, records: Iterable[Any]) -> None:
        from mcap.records import Channel, Chunk, DataEnd, Message, Metadata, Schema

        found = self.found
        for record in records:
            self._count += 1
            if self._count > _MOST_RECORDS:
                raise Bomb(f"more than {_MOST_RECORDS} records")
            if isinstance(record, Schema):
                found.schemas[record.id] = record
            elif isinstance(record, Channel):
                found.channels[record.id] = record
            elif isinstance(record, Message):
                found.payloads.setdefault(record.channel_id, []).append(record.data)
            elif isinstance(record, Chunk):
                self._unpacked += record.uncompressed_size
                if self._unpacked > _MOST_BYTES:
                    raise Bomb(f"unpacks to more than {_MOST_BYTES // 2**30} GiB")
                self.take(chunk_records(record))
            elif isinstance(record, Metadata) and record.name == "crazyarena":
                found.metadata.update({shown(k): shown(v) for k, v in record.metadata.items()})
            elif isinstance(record, DataEnd):
                found.complete = True
                return
