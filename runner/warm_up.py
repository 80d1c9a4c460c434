"""Compile on the first-ever run: the referee in a second process beside the simulator.

Numba compiles on one core at a time and keeps the result on disk, so two processes fill the
cache in little more than the time of the longer half.
"""

from __future__ import annotations

import subprocess
import sys

import numpy as np

from crazyarena.levels import load_level
from crazyarena.levels.draw import LevelRandom
from crazyarena.sim_backend.trace import TRACE_SIZE

_LEVEL = "level0"  # any level with gates and obstacles compiles the same kernels


def compile_competition() -> None:
    """Fill the cache with what a dry run of the competition profile needs."""
    beside = subprocess.Popen(
        [sys.executable, "-c", f"from {__name__} import compile_referee; compile_referee()"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        _compile_simulator()
    finally:
        # Should it have failed, the trial compiles the rest itself and shows the error.
        beside.wait()


def _compile_simulator() -> None:
    from crazyarena.sim_backend.competition import CompetitionWorld

    level = load_level(_LEVEL)
    world = CompetitionWorld(level.control_frequency)
    world.reset(LevelRandom(level).reset())
    world.clock.sleep_until(1.5 / level.control_frequency)
    world.close()


def compile_referee() -> None:
    """Judge one empty tick."""
    from crazyarena.runner.judging.referee import Referee

    level = load_level(_LEVEL)
    draw = LevelRandom(level).reset()
    referee = Referee(level)
    referee.begin(draw.gates, draw.obstacles)
    referee.judge(np.zeros((1, TRACE_SIZE)))
