"""One picture an episode: the track from above with the path flown, and its axes over time."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyarena import whole_file
from crazyarena.levels.schema import Level
from crazyarena.plain_text import unmarked
from crazyarena.runner.judging.result import EpisodeResult
from crazyarena.sim_backend.physics.scene import BASE_WIDTH, BEAM_LENGTH, OBSTACLE_RADIUS
from crazyarena.sim_backend.trace import TR_POS, TR_SETPOINT, TR_TIME

_GATE, _NOMINAL, _OBSTACLE = "tab:blue", "0.6", "tab:brown"


def _gate_line(row: NDArray[np.float64]) -> tuple[list[float], list[float]]:
    half = BEAM_LENGTH / 2
    x, y, yaw = row[0], row[1], row[5]
    ux, uy = half * math.cos(yaw), half * math.sin(yaw)
    return [x - ux, x + ux], [y - uy, y + uy]


def _track(axis: Any, level: Level, gates: NDArray[Any], obstacles: NDArray[Any]) -> None:
    from matplotlib.patches import Circle, Rectangle

    low, high = level.arena.low, level.arena.high
    box = Rectangle((low[0], low[1]), high[0] - low[0], high[1] - low[1], fill=False, ls="--")
    axis.add_patch(box)
    for gate, row in zip(level.track.gates, gates, strict=True):
        nominal = np.array(gate.row)
        if not np.allclose(nominal[[0, 1, 5]], row[[0, 1, 5]]):
            axis.plot(*_gate_line(nominal), color=_NOMINAL, lw=2, ls=":")
    for i, row in enumerate(gates):
        axis.plot(*_gate_line(row), color=_GATE, lw=4, solid_capstyle="butt")
        axis.annotate(str(i), row[:2], xytext=(5, 5), textcoords="offset points", color=_GATE)
    for row in obstacles:
        axis.add_patch(Circle(row[:2], OBSTACLE_RADIUS, color=_OBSTACLE))
        half = BASE_WIDTH / 2
        foot = Rectangle(row[:2] - half, BASE_WIDTH, BASE_WIDTH, fill=False, ec=_OBSTACLE)
        axis.add_patch(foot)
    goal = level.goal
    axis.add_patch(
        Circle((goal.position[0], goal.position[1]), goal.tolerance, color="tab:green", alpha=0.4)
    )


def save_figure(
    file: Path,
    level: Level,
    result: EpisodeResult,
    states: NDArray[np.float64],
    gates: NDArray[np.float64],
    obstacles: NDArray[np.float64],
    *,
    isolated: bool = False,
) -> None:
    """Write a PNG.

    Parameters
    ----------
    states: (n, TRACE_SIZE) ticks of the episode.
    gates, obstacles: (n, 7) and (m, 6), true poses.
    isolated: the contestant could not reach its judge; if not, the figure says so.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    figure = Figure(
        figsize=(12, 6.5), dpi=100, layout=ConstrainedLayoutEngine(h_pad=0.08, w_pad=0.08)
    )
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(3, 2, width_ratios=[1.1, 1])
    top = figure.add_subplot(grid[:, 0])
    _track(top, level, gates, obstacles)
    path = states[:, TR_POS : TR_POS + 3]
    top.plot(path[:, 0], path[:, 1], color="tab:red", lw=1.3)
    if len(path):
        top.plot(*path[0, :2], "o", color="tab:red", ms=5)
        top.plot(*path[-1, :2], "x", color="tab:red", ms=8)
    top.set_aspect("equal")
    top.set_xlabel("x [m]")
    top.set_ylabel("y [m]")
    top.grid(True, alpha=0.3)
    top.set_title(
        unmarked(
            f"{level.name}, episode {result.index + 1}: {result.termination}, "
            f"{result.flight_time:.2f} s, {result.gates_passed}/{result.gates} gates"
            + ("" if isolated else " (not isolated)")
        ),
        fontsize=10,
    )
    time = states[:, TR_TIME]
    first = None
    for i, name in enumerate("xyz"):
        axis = figure.add_subplot(grid[i, 1], sharex=first)
        first = first or axis
        commanded = states[:, TR_SETPOINT + i]
        axis.plot(time, commanded, color="0.5", lw=1, ls="--", label="commanded")
        axis.plot(time, path[:, i], color="tab:red", lw=1.2, label="flown")
        for passed in result.gate_times:
            axis.axvline(passed, color=_GATE, lw=0.8, alpha=0.6)
        axis.set_ylabel(f"{name} [m]")
        axis.grid(True, alpha=0.3)
        if i == 0:
            axis.legend(loc="upper right", fontsize=8)
    axis.set_xlabel("time [s]")
    whole_file.save_figure(figure, file)
