"""A flight in real time, stopped by every hand there is: what the vehicle does and what is told."""

from __future__ import annotations

import json
import os
import pty
import signal
import socket
import subprocess
import sys
import threading
import time

import pytest

from crazyarena.levels import load_level
from crazyarena.runner.records import export
from crazyarena.runner.rig.virtual_arena import VirtualArena
from crazyarena.sim_backend.firmware.supervisor import INFO_FLYING, INFO_LOCKED
from tests.runner.fakes import controller
from tests.runner.flying import STANDS

pytestmark = pytest.mark.slow

SECRET = b"correct horse battery staple"
# Up to 0.8 m, and there it stays.
ENTRY = controller(
    "rise = min(time / 3.0, 1.0)\n"
    "        place = [0.0, -0.5, max(0.05, 0.8 * rise)]\n"
    "        return Command.FULLSTATE, [place, [0]*3, [0]*3, 0.0, [0]*3]"
)
LEVEL = [
    "track.gates=[]",
    "track.obstacles=[]",
    "start.position=[0, -0.5, 0.03]",
    "goal.position=[2.5, 2.5, 1.5]",
    "episode_length=60.0",
]


class Flight:
    """``crazyarena fly`` in a terminal, and somebody who reads and presses keys there."""

    def __init__(self, folder, arena, *options):
        self.out = folder / "out"
        entry = folder / "entry.py"
        entry.write_text(ENTRY)
        self.environment = {**os.environ, "CRAZYARENA_RUNTIME_DIR": str(folder), "TERM": "dumb"}
        self._master, slave = pty.openpty()
        self._process = subprocess.Popen(
            [sys.executable, "-m", "crazyarena", "fly", str(entry), "--uri", arena.uri,
             "--mocap", "zenoh", "--mocap-host", arena.endpoint, "--yes", "--no-figure",
             "--out", str(self.out), "--waive", "e-stop tested", "--waive", "cf1 is body cf1",
             "--waive", "disk", "--max-misses", "100",
             *(word for one in LEVEL for word in ("--set", one)), *options],
            stdin=slave, stdout=slave, stderr=slave, env=self.environment, start_new_session=True,
        )  # fmt: skip
        os.close(slave)
        self.said = ""
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        self._holding = threading.Event()

    def _read(self):
        while True:
            try:
                text = os.read(self._master, 4096)
            except OSError:
                return
            if not text:
                return
            self.said += text.decode("utf-8", "replace")

    def press(self, key):
        os.write(self._master, key)

    def hold(self, key):
        """Until let_go(), as a terminal repeats a key."""

        def repeat():
            while not self._holding.wait(0.03):
                self.press(key)

        threading.Thread(target=repeat, daemon=True).start()

    def let_go(self):
        self._holding.set()

    def until(self, condition, what):
        deadline = time.monotonic() + 120.0
        while not condition():
            assert self._process.poll() is None, self.said
            assert time.monotonic() < deadline, f"{what}\n{self.said}"
            time.sleep(0.1)

    def until_said(self, words):
        self.until(lambda: words in self.said, f"never said: {words}")

    def until_flying(self):
        part = self.out / "episode_000.mcap.part"

        def high():
            if not part.exists() or part.stat().st_size < 20_000:
                return False
            return float(export.read(part).tables["state"][-1, 3]) > 0.5

        self.until(high, "it never flew")

    def interrupt(self):
        self._process.send_signal(signal.SIGINT)

    def shell(self, *arguments):
        """``crazyarena estop`` in another shell."""
        return subprocess.run(
            [sys.executable, "-m", "crazyarena", "estop", *arguments],
            env=self.environment, capture_output=True, text=True, timeout=60,
        )  # fmt: skip

    def end(self):
        """The episode, once it is over."""
        self._process.wait(120)
        self._reader.join(5)
        document = json.loads((self.out / "result.json").read_text())
        return document["episodes"][0]

    def close(self):
        self.let_go()
        if self._process.poll() is None:
            self._process.kill()
            self._process.wait()
        os.close(self._master)


@pytest.fixture
def arena(tmp_path):
    level = load_level("sim2real", LEVEL)
    with VirtualArena(level, level.seed, tmp_path) as arena:
        yield arena


@pytest.fixture
def fly(tmp_path, arena):
    flights = []

    def make(*options):
        flights.append(Flight(tmp_path, arena, *options))
        return flights[-1]

    yield make
    for flight in flights:
        flight.close()


def rules(episode):
    return [event["event"].removeprefix("safety: ") for event in episode["events"]]


def was_cut(arena, episode):
    assert episode["termination"] == "SAFETY", episode
    assert "emergency_stop" in rules(episode)
    arena.close()
    assert arena.report["supervisor"] & INFO_LOCKED
    assert not arena.report["supervisor"] & INFO_FLYING
    assert arena.report["position"][2] < 0.1


def was_landed(arena):
    time.sleep(STANDS)
    arena.close()
    assert not arena.report["supervisor"] & INFO_FLYING
    assert arena.report["position"][2] < 0.1


def test_the_space_bar_cuts(arena, fly):
    flight = fly()
    flight.until_said("stops the motors; Ctrl-C lands")
    flight.until_flying()
    flight.press(b" ")
    was_cut(arena, flight.end())


def test_another_shell_cuts(arena, fly):
    flight = fly()
    flight.until_flying()
    assert "stopped" in flight.shell("--reason", "enough").stdout
    was_cut(arena, flight.end())


def test_zenoh_cuts_with_the_token_alone(arena, fly, tmp_path):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    token, other = tmp_path / "token", tmp_path / "other"
    token.write_bytes(SECRET)
    other.write_bytes(SECRET[::-1])
    for file in (token, other):
        file.chmod(0o600)
    flight = fly("--stop-listen", endpoint, "--stop-token", str(token))
    flight.until_said("with the token")
    flight.until_flying()
    # From another machine: its own shells have no socket of this session.
    flight.environment = {**flight.environment, "CRAZYARENA_RUNTIME_DIR": str(tmp_path / "away")}
    (tmp_path / "away").mkdir()
    flight.shell("--connect", endpoint)
    flight.shell("--connect", endpoint, "--token", str(other))
    time.sleep(1.0)
    assert not (flight.out / "result.json").exists(), flight.said
    assert "cf1-" in flight.shell("--connect", endpoint, "--token", str(token)).stdout
    was_cut(arena, flight.end())


def test_ctrl_c_lands_and_once_more_cuts(arena, fly):
    flight = fly()
    flight.until_flying()
    flight.interrupt()
    flight.until_said("return-and-land")
    flight.interrupt()
    episode = flight.end()
    assert episode["termination"] == "INTERRUPTED"
    assert "emergency_stop" in rules(episode)
    arena.close()
    assert arena.report["supervisor"] & INFO_LOCKED


def test_ctrl_c_alone_brings_it_home(arena, fly):
    flight = fly()
    flight.until_flying()
    flight.interrupt()
    episode = flight.end()
    assert episode["termination"] == "INTERRUPTED"
    assert "emergency_stop" not in rules(episode)
    was_landed(arena)


def test_letting_go_of_the_dead_mans_key_lands(arena, fly):
    flight = fly("--dead-man", "key")
    flight.until_said("hold h now")
    time.sleep(1.0)
    assert "is armed" not in flight.said
    flight.hold(b"h")
    flight.until_flying()
    assert "is armed" in flight.said
    flight.let_go()
    episode = flight.end()
    assert episode["termination"] == "SAFETY"
    assert "dead_man" in episode["error"]
    assert "you may let go of h" in flight.said
    assert "emergency_stop" not in rules(episode)
    was_landed(arena)
