"""How fast the competition profile flies: ticks per second, dry runs, start-up, memory.

Run: python benchmarks/sim_speed.py [--worlds 4096]. Figures are rates and multiples of real time
from one run on one machine; the last column is what was asked of it.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from crazyarena.levels import load_level
from crazyarena.levels.draw import Draw, LevelRandom
from crazyarena.runner.contestant.in_process import InProcess
from crazyarena.runner.contestant.submission import Submission
from crazyarena.runner.dry_run import example_racer
from crazyarena.runner.trial.trial import Trial
from crazyarena.sim_backend import competition_kernel as core
from crazyarena.sim_backend.competition import CompetitionBatch, CompetitionWorld

REPEATS = 5


def hovering(worlds: int) -> CompetitionBatch:
    """Worlds of level 0 in a hover at 1 m, past their take-off."""
    level = load_level("level0")
    batch = CompetitionBatch([LevelRandom(level).reset() for _ in range(worlds)])
    setpoint = np.zeros((worlds, 13))
    setpoint[:, :3] = [-0.9, -2.9, 1.0]
    batch.full_state(setpoint)
    for _ in range(15):
        batch.advance()
    return batch


def batch_rate(worlds: int, periods: int) -> float:
    """Firmware-and-physics ticks per second, all worlds together: the best of some repeats."""
    batch = hovering(worlds)
    best = 0.0
    for _ in range(REPEATS):
        begin = time.perf_counter()
        ticks = sum(batch.advance() for _ in range(periods))
        best = max(best, ticks * worlds / (time.perf_counter() - begin))
    return best


def single_rate(ticks: int = 200_000) -> float:
    """Ticks per second of one vehicle, without returning to Python."""
    batch = hovering(1)
    noise, trace = np.zeros((ticks, 7)), np.empty((0, 0))
    best = 0.0
    for _ in range(REPEATS):
        begin = time.perf_counter()
        core.advance(
            batch._bodies[0], batch._plants[0], batch._firmware[0], batch._gains, batch._memory,
            batch._scenes[0], batch._ground, batch._work[0], noise, ticks, trace,
        )  # fmt: skip
        best = max(best, ticks / (time.perf_counter() - begin))
    return best


class TimedWorld(CompetitionWorld):
    """Notes when each episode begins."""

    def __init__(self, control_rate: float) -> None:
        super().__init__(control_rate)
        self.begun: list[float] = []

    def reset(self, draw: Draw) -> None:
        self.begun.append(time.perf_counter())
        super().reset(draw)


def dry_run_multiple(record: bool, episodes: int = 8) -> float:
    """Flown seconds per second of the example's level-0 episodes, best of some.

    An episode lasts from its reset to the next: contestant, referee and, if asked, recording.
    The first is left out (it holds the constructor's planning), and so is the figure.
    """
    level = load_level("level0")
    world = TimedWorld(level.control_frequency)
    with (
        tempfile.TemporaryDirectory() as folder,
        Submission(example_racer(), Path(folder) / "work") as submission,
    ):
        out = Path(folder) if record else None
        result = Trial(level, InProcess(submission), world, episodes=episodes, out=out).run()
    world.close()
    wall = np.diff(world.begun)[1:]
    return result.episodes[1].flight_time / float(wall.min())


def command(*extra: str, cache: str | None = None) -> tuple[float, float]:
    """Wall seconds and peak memory (MB) of a whole ``crazyarena dry-run`` of one episode."""
    environment = dict(os.environ)
    if cache is not None:
        environment["XDG_CACHE_HOME"] = cache
    with tempfile.TemporaryDirectory() as folder:
        begin = time.perf_counter()
        line = [sys.executable, "-m", "crazyarena", "dry-run", "--episodes", "1", "--out", folder]
        subprocess.run([*line, *extra], env=environment, check=True, stdout=subprocess.DEVNULL)
        wall = time.perf_counter() - begin
    return wall, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", type=int, default=4096)
    arguments = parser.parse_args()
    command()  # fills the cache
    start_up, memory = command("--no-figure")
    with tempfile.TemporaryDirectory() as cache:
        cold, _ = command("--no-figure", cache=cache)
    rows = [
        ("one vehicle, ticks/s", f"{single_rate():,.0f}", "1,000,000"),
        (
            f"{arguments.worlds} worlds, ticks/s",
            f"{batch_rate(arguments.worlds, 10):,.0f}",
            "2,000,000",
        ),
        ("level-0 episode, recording, x real time", f"{dry_run_multiple(True):,.0f}", "150"),
        ("level-0 episode, --no-record, x real time", f"{dry_run_multiple(False):,.0f}", "300"),
        ("whole command, warm cache, s", f"{start_up:.1f}", ""),
        ("whole command, first ever (compiles), s", f"{cold:.1f}", "30"),
        ("peak memory of a dry run, MB", f"{memory:.0f}", "< 400"),
    ]
    print("| figure | measured | target |\n|---|---|---|")
    for name, measured, target in rows:
        print(f"| {name} | {measured} | {target} |")


if __name__ == "__main__":
    main()
