"""The motion-capture subcommands end to end, each in a process of its own."""

from __future__ import annotations

import subprocess
import sys

import pytest

from benchmarks.mocap_latency import free_port
from crazyarena.mocap.poselog import read_pose_log
from crazyarena.mocap.survey import read_track

COMMAND = [sys.executable, "-m", "crazyarena"]


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*COMMAND, *arguments], capture_output=True, text=True, timeout=120, check=False
    )


@pytest.fixture
def endpoint():
    """Server of circling cf1 and cf2 and the track of level0, over zenoh."""
    where = f"tcp/127.0.0.1:{free_port()}"
    server = subprocess.Popen(
        [*COMMAND, "mocap-server", "--protocol", "zenoh", "--listen", where, "--seconds", "100",
         "--body", "cf1", "--body", "cf2", "--level", "level0"],
        stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert server.stdout is not None
    assert "serving cf1, cf2, gate1" in server.stdout.readline()
    yield where
    server.kill()
    server.wait(5.0)


def test_check_finds_the_bodies_and_misses_the_absent(endpoint, tmp_path):
    log = tmp_path / "poses.mcap"
    result = run(
        "mocap-check", "zenoh", "--host", endpoint, "--seconds", "2",
        "--body", "cf1", "--body", "cf9", "--record", str(log),
    )  # fmt: skip
    assert result.returncode == 1, result.stderr
    assert "cf9 is not visible" in result.stdout
    assert "cf2: seen" in result.stdout
    frames = list(read_pose_log(log))
    assert len(frames) > 50
    assert {"cf1", "cf2", "gate1"} <= set().union(*(f.bodies for f in frames))


def test_survey_writes_the_track_or_refuses_it(endpoint, tmp_path):
    track = tmp_path / "track.json"
    result = run("mocap-survey", "level0", "zenoh", "--host", endpoint, "--output", str(track))
    assert result.returncode == 0, result.stdout + result.stderr
    assert "gate1" in read_track(track)
    track.unlink()
    result = run(
        "mocap-survey", "level0", "zenoh", "--host", endpoint, "--output", str(track),
        "--tolerance", "0",
    )  # fmt: skip
    assert result.returncode == 1
    assert "from its nominal place" in result.stdout
    assert not track.exists()


@pytest.mark.parametrize(
    "arguments",
    [
        ("mocap-check", "kinect"),
        ("mocap-check", "zenoh", "--option", "nonsense"),
        ("mocap-check", "zenoh", "--host", "nonsense"),
        ("mocap-check", "replay", "--option", "path=missing.mcap"),
        ("mocap-server", "--protocol", "smoke"),
        ("mocap-server", "--source", "replay", "--option", "speed=fast"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(arguments):
    result = run(*arguments)
    assert result.returncode == 2
    assert result.stderr.startswith("error: ")
    assert len(result.stderr.strip().splitlines()) == 1
