"""Recordings for tests of the viewer."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from crazyarena.clock import WallClock
from crazyarena.levels import dump_level, load_level
from crazyarena.levels.draw import LevelRandom
from crazyarena.runner.records.recorder import Recorder
from crazyarena.runner.records.scene import scene_update
from crazyarena.sim_backend.trace import TR_POS, TR_QUAT, TR_SETPOINT, TR_TIME, TR_VEL, TRACE_SIZE


def circle(file: Path, seconds: float = 4.0, radius: float = 1.0, **metadata: str) -> Path:
    """Record a vehicle that flies one circle over level 1, 100 rows a second."""
    level = load_level("level1")
    draw = LevelRandom(level, 3).reset()
    about: dict[str, str] = {"level": level.name, "level_file": dump_level(level), **metadata}
    scene = scene_update(draw.gates, draw.obstacles, level)
    recorder = Recorder(file, about, scene, WallClock())
    recorder.step(rows(seconds, radius), np.zeros(34))
    recorder.event(1.0, 500, "gate passed", "gate 0")
    recorder.event(seconds, 500, "<b>odd</b>", "<script>document.title='taken'</script>")
    recorder.close()
    return file


def rows(seconds: float, radius: float) -> np.ndarray[Any, np.dtype[np.float64]]:
    time = np.arange(0.0, seconds + 0.005, 0.01)
    angle = 2 * math.pi * time / seconds
    rows = np.full((len(time), TRACE_SIZE), np.nan)
    rows[:, TR_TIME] = time
    place = np.stack([radius * np.cos(angle), radius * np.sin(angle), 1.0 + 0 * angle], axis=1)
    rows[:, TR_POS : TR_POS + 3] = place
    rows[:, TR_VEL : TR_VEL + 3] = np.gradient(place, 0.01, axis=0)
    rows[:, TR_QUAT : TR_QUAT + 4] = (0.0, 0.0, 0.0, 1.0)
    rows[:, TR_SETPOINT : TR_SETPOINT + 3] = place + [0.0, 0.0, 0.1]
    return rows
