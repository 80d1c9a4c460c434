"""A flight through the whole hardware path in a process of its own, to be disturbed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import TracebackType
from typing import Any

from crazyarena.levels import load_level
from crazyarena.runner.records import export
from crazyarena.runner.rig.virtual_arena import VirtualArena

# A circle of 0.8 m diameter in 6 s, and some thinking about every point of it.
CIRCLE = """
import math, time as clock
from competition_utils import Command

class Controller:
    def __init__(self, initial_obs, initial_info, use_firmware=False, verbose=False):
        self.x, self.y = initial_obs[0], initial_obs[2]

    def cmdFirmware(self, time, obs, reward=None, done=None, info=None):
        clock.sleep({think})
        rise = min(time / 3.0, 1.0)
        rise = rise * rise * (3.0 - 2.0 * rise)
        w = 2.0 * math.pi / 6.0
        a = max(0.0, time - 3.0) * w
        x, y = self.x + 0.4 * math.sin(a), self.y + 0.4 * (1.0 - math.cos(a))
        v = [0.4 * w * math.cos(a), 0.4 * w * math.sin(a), 0.0] if a > 0.0 else [0, 0, 0]
        return Command.FULLSTATE, [[x, y, max(1.0 * rise, 0.05)], v, [0] * 3, 0.0, [0] * 3]
"""
EMPTY = [
    "track.gates=[]",
    "track.obstacles=[]",
    "start.position=[0, -0.5, 0.03]",
    "goal.position=[2.5, 2.5, 1.5]",
    "episode_length=15.0",
]
# s, after which a supervisor no longer takes a vehicle with its motors off for a flying one.
STANDS = 2.5
FLIGHT_PROCESS = "crazyarena.runner.rig.flight_process.server"


def crazyarena(*arguments: object, **options: Any) -> subprocess.Popen[str]:
    """Start the command with its output in a pipe."""
    return subprocess.Popen(
        [sys.executable, "-m", "crazyarena", *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        **options,
    )


def sets(overrides: list[str]) -> list[str]:
    return [word for override in overrides for word in ("--set", override)]


def is_alive(pid: int) -> bool:
    """Whether a process runs; one that has ended and is not yet buried does not."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"


def child_of(parent: int, module: str) -> int | None:
    """Process id of the child of ``parent`` that runs a module of ours."""
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            own = module.encode() in (folder / "cmdline").read_bytes()
            father = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
        except (OSError, IndexError):
            continue
        if own and father == parent:
            return int(folder.name)
    return None


class Flying:
    """``crazyarena fly`` in a virtual arena, in the air once the ``with`` block is entered.

    Attributes
    ----------
    runner: the process. pilot: process id of its flight process. part: the recording so far.
    flown: s of the run that were on disk when the block was entered.

    Parameters
    ----------
    seconds: it flies on for, if nobody disturbs it; longer than it takes to get ready for that.
    """

    def __init__(self, folder: Path, seconds: float = 15.0) -> None:
        self.folder = folder
        self.out = folder / "out"
        self.part = self.out / "episode_000.mcap.part"
        entry = folder / "circle.py"
        entry.write_text(CIRCLE.format(think=0.0))
        level = load_level("sim2real", EMPTY)
        self.arena = VirtualArena(level, level.seed, folder)
        # Emergency stops of a test are for its own flight.
        self.sockets = folder / f"crazyarena-{os.getuid()}"
        # Nobody is here to try things by hand.
        lines = ("e-stop tested", "cf1 is body cf1", "disk")
        waived = [word for line in lines for word in ("--waive", line)]
        self.runner = crazyarena(
            "fly", entry, "--uri", self.arena.uri, "--mocap", "zenoh", "--mocap-host",
            self.arena.endpoint, "--yes", "--no-figure", "--out", self.out, *waived,
            *sets([*EMPTY, f"episode_length={seconds}"]),
            env={**os.environ, "CRAZYARENA_RUNTIME_DIR": str(folder)}, stdin=subprocess.DEVNULL,
        )  # fmt: skip

    def __enter__(self) -> Flying:
        try:
            deadline = time.monotonic() + 120.0
            self.flown = 0.0
            while self.flown < 4.0:
                assert time.monotonic() < deadline, "it never flew"
                assert self.runner.poll() is None, self.runner.communicate()[0]
                time.sleep(0.3)
                if self.part.exists() and self.part.stat().st_size > 20_000:
                    self.flown = float(export.read(self.part).tables["state"][-1, 0])
            pilot = child_of(self.runner.pid, FLIGHT_PROCESS)
            assert pilot is not None
            self.pilot = pilot
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self.runner.poll() is None:
            self.runner.send_signal(signal.SIGCONT)
            self.runner.kill()
            self.runner.communicate()
        self.arena.close()

    def end(self, timeout: float = 60.0) -> tuple[dict[str, Any], str]:
        """Wait for the runner; returns the episode's result and what was printed."""
        printed, _ = self.runner.communicate(timeout=timeout)
        document = json.loads((self.out / "result.json").read_text())
        return document["episodes"][0], printed

    def vehicle(self) -> dict[str, Any]:
        """End the arena; returns where the vehicle was and its supervisor's word."""
        self.arena.close()
        return self.arena.report

    def vehicle_at_rest(self) -> dict[str, Any]:
        """The same, once its supervisor has had time to see that nothing flies any more."""
        time.sleep(STANDS)
        return self.vehicle()
