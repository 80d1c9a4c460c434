"""A recording that somebody packed to burst is refused, or read up to there."""

from __future__ import annotations

import struct

import pytest

from crazyarena.errors import InputError
from crazyarena.runner.records import export

MAGIC = bytes((137, 77, 67, 65, 80, 48, 13, 10))


def record(kind: int, body: bytes) -> bytes:
    return bytes((kind,)) + struct.pack("<Q", len(body)) + body


def text(words: str) -> bytes:
    return struct.pack("<I", len(words)) + words.encode()


def chunk(packed: str, data: bytes, size: int) -> bytes:
    body = struct.pack("<QQQI", 0, 1, size, 0) + text(packed)
    return record(0x06, body + struct.pack("<Q", len(data)) + data)


@pytest.mark.parametrize("packed", ["zstd", "lz4"])
def test_a_bomb_is_not_unpacked(tmp_path, packed):
    if packed == "zstd":
        import zstandard

        data = zstandard.compress(bytes(200 << 20))
    else:
        import lz4.frame

        data = lz4.frame.compress(bytes(200 << 20))
    file = tmp_path / "bomb.mcap"
    header = MAGIC + record(0x01, text("") + text(""))
    for size in (200 << 20, 100, 1 << 60):
        file.write_bytes(header + chunk(packed, data, size))
        with pytest.raises(InputError, match=r"bomb\.mcap: not an MCAP recording: a chunk"):
            export.read(file)
    # What stands before it is worth having.
    channel = record(0x04, struct.pack("<HH", 1, 0) + text("/x") + text("json") + bytes(4))
    file.write_bytes(header + channel + chunk(packed, data, 200 << 20))
    assert not export.read(file).complete


@pytest.mark.parametrize(
    ("topic", "encoding", "data"),
    [("event", "json", b"{"), ("event", "json", b"[" * 100_000), ("state", "cdr", b"\0" * 9)],
)
def test_a_spoilt_topic_is_a_line_that_names_it(tmp_path, topic, encoding, data):
    file = tmp_path / "spoilt.mcap"
    lines = "float64 time\nfloat64[3] position"
    schema = struct.pack("<H", 1) + text("crazyarena/State") + text("ros2msg") + text(lines)
    channel = struct.pack("<HH", 1, 1) + text(f"/{topic}") + text(encoding) + bytes(4)
    message = struct.pack("<HIQQ", 1, 0, 0, 0) + data
    file.write_bytes(
        MAGIC
        + record(0x01, text("") + text(""))
        + record(0x03, schema)
        + record(0x04, channel)
        + record(0x05, message)
    )
    with pytest.raises(InputError, match=rf"spoilt\.mcap: topic /{topic}") as error:
        export.read(file)
    assert "\n" not in str(error.value)
