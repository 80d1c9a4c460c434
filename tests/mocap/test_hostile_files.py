"""Spoilt pose logs, measured tracks and marker files: one line that names file and place."""

from __future__ import annotations

import json
import resource
import struct
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from crazyarena.clock import VirtualClock
from crazyarena.errors import InputError
from crazyarena.mocap.marker_config import read_constellations
from crazyarena.mocap.poselog import CSV_COLUMNS, PoseLogWriter, read_pose_log
from crazyarena.mocap.replay import ReplaySource
from crazyarena.mocap.survey import read_track
from crazyarena.types import Pose, PoseFrame

LEEWAY = settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=60
)
MAGIC = bytes((137, 77, 67, 65, 80, 48, 13, 10))
HEAD = ",".join(CSV_COLUMNS) + "\n"


def write_log(path, count: int = 20) -> bytes:
    with PoseLogWriter(path) as log:
        for k in range(count):
            bodies = {"cf1": Pose(np.array([0.1 * k, 0.0, 1.0]))}
            log.write(PoseFrame(0.01 * k, 0.01 * k + 0.004, k, bodies, np.ones((2, 3))))
    return path.read_bytes()


def told(path) -> str:
    """The error of reading all of it: a line, and it names the file."""
    with pytest.raises(InputError) as error:
        list(read_pose_log(path))
    text = str(error.value)
    assert path.name in text
    assert "\n" not in text
    return text


def chunk(kind: str, data: bytes, size: int) -> bytes:
    body = struct.pack("<QQQI", 0, 1, size, 0)
    body += struct.pack("<I", len(kind)) + kind.encode() + struct.pack("<Q", len(data)) + data
    return b"\x06" + struct.pack("<Q", len(body)) + body


def mcap_of(*parts: bytes) -> bytes:
    header = struct.pack("<II", 0, 0)
    return MAGIC + b"\x01" + struct.pack("<Q", len(header)) + header + b"".join(parts)


def bomb(kind: str, size: int) -> bytes:
    if kind == "zstd":
        import zstandard

        return zstandard.compress(bytes(size))
    import lz4.frame

    return lz4.frame.compress(bytes(size))


@pytest.mark.parametrize("kind", ["zstd", "lz4"])
@pytest.mark.parametrize("claims", ["true", "small", "huge"])
def test_a_bomb_ends_at_once_in_little_memory(tmp_path, kind, claims):
    size = 300 << 20
    data = bomb(kind, size)
    path = tmp_path / "bomb.mcap"
    stated = {"true": size, "small": 1000, "huge": 1 << 62}[claims]
    path.write_bytes(mcap_of(chunk(kind, data, stated)))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert "byte 25: a chunk" in told(path)
    # ru_maxrss never falls, so what the test itself used above does not count.
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 150_000


def test_lengths_that_are_lies_are_not_believed(tmp_path):
    path = tmp_path / "long.mcap"
    path.write_bytes(MAGIC + b"\x05" + struct.pack("<Q", 1 << 60))
    assert "byte 8" in told(path)
    path.write_bytes(mcap_of(chunk("brotli", b"x", 1)))
    assert "'brotli'" in told(path)


def test_what_stands_before_the_damage_is_replayed_and_the_place_is_told(tmp_path):
    path = tmp_path / "cut.mcap"
    whole = write_log(path, 30000)
    path.write_bytes(whole[: len(whole) // 2])
    source = ReplaySource(VirtualClock(), path, speed=float("inf"))
    count = 0
    while frames := source.frames():
        count += len(frames)
    assert 5000 < count < 30000
    assert "byte" in (source.status.error or "")


@LEEWAY
@given(st.integers(0, 10_000), st.binary(min_size=1, max_size=8))
def test_any_damage_of_a_log_is_a_line_or_harmless(tmp_path, at, what):
    for kind in ("mcap", "csv"):
        path = tmp_path / f"log.{kind}"
        whole = write_log(path)
        spot = at % len(whole)
        path.write_bytes(whole[:spot] + what + whole[spot + len(what) :])
        frames: list[PoseFrame] = []
        with suppress(InputError):
            frames.extend(read_pose_log(path))
        if not frames:
            told(path)
        for frame in frames:
            for pose in frame.bodies.values():
                assert np.isfinite(pose.position).all()
                assert abs(np.linalg.norm(pose.quaternion) - 1.0) < 0.01


@LEEWAY
@given(st.binary(max_size=400))
def test_anything_at_all_is_a_line(tmp_path, data):
    for name in ("any.mcap", "any.csv"):
        path = tmp_path / name
        path.write_bytes(data)
        told(path)


ROW = "0.0,0.0,1,cf1,0,0,1,0,0,0,1\n"


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ((HEAD + "0.0,0.0,1,cf1,0,0,1\n").encode(), "line 2: 7 columns, need 11"),
        ((HEAD + ROW + "0.0,0.0,x,cf1,0,0,1,0,0,0,1\n").encode(), "line 3"),
        ((HEAD + ROW.replace("0,0,1,0", "nan,0,1,0")).encode(), "finite"),
        ((HEAD + "inf" + ROW[3:]).encode(), "finite"),
        ((HEAD + ROW.replace("0,0,0,1\n", "0,0,0,2\n")).encode(), "norm 2"),
        ((HEAD + ROW + ROW).encode(), "'cf1' occurs twice"),
        ((HEAD + ROW.replace(",1,cf1", f",{'9' * 5000},cf1")).encode(), "line 2"),
        ((HEAD + ROW.replace(",1,cf1", ",-1,cf1")).encode(), "frame_id"),
        ((HEAD + "x" * 10_000).encode(), "line 2: longer than 4096"),
        ((HEAD + '"' + "a\n" * 100).encode(), "line"),
        (HEAD.encode() + b"0.0,\xff\xfe\n", "UTF-8"),
        ((HEAD + ROW.replace("cf1", "c\0f")).encode(), ""),
        (b"", "line 1"),
    ],
)
def test_a_bad_row_is_named_by_its_line(tmp_path, content, words):
    path = tmp_path / "log.csv"
    path.write_bytes(content)
    if words:
        assert words in told(path)
    else:
        list(read_pose_log(path))


def test_a_frame_without_end_stops_at_the_limit(tmp_path):
    path = tmp_path / "wide.csv"
    path.write_text(HEAD + "0.0,0.0,1,,1,1,1,,,,\n" * 20_000)
    assert "16384 markers" in told(path)


@pytest.mark.parametrize(
    "content",
    [
        b"[" * 100_000, b"\xff\xfe", b"{}", b"[]", b"null", b'{"format": "x"}',
        b'{"format": "crazyarena-measured-track", "version": 1, "bodies": []}',
        b'{"format": "crazyarena-measured-track", "version": 1, "bodies": {"a": 1}}',
        b'{"format": "crazyarena-measured-track", "version": 1, "bodies": {"a": {}}}',
        json.dumps({"format": "crazyarena-measured-track", "version": 1,
                    "bodies": {"a": {"position": [10**400, 0, 0],
                                     "quaternion": [0, 0, 0, 1]}}}).encode(),
        b" " * (5 << 20),
    ],
)  # fmt: skip
def test_a_bad_track_file_is_a_line(tmp_path, content):
    path = tmp_path / "track.json"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"track\.json") as error:
        read_track(path)
    assert "\n" not in str(error.value)


GOOD = """\
/motion_capture_tracking:
  ros__parameters:
    marker_configurations:
      default:
        offset: [0.0, 0.0, -0.01]
        points:
          p0: [0.0177184, 0.0139654, 0.0557585]
          p1: [-0.0262914, 0.0509139, 0.0402475]
"""


def test_markers_of_either_generation_are_read(tmp_path):
    path = tmp_path / "markers.yaml"
    path.write_text(GOOD)
    np.testing.assert_allclose(
        read_constellations(path)["default"][0], [0.0177184, 0.0139654, 0.0457585]
    )
    path.write_text(
        'markerConfigurations:\n  "0":\n    numPoints: 1\n    offset: [0.0, 0, 0]\n'
        '    points: {"0": [1.0, 2.0, 3.0]}\n'
    )
    np.testing.assert_allclose(read_constellations(path)["0"], [[1.0, 2.0, 3.0]])


BILLION = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{b}: &{b} [*{a}, *{a}, *{a}, *{a}, *{a}, *{a}, *{a}, *{a}, *{a}]\n"
    for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (GOOD.replace("0.0177184", "x").encode(), "points.p0"),
        (GOOD.replace("0.0177184", ".inf").encode(), "points.p0"),
        (GOOD.replace("0.0177184", "1" + "0" * 400).encode(), "points.p0"),
        (GOOD.replace("default:", "default: [").encode(), "line"),
        (b"\xff\xff\xff", "not YAML"),
        (b"marker_configurations: []", "no marker configurations"),
        (b"marker_configurations: {a: 3}", "need fields"),
        (BILLION.encode(), "line 2: not YAML: aliases"),
        (b"[" * 5000, "nested"),
        (b"marker_configurations: {a: {points: {" + b",".join(
            b"p%d: [0, 0, 0]" % i for i in range(100)) + b"}}}", "at most 64"),
        (b"#" * (2 << 20), "longer than"),
        (None, "cannot read"),
    ],
)  # fmt: skip
def test_a_bad_marker_file_is_a_line_that_names_the_field(tmp_path, content, words):
    path = tmp_path / "markers.yaml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=r"markers\.yaml") as error:
        read_constellations(path)
    assert words in str(error.value)
    assert "\n" not in str(error.value)


def test_a_spoilt_chunk_is_seen_by_its_checksum(tmp_path):
    path = tmp_path / "log.mcap"
    whole = bytearray(write_log(path))
    at = whole.index(b"cf1")
    whole[at + 1] ^= 1
    path.write_bytes(bytes(whole))
    assert "checksum" in told(path)
