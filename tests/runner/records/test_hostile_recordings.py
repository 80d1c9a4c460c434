"""Recordings from anywhere: what they hold, or one line that says what is wrong and where."""

import io
import json
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crazyarena.errors import InputError
from crazyarena.runner.records import export
from crazyarena.runner.records.compare import compare

lz4 = pytest.importorskip("lz4.frame")
zstandard = pytest.importorskip("zstandard")
MAGIC = b"\x89MCAP0\r\n"
COLUMNS = b"float64 time\nfloat64[3] position\n"


def text(value):
    data = value if isinstance(value, bytes) else value.encode()
    return struct.pack("<I", len(data)) + data


def record(kind, body):
    return struct.pack("<BQ", kind, len(body)) + body


def head():
    return MAGIC + record(1, text("") + text("test"))


def schema(data=COLUMNS, name="crazyarena/State"):
    return record(3, struct.pack("<H", 1) + text(name) + text("ros2msg") + text(data))


def channel(topic="/state", encoding="cdr", number=1, of=1):
    return record(
        4, struct.pack("<HH", number, of) + text(topic) + text(encoding) + struct.pack("<I", 0)
    )


def message(data, number=1):
    return record(5, struct.pack("<HIQQ", number, 0, 0, 0) + data)


def row(*values):
    return b"\0\1\0\0" + struct.pack(f"<{len(values)}d", *values)


def chunk(data, compression, size):
    head = struct.pack("<QQQI", 0, 0, size, 0)
    return record(6, head + text(compression) + struct.pack("<Q", len(data)) + data)


def event(**fields):
    return json.dumps({"time": 0.0, "tick": 0, "event": "x", "detail": "", **fields}).encode()


def refused(tmp_path, data, call=export.read):
    file = tmp_path / "flight.mcap"
    file.write_bytes(data)
    with pytest.raises(InputError) as error:
        call(file)
    told = str(error.value)
    assert str(file) in told
    assert len(told.splitlines()) == 1
    assert len(told) < 600
    return told


def good():
    return head() + schema() + channel() + message(row(0, 1, 2, 3)) + message(row(1, 1, 2, 4))


def test_a_good_one(tmp_path):
    file = tmp_path / "flight.mcap"
    file.write_bytes(good())
    assert export.read(file).tables["state"].tolist() == [[0, 1, 2, 3], [1, 1, 2, 4]]
    packed = head() + b"".join(
        chunk(pack(part), name, len(part))
        for name, pack, part in (
            ("zstd", zstandard.compress, schema() + channel()),
            ("lz4", lz4.compress, message(row(0, 1, 2, 3))),
        )
    )
    file.write_bytes(packed)
    assert export.read(file).tables["state"].tolist() == [[0, 1, 2, 3]]


@pytest.mark.parametrize("kind", ["zstd", "lz4"])
@pytest.mark.parametrize("told", [0, 1 << 30, 1 << 62])
def test_a_bomb(tmp_path, kind, told):
    pack = {"zstd": zstandard.compress, "lz4": lz4.compress}[kind]
    # Records of no kind at all, a gibibyte of them.
    out = io.BytesIO()
    if kind == "zstd":
        with zstandard.ZstdCompressor().stream_writer(out, closefd=False) as writer:
            for _ in range(256):
                writer.write(bytes(1 << 20))
    else:
        out.write(pack(bytes(64 << 20)))
    bomb = good() + chunk(out.getvalue(), kind, told)
    words = refused(tmp_path, bomb)
    assert "unpack" in words
    assert "byte " in words


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "not an MCAP"),
        (b"\xff" * 100, "not an MCAP"),
        (head(), "not an MCAP"),
        (head() + schema(b"\xff\xfe float64 x") + channel(), "UTF-8"),
        (head() + schema(b"float64[999999] x\n") + channel(), "columns"),
        (head() + schema(b"float64 x\n" * 20_000) + channel(), "columns"),
        (head() + channel(of=7), "schema 7 is missing"),
        (good() + message(row(0, 1)), "message 2 has 20 bytes"),
        (good() + message(b""), "message 2 has 0 bytes"),
        (head() + channel("/event", "json", of=0) + message(b"\xff"), "event 0"),
        (head() + channel("/event", "json", of=0) + message(b"[" * 99_999), "event 0"),
        (head() + channel("/event", "json", of=0) + message(b"{}"), "event 0"),
        (head() + channel("/event", "json", of=0) + message(b"3"), "event 0"),
        (head() + channel("/event", "json", of=0) + message(event(tick="x")), "event 0"),
    ],
)
def test_what_is_wrong_is_said(tmp_path, data, words):
    assert words in refused(tmp_path, data)


def test_text_in_it_is_shown(tmp_path):
    file = tmp_path / "flight.mcap"
    ill = "\x1b[2J \ud800"
    file.write_bytes(
        head() + channel("/event", "json", of=0) + message(event(event=ill, detail=ill + "\n"))
    )
    recording = export.read(file)
    assert recording.events[0]["event"] == r"\x1b[2J \ud800"
    (csv,) = export.write_csv(recording, tmp_path / "out")
    assert r"\x1b[2J" in csv.read_text()


@settings(max_examples=200)
@given(st.data())
def test_any_damage(tmp_path_factory, data):
    part = message(row(2, 1, 2, 3))
    whole = bytearray(good() + chunk(zstandard.compress(part), "zstd", len(part)))
    for _ in range(data.draw(st.integers(1, 4))):
        whole[data.draw(st.integers(0, len(whole) - 1))] = data.draw(st.integers(0, 255))
    file = tmp_path_factory.mktemp("damage") / "flight.mcap"
    file.write_bytes(whole[: data.draw(st.integers(0, len(whole)))])
    told = ""
    try:
        export.read(file)
    except InputError as error:
        told = str(error)
    assert not told or str(file) in told
    assert len(told.splitlines()) <= 1


@pytest.mark.parametrize(
    "result", [b"\xff", b"[" * 99_999, b"{}", b"[]", b'{"episodes": [3]}', b'{"episodes": [{}]}']
)
def test_a_result_beside_it_that_is_none(tmp_path, result):
    for name in "ab":
        (tmp_path / name).mkdir()
        (tmp_path / name / "flight.mcap").write_bytes(good())
        (tmp_path / name / "result.json").write_bytes(result)
    with pytest.raises(InputError, match=r"a/result\.json") as error:
        compare([tmp_path / "a"], [tmp_path / "b"])
    assert len(str(error.value).splitlines()) == 1
