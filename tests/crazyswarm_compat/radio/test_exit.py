"""However a script over the radio ends, the interpreter ends in order: a thread of ours that is
inside a library then would abort it, and a flight that went well would look like a crash."""

from __future__ import annotations

import contextlib
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

FLEET = "crazyflies:\n- {id: 1, channel: 80, initialPosition: [0, 0, 0]}\n"
# What keeps the interpreter busy with its own end lets every thread that is left run into it.
SCRIPT = """\
import sys, time

class Lingers:
    def __del__(self, sleep=time.sleep):
        sleep(0.4)

lingers = Lingers()
from pycrazyswarm import Crazyswarm
swarm = Crazyswarm()
print("ready", flush=True)
"""
ENDS = {
    "the last line": ("", 0),
    "sys.exit": ("sys.exit(0)", 0),
    "a name that is gone": ("del swarm", 0),
    "close": ("swarm.allcfs.close()", 0),
    "an error": ("1 / 0", 1),
    "a thread of its own": (
        "import threading\n"
        "threading.Thread(target=lambda: [swarm.allcfs.crazyflies[0].position() or time.sleep(0.01)"
        " for _ in range(1000)], daemon=True).start()",
        0,
    ),
}


def free_port(kind: int) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@contextlib.contextmanager
def virtual_arena(*options: str) -> Iterator[list[str]]:
    """Flags of a script that finds one virtual vehicle and cameras that see it."""
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    port = free_port(socket.SOCK_DGRAM)
    command = [sys.executable, "-m", "crazyarena", "virtual-cf", "--port", str(port)]
    command += ["--mocap-endpoint", endpoint, *options]
    vehicle = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    with vehicle:
        try:
            assert vehicle.stdout is not None
            uri = vehicle.stdout.readline().strip()
            assert uri.startswith("udp://")
            yield ["--uri", uri, "--mocap", f"zenoh:{endpoint}", "--crazyflies-yaml", "list.yaml"]
        finally:
            vehicle.terminate()


@pytest.fixture(scope="module")
def arena() -> Iterator[list[str]]:
    with virtual_arena("--camera-noise") as flags:
        yield flags


def ended(folder: Path, ending: str, *flags: str) -> tuple[int, str, str]:
    """Run the script in a folder; its exit code, what it printed, and its errors."""
    (folder / "list.yaml").write_text(FLEET)
    (folder / "script.py").write_text(SCRIPT + ending + "\n")
    done = subprocess.run(
        [sys.executable, "script.py", *flags],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=240,
        stdin=subprocess.DEVNULL,
        check=False,
    )
    return done.returncode, done.stdout, done.stderr


@contextlib.contextmanager
def busy(count: int) -> Iterator[None]:
    """``count`` processes that do nothing but compute."""
    burners = [
        subprocess.Popen([sys.executable, "-c", "while True: pass"], stdin=subprocess.DEVNULL)
        for _ in range(count)
    ]
    try:
        yield
    finally:
        for burner in burners:
            burner.kill()
            burner.wait()


@pytest.mark.parametrize("how", ["the last line", "an error"])
def test_a_script_that_ends_ends_in_order(arena, tmp_path, how):
    ending, code = ENDS[how]
    found, out, errors = ended(tmp_path, ending, *arena)
    assert (found, out.split()[-1:]) == (code, ["ready"]), errors


@pytest.mark.slow
@pytest.mark.parametrize("guard", ["none", "level0"])
@pytest.mark.parametrize("how", list(ENDS))
def test_under_load_every_end_is_in_order(arena, tmp_path, how, guard):
    ending, code = ENDS[how]
    with busy(4):
        for _ in range(2):
            found, out, errors = ended(tmp_path, ending, *arena, "--guard", guard)
            assert (found, out.split()[-1:]) == (code, ["ready"]), errors


@pytest.mark.slow
def test_cameras_without_noise_are_named_as_what_a_guard_takes_for_frozen(tmp_path):
    with virtual_arena() as flags:
        code, _, errors = ended(tmp_path, "", *flags, "--guard", "level0")
    assert code == 1
    assert "cf1: a guard passes on no pose that repeats the last one to the bit" in errors
    assert "--camera-noise" in errors
