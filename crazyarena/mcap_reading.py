"""Records of MCAP files that somebody else may have written, in bounded memory and time.

The ``mcap`` package believes the sizes that a file states, and unpacks chunks without a limit: a
few kilobytes can ask for many gigabytes. Here every record and every chunk has a largest size.
"""

from __future__ import annotations

import os
import zlib
from collections.abc import Iterator
from io import BytesIO
from typing import IO, Any

from mcap.exceptions import McapError
from mcap.records import Channel, Chunk, Footer, Message, Statistics
from mcap.stream_reader import StreamReader

# Largest record, and largest unpacked chunk, bytes.
LARGEST = 64 << 20
# No recording of numbers shrinks to a part of this; a bomb does.
_RATIO = 200
_SMALL = 1 << 20
_KINDS = frozenset(range(0x01, 0x10))  # of the MCAP specification
_MAGIC = b"\x89MCAP0\r\n"


class Damaged(ValueError):
    """A file is no MCAP from some place on; the message says what and at which byte."""


def unpacked(chunk: Chunk) -> bytes:
    """Return the bytes in a chunk; raises Damaged if it is a bomb or spoilt."""
    limit = min(LARGEST, max(_SMALL, _RATIO * len(chunk.data)))
    if chunk.uncompressed_size > limit:
        raise Damaged(
            f"a chunk of {len(chunk.data)} bytes claims to unpack to {chunk.uncompressed_size}"
        )
    data = _unpack(chunk)
    if len(data) != chunk.uncompressed_size:
        raise Damaged(f"a chunk does not unpack to the {chunk.uncompressed_size} bytes it claims")
    if chunk.uncompressed_crc != 0 and zlib.crc32(data) != chunk.uncompressed_crc:
        raise Damaged("the checksum of a chunk is wrong")
    return data


def _unpack(chunk: Chunk) -> bytes:
    # One byte more than announced shows a chunk that unpacks to more, and nothing is made of it.
    most = chunk.uncompressed_size + 1
    try:
        if chunk.compression == "":
            return chunk.data
        if chunk.compression == "zstd":
            import zstandard

            reader = zstandard.ZstdDecompressor(max_window_size=LARGEST).stream_reader(chunk.data)
            return reader.read(most)
        if chunk.compression == "lz4":
            import lz4.frame

            return lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=most)
    except Exception as error:
        # Each library has errors of its own kind, and all mean the same here.
        raise Damaged(f"a chunk cannot be unpacked: {error}") from None
    raise Damaged(f"a chunk is packed by {chunk.compression[:20]!r}; known are lz4 and zstd")


def chunk_records(chunk: Chunk) -> Iterator[Any]:
    """Records in a chunk: schemas, channels, messages; raises Damaged."""
    data = unpacked(chunk)
    stream = BytesIO(data)
    reader = StreamReader(stream, skip_magic=True, emit_chunks=True, record_size_limit=len(data))
    records = reader.records
    while stream.tell() < len(data):
        try:
            _look_at_kind(stream)
            record = next(records)
        except StopIteration:
            return
        except Damaged:
            raise
        except Exception as error:
            raise Damaged(f"a record in a chunk is spoilt: {_reason(error)}") from None
        if isinstance(record, Chunk):
            raise Damaged("a chunk holds another chunk")
        yield record


def records(stream: IO[bytes]) -> Iterator[Any]:
    """All records of a file in order, those of chunks as well.

    Raises
    ------
    Damaged: from where the file is spoilt or was cut short.
    """
    if stream.read(len(_MAGIC)) != _MAGIC:
        raise Damaged("byte 0: not an MCAP file")
    reader = StreamReader(
        stream, skip_magic=True, emit_chunks=True, record_size_limit=LARGEST
    ).records
    messages, channels = 0, set[int]()
    while True:
        at = stream.tell()
        try:
            _look_at_kind(stream)
            record = next(reader)
            for inner in chunk_records(record) if isinstance(record, Chunk) else (record,):
                if isinstance(inner, Channel):
                    channels.add(inner.id)
                elif isinstance(inner, Message):
                    messages += 1
                    if inner.channel_id not in channels:
                        raise Damaged(f"a message of channel {inner.channel_id}, which is missing")
                yield inner
            if isinstance(record, Statistics) and record.message_count != messages:
                raise Damaged(f"{messages} messages are there, {record.message_count} were written")
            if isinstance(record, Footer):
                return
        except StopIteration:
            return
        except Damaged as error:
            raise Damaged(f"byte {at}: {error}") from None
        except Exception as error:
            # The package meets nonsense with errors of many kinds: struct, Unicode, index, ...
            raise Damaged(f"byte {at}: {_reason(error)}") from None


def _look_at_kind(stream: IO[bytes]) -> None:
    """Raise Damaged for a record of a kind that MCAP does not know: the package passes over it,
    and a chunk whose first byte is spoilt would be missing without a word."""
    kind = stream.read(1)
    stream.seek(-len(kind), os.SEEK_CUR)
    if kind and kind[0] not in _KINDS:
        raise Damaged(f"a record of unknown kind 0x{kind[0]:02x}")


def _reason(error: Exception) -> str:
    if isinstance(error, McapError) and str(error):
        return " ".join(str(error).split())
    return f"not an MCAP record ({type(error).__name__})"
