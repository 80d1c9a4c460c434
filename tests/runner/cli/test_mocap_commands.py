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


def served(protocol: str) -> tuple[list[str], list[str]]:
    """Arguments of the server of a protocol, and of the client that finds it."""
    port = free_port()
    if protocol == "zenoh":
        where = f"tcp/127.0.0.1:{port}"
        return ["--listen", where], ["zenoh", "--host", where]
    ours = ["--port", str(port)]
    if protocol == "natnet":
        data = str(free_port())
        client = ["--host", "127.0.0.1", "--option", f"port_command={port}"]
        multicast = ["--multicast", "--y-up", "--data-port", data]
        client += ["--option", "interface_ip=127.0.0.1", "--option", "axes=y-up"]
        return [*ours, *multicast], ["optitrack", *client]
    if protocol == "vrpn":
        return ours, [
            "vrpn",
            "--host",
            f"tcp://localhost:{port}",
            "--option",
            "client=motioncapture",
        ]
    return ours, ["qualisys", "--host", "127.0.0.1", "--option", f"port={port}"]


@pytest.mark.realtime
@pytest.mark.parametrize("protocol", ["qualisys", "natnet", "vrpn", "zenoh"])
def test_check_and_survey_over_every_protocol_through_the_packages_own_client(protocol, tmp_path):
    ours, theirs = served(protocol)
    server = subprocess.Popen(
        [*COMMAND, "mocap-server", "--protocol", protocol, *ours, "--rate", "100",
         "--body", "cf1", "--level", "level0", "--seconds", "100"],
        stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert server.stdout is not None
        assert "serving cf1, gate1" in server.stdout.readline()
        bodies = ["cf1", *(f"gate{i}" for i in range(1, 5)), *(f"obstacle{i}" for i in range(1, 5))]
        asked = [word for body in bodies for word in ("--body", body)]
        result = run("mocap-check", *theirs, "--seconds", "3", *asked)
        assert not any("is missing in" in line for line in result.stdout.splitlines()), (
            result.stdout
        )
        assert not any("not visible" in line for line in result.stdout.splitlines())
        track = tmp_path / "track.json"
        result = run("mocap-survey", "level0", *theirs, "--output", str(track))
        assert result.returncode == 0, result.stdout + result.stderr
        assert set(read_track(track)) == set(bodies) - {"cf1"}
    finally:
        server.kill()
        server.wait(5.0)


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
