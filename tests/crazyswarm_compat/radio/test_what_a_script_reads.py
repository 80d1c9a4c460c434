"""What docs/hardware.md says that a script's user reads, against what is printed: a script over a
virtual dongle, as it is started, and something that happens to it in flight."""

from __future__ import annotations

import contextlib
import re
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from crazyarena.sim_backend.crazyradio.environment import with_dongles
from tests.sim_backend.crtp.virtual_process import VirtualProcess, virtual_process

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[3]
DOCUMENT = ROOT / "docs" / "hardware.md"
PATIENCE = 120.0  # s

SCRIPT = """\
import sys
from pycrazyswarm import Crazyswarm

swarm = Crazyswarm("crazyflies: [{id: 1, channel: 80, initialPosition: [0, 0, 0]}]")
swarm.allcfs.takeoff(0.8, 1.0)
swarm.timeHelper.sleep(2.0)
print("flying", flush=True)
sys.stdin.readline()
swarm.timeHelper.sleep(float(sys.argv[1]))
swarm.allcfs.land(0.04, 2.0)
swarm.timeHelper.sleep(3.0)
print("landed", flush=True)
"""


def documented(mark: str) -> str:
    """The console block of the document that is marked with a comment."""
    text = DOCUMENT.read_text(encoding="utf-8")
    (block,) = re.findall(rf"^<!-- {mark} -->\n```\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    return block


def pattern(line: str) -> str:
    """A documented line with any numbers, and anything for an ellipsis."""
    numbers = re.sub(r"\d+\\\.\d+", r"\\d+\\.\\d+", re.escape(line.strip()))
    return numbers.replace("…", ".*")


class Flight:
    """A script in flight over the virtual dongle."""

    def __init__(self, folder: Path, vehicle: VirtualProcess) -> None:
        (folder / "flight.py").write_text(SCRIPT, encoding="utf-8")
        self._folder = folder
        self._environment = with_dongles(vehicle.air)
        self._process = self.start(4.0)
        self.said: list[str] = []
        self._heard = threading.Condition()
        self._readers = [
            threading.Thread(target=self._read, args=(stream,), daemon=True)
            for stream in (self._process.stdout, self._process.stderr)
        ]
        for reader in self._readers:
            reader.start()
        self.until("flying")

    def start(self, seconds: float) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, "flight.py", str(seconds)],
            cwd=self._folder,
            env=self._environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def _read(self, stream) -> None:
        for line in stream:
            with self._heard:
                self.said.append(line.rstrip())
                self._heard.notify_all()

    def until(self, words: str) -> None:
        with self._heard:
            heard = self._heard.wait_for(
                lambda: (
                    any(words in line for line in self.said) or self._process.poll() is not None
                ),
                PATIENCE,
            )
        assert heard, self.said
        assert any(words in line for line in self.said), self.said

    def go_on(self) -> None:
        self._process.stdin.write("\n")
        self._process.stdin.flush()

    def end(self) -> tuple[int, list[str]]:
        code = self._process.wait(PATIENCE)
        for reader in self._readers:
            reader.join(10.0)
        for stream in (self._process.stdin, self._process.stdout, self._process.stderr):
            stream.close()
        return code, self.said


@pytest.fixture
def flight(tmp_path):
    with contextlib.ExitStack() as stack:

        def make() -> tuple[Flight, VirtualProcess]:
            options = ("--radio", "--radio-port", "0", "--feed-poses", "100")
            vehicle = stack.enter_context(virtual_process(*options))
            return Flight(tmp_path, vehicle), vehicle

        yield make


def read(lines: list[str], mark: str) -> None:
    """Every documented line is there, in that order."""
    left = list(lines)
    for wanted in documented(mark).splitlines():
        while left and not re.search(pattern(wanted), left[0]):
            left.pop(0)
        assert left, f"{wanted!r} is not among {lines}"


@pytest.mark.parametrize(
    ("mark", "happens"),
    [
        ("killed", None),
        ("out of range", "cf1 cut 60s"),
        ("restarted", "cf1 reboot"),
        ("unplugged", "unplug 0"),
    ],
)
def test_a_vehicle_that_is_gone(mark, happens, flight):
    flown, vehicle = flight()
    flown.go_on()
    if happens is None:
        vehicle.close()
    else:
        vehicle.command(happens)
    code, said = flown.end()
    print("\n".join(said))
    assert code == 1
    assert "landed" not in said
    read(said, mark)


def test_a_dongle_that_is_plugged_in_again(flight):
    flown, vehicle = flight()
    flown.go_on()
    vehicle.command("unplug 0")
    flown.until("was it unplugged?")
    vehicle.command("plug 0")
    code, said = flown.end()
    print("\n".join(said))
    read(said, "plugged in again")
    assert code == 0


@pytest.mark.parametrize("happens", ["loss 20%", "latency 50ms"])
def test_a_link_that_is_bad(happens, flight):
    flown, vehicle = flight()
    vehicle.command(happens)
    flown.go_on()
    code, said = flown.end()
    print("\n".join(said))
    assert code == 0
    assert "landed" in said
    assert not [line for line in said if "cf1" in line]


def test_a_second_program(flight):
    flown, _ = flight()
    second = flown.start(0.0)
    out, err = second.communicate("\n", timeout=PATIENCE)
    print(out, err)
    assert second.returncode == 1
    read(err.splitlines(), "second program")
    flown.go_on()
    code, said = flown.end()
    assert code == 0
    assert not [line for line in said if "cf1" in line]
