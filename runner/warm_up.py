"""Compile before the first flight, a part in each process, with a bar that shows how far it is.

Numba compiles on one core at a time and keeps the result on disk, so processes side by side fill
the cache in little more than the time of the longest part.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from crazyarena import jit
from crazyarena.levels import load_level
from crazyarena.levels.draw import LevelRandom
from crazyarena.levels.schema import Level, Profile
from crazyarena.sim_backend.trace import TRACE_SIZE

_LEVEL = "level0"  # any level with gates and obstacles compiles the same kernels
_LOOK = 0.2  # s, between looks at whether a part is done


@dataclass(frozen=True, slots=True)
class Part:
    """What is compiled together: ``modules`` whose kernels the function ``compile`` runs once."""

    name: str
    modules: tuple[str, ...]
    compile: Callable[[], None]


def _referee() -> None:
    from crazyarena.runner.judging.referee import Referee

    level = load_level(_LEVEL)
    draw = LevelRandom(level).reset()
    referee = Referee(level)
    referee.begin(draw.gates, draw.obstacles)
    referee.judge(np.zeros((1, TRACE_SIZE)))


def _competition() -> None:
    from crazyarena.sim_backend.competition import CompetitionWorld

    level = load_level(_LEVEL)
    world = CompetitionWorld(level.control_frequency)
    world.reset(LevelRandom(level).reset())
    world.clock.sleep_until(1.5 / level.control_frequency)
    world.close()


def _arena() -> None:
    from crazyarena.runner.rig.rig import simulated

    rig = simulated(load_level("sim2real"), 0)
    rig.stage(LevelRandom(load_level("sim2real")).reset())
    rig.clock.sleep_until(0.05)
    rig.close()


def _estimator() -> None:
    from crazyarena.mocap.estimator import PoseEstimator

    PoseEstimator(("cf1",)).warm_up()


def _successor() -> None:
    from crazyarena.levels.lsy import load_lsy_level
    from crazyarena.levels.lsy.draw import LsyRandom
    from crazyarena.sim_backend.successor import SuccessorWorld, nominal

    level = load_lsy_level("lsy/level0")
    world = SuccessorWorld(level)
    world.reset(LsyRandom(level, nominal(level), 0).reset())
    world.step(np.zeros(level.command_size))


REFEREE = Part("referee", ("runner.judging.referee_kernel",), _referee)
COMPETITION = Part(
    "firmware and physics of 2022", ("sim_backend.competition_kernel",), _competition
)
ARENA = Part("today's firmware and its vehicle", ("sim_backend.arena_kernel",), _arena)
ESTIMATOR = Part("pose estimator", ("mocap.estimator_kernels",), _estimator)
SUCCESSOR = Part("lsy_drone_racing's vehicle", ("sim_backend.successor_kernel",), _successor)
PARTS = {
    "referee": REFEREE,
    "competition": COMPETITION,
    "arena": ARENA,
    "estimator": ESTIMATOR,
    "successor": SUCCESSOR,
}


def parts_of(level: Level) -> tuple[str, ...]:
    """What a dry run of a level needs."""
    if level.profile is Profile.COMPETITION:
        return ("competition", "referee")
    return ("arena", "estimator", "referee")


def missing(names: Sequence[str]) -> list[str]:
    """Those of the parts that were never compiled here."""
    return [name for name in names if jit.is_cold(*PARTS[name].modules)]


def compile_missing(names: Sequence[str], console: Console) -> list[str]:
    """Compile those of the parts that are not in the cache yet; returns their names.

    A part that cannot be compiled is left to whoever needs it, and shows its error there.
    """
    todo = missing(names)
    if not todo:
        return []
    with Progress(
        TextColumn("Compiling {task.description} (only the first time)"),
        BarColumn(),
        TimeElapsedColumn(),
        console=console,
        transient=True,
        disable=not console.is_terminal,
    ) as progress:
        if not console.is_terminal:
            told = ", ".join(PARTS[name].name for name in todo)
            console.print(f"Compiling {told}; only the first run waits for this (< 1 min).")
        task = progress.add_task("the simulator", total=len(todo))
        workers = max(1, min(len(todo), os.cpu_count() or 1))
        waiting, running = list(todo), dict[str, subprocess.Popen[bytes]]()
        while waiting or running:
            while waiting and len(running) < workers:
                name = waiting.pop(0)
                running[name] = subprocess.Popen(
                    [sys.executable, "-m", __name__, name],
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                )
            names_now = ", ".join(PARTS[name].name for name in running)
            progress.update(task, description=names_now)
            with contextlib.suppress(subprocess.TimeoutExpired):
                next(iter(running.values())).wait(timeout=_LOOK)
            for name in [name for name, process in running.items() if process.poll() is not None]:
                del running[name]
                progress.advance(task)
    return todo


if __name__ == "__main__":
    PARTS[sys.argv[1]].compile()
