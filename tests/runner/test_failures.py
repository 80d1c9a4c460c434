"""What becomes of a run whose disk fills up or whose process is ended, from the command line."""

import json
import os
import resource
import signal
import subprocess
import sys

import pytest

from crazyarena.runner.records import export
from tests.runner.fakes import controller
from tests.runner.flying import crazyarena
from tests.waiting import eventually

# Hovers for two seconds; what it writes on standard output tells how far it is.
HOVER = controller(
    "if time == 0: return Command.TAKEOFF, [0.75, 1.0]\n        return Command.NONE, []"
)
SHORT = ["--set", "track.gates=[]", "--set", "track.obstacles=[]", "--set", "episode_length=2.0"]


@pytest.fixture
def pilot(tmp_path):
    file = tmp_path / "pilot.py"
    file.write_text(HOVER)
    return file


def result(folder):
    return json.loads((folder / "result.json").read_text())


def flown(folder):
    return len(result(folder)["episodes"]) if (folder / "result.json").exists() else 0


def check_readable(folder):
    """Every recording can be read, and the result tells of every one that is whole."""
    document = result(folder)
    told = {e["files"]["recording"] for e in document["episodes"] if "recording" in e["files"]}
    whole = {p.name for p in folder.glob("*.mcap")}
    # The last one may have been finished a moment before it could be told of.
    assert told <= whole | {p.name for p in folder.glob("*.mcap.part")}
    assert len(whole - told) <= 1
    for file in export.recordings(folder):
        recording = export.read(file)
        assert recording.complete == (file.suffix == ".mcap"), file
    return document


@pytest.mark.parametrize(
    "number",
    [
        signal.SIGTERM,
        pytest.param(signal.SIGHUP, marks=pytest.mark.slow),
        pytest.param(signal.SIGINT, marks=pytest.mark.slow),
    ],
)
def test_a_signal_ends_the_run_and_what_was_flown_is_reported(pilot, tmp_path, number):
    out = tmp_path / "out"
    run = crazyarena("dry-run", pilot, *SHORT, "--episodes", 100000, "--no-figure", "--out", out)
    eventually(lambda: flown(out) >= 2, timeout=120.0)
    run.send_signal(number)
    printed, _ = run.communicate(timeout=60)
    assert run.returncode == 1, printed
    assert "Traceback" not in printed
    assert "Results in" in printed
    document = check_readable(out)
    assert document["finished"] is True
    # Between two episodes there is nothing to interrupt.
    assert document["episodes"][-1]["termination"] in ("INTERRUPTED", "MAX EPISODE DURATION")
    assert 2 <= len(document["episodes"]) < 100000
    assert document["clean"] is False


def test_a_killed_run_leaves_what_was_flown(pilot, tmp_path):
    out = tmp_path / "out"
    run = crazyarena("dry-run", pilot, *SHORT, "--episodes", 100000, "--no-figure", "--out", out)
    eventually(lambda: flown(out) >= 3, timeout=120.0)
    run.kill()
    run.communicate(timeout=60)
    document = check_readable(out)
    assert document["finished"] is False
    assert len(document["episodes"]) >= 3
    assert document["requested_episodes"] == 100000
    again = crazyarena("dry-run", pilot, *SHORT, "--episodes", 1, "--out", out)
    printed, _ = again.communicate(timeout=120)
    assert again.returncode == 2
    assert "holds an older run" in printed


def test_a_closed_recording_is_not_counted_twice(tmp_path):
    (tmp_path / "episode_000.mcap").write_bytes(b"")
    (tmp_path / "episode_000.mcap.part").write_bytes(b"")
    (tmp_path / "episode_001.mcap.part").write_bytes(b"")
    names = [p.name for p in export.recordings(tmp_path)]
    assert names == ["episode_000.mcap", "episode_001.mcap.part"]


def limited(size):
    """For a process that may write no more than ``size`` bytes to one file."""
    return lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))


def test_a_recording_that_the_disk_refuses_ends_the_run_with_a_message(pilot, tmp_path):
    out = tmp_path / "out"
    run = crazyarena(
        "dry-run", pilot, *SHORT, "--episodes", 3, "--no-figure", "--out", out,
        preexec_fn=limited(60_000),
    )  # fmt: skip
    printed, _ = run.communicate(timeout=120)
    assert run.returncode == 2, printed
    assert "Traceback" not in printed
    told = printed.replace("\n", "")
    assert "episode_000.mcap: cannot write it: File too large; its beginning is in" in told
    document = result(out)
    (episode,) = document["episodes"]
    assert episode["termination"] == "MAX EPISODE DURATION"
    assert episode["files"] == {"recording": "episode_000.mcap.part"}
    recording = export.read(out / "episode_000.mcap.part")
    assert not recording.complete
    assert len(recording.tables["state"]) > 150
    names = sorted(p.name for p in out.iterdir())
    assert names == ["episode_000.mcap.part", "report.html", "result.json"]
    assert "The recording was cut short" in (out / "report.html").read_text()


@pytest.fixture
def small_disk(tmp_path):
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=1200k", "tmpfs", str(folder)]
    try:
        done = subprocess.run(mount, capture_output=True, check=False)
    except FileNotFoundError:
        pytest.skip("no mount here")
    if done.returncode:
        pytest.skip("may not mount a small disk here")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=False)


def test_a_full_disk_keeps_the_episodes_before_and_the_result(pilot, small_disk):
    out = small_disk / "out"
    run = crazyarena("dry-run", pilot, *SHORT, "--episodes", 50, "--no-figure", "--out", out)
    printed, _ = run.communicate(timeout=120)
    assert run.returncode == 2, printed
    assert "Traceback" not in printed
    assert "No space left on device" in printed.replace("\n", "")
    document = check_readable(out)
    assert document["finished"] is True
    assert 1 <= len(document["episodes"]) < 50
    assert os.path.getsize(out / "episode_000.mcap") > 100_000


@pytest.mark.slow
def test_a_full_disk_ends_an_evaluation_as_well(small_disk):
    from tests.runner.lsy_controllers import STATE

    file = small_disk.parent / "pilot.py"
    file.write_text(STATE)
    out = small_disk / "out"
    command = [
        sys.executable, "-m", "crazyarena", "evaluate", file, "--level", "lsy/level0", "--runs",
        "50", "--record", "--out", out,
    ]  # fmt: skip
    run = subprocess.run(
        [str(word) for word in command], capture_output=True, text=True, timeout=240, check=False
    )
    assert run.returncode == 2, run.stdout + run.stderr
    assert "Traceback" not in run.stderr
    assert "No space left on device" in run.stderr.replace("\n", "")
    assert 1 <= len(check_readable(out)["episodes"]) < 50
