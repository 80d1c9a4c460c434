"""One picture an episode, which answers why it ended: the way from above, its axes over time with
what happened on it, and how near the nearest thing was."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from crazyarena import whole_file
from crazyarena.levels.schema import Level
from crazyarena.plain_text import unmarked
from crazyarena.runner.records.bodies import distances, gate_openings
from crazyarena.runner.records.marks import Mark, marks
from crazyarena.safety.fence import Fence
from crazyarena.sim_backend.physics.sizes import (
    BASE_WIDTH,
    BEAM_LENGTH,
    BEAM_WIDTH,
    OBSTACLE_RADIUS,
    VEHICLE_RADIUS,
)
from crazyarena.sim_backend.trace import TR_POS, TR_SETPOINT, TR_TIME, TR_VEL

if TYPE_CHECKING:  # a process that draws need not load what judges
    from crazyarena.runner.judging.result import EpisodeResult

Array = NDArray[np.float64]

_GATE, _NOMINAL, _OBSTACLE, _FENCE = "tab:blue", "0.6", "tab:brown", "tab:green"
_MARKS = {"contact": "red", "violation": "darkorange", "safety": "purple", "late": "0.45"}
_MOST_ROWS = 2500  # of a path: more than the picture has points
_MOST_MARKS = 5  # named in a picture; the others are drawn
_FAR = 1.0  # m, what is further away than this is no matter of margins


@dataclass
class Picture:
    """What is drawn of an episode; plain enough to be handed to another process.

    time (n,) s, position, velocity and setpoint (n, 3), SI; setpoint is NaN before the first
    command. gates (k, 7) and obstacles (m, 6): true poses. ended: the run, s; then the way home.
    entities: the track as ``foxglove.SceneUpdate`` has it.
    """

    level: Level
    title: str
    time: Array
    position: Array
    velocity: Array
    setpoint: Array
    gates: Array
    obstacles: Array
    gate_times: Sequence[float] = ()
    marks: list[Mark] = field(default_factory=list)
    ended: float = math.inf
    entities: list[dict[str, Any]] = field(default_factory=list)


def picture(
    level: Level,
    result: EpisodeResult,
    states: Array,
    gates: Array,
    obstacles: Array,
    *,
    entities: list[dict[str, Any]] | None = None,
    commanded_from: float = -math.inf,
    isolated: bool = False,
) -> Picture:
    """What to draw of an episode just flown.

    Parameters
    ----------
    states: (n, TRACE_SIZE) ticks of the episode. gates, obstacles: (n, 7) and (m, 6), true poses.
    entities: the same track, solid by solid.
    commanded_from: s, when the first command went out; no setpoint is shown before.
    isolated: the contestant could not reach its judge; if not, the picture says so.
    """
    step = max(1, len(states) // _MOST_ROWS)
    kept = np.concatenate([states[:-1:step], states[-1:]])
    time = np.array(kept[:, TR_TIME])
    setpoint = np.array(kept[:, TR_SETPOINT : TR_SETPOINT + 3])
    # Beyond the run the crew brings the vehicle home, by commands of its own.
    setpoint[(time < commanded_from) | (time > result.flight_time + 0.1)] = np.nan
    title = (
        f"{level.name}, episode {result.index}: {result.why or result.termination}\n"
        f"{result.flight_time:.2f} s, {result.gates_passed}/{result.gates} gates"
        + ("" if isolated else " (not isolated)")
    )
    return Picture(
        level,
        title,
        time,
        np.array(kept[:, TR_POS : TR_POS + 3]),
        np.array(kept[:, TR_VEL : TR_VEL + 3]),
        setpoint,
        np.array(gates),
        np.array(obstacles),
        list(result.gate_times),
        marks(result.events),
        result.flight_time,
        entities or [],
    )


def save_figure(file: Path, shown: Picture) -> None:
    """Write a PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 8), dpi=100)
    FigureCanvasAgg(figure)
    title = "\n".join(unmarked(line) for line in shown.title.split("\n"))
    figure.suptitle(title, fontsize=11, x=0.02, ha="left")
    # Laid out by hand: solving for the layout takes as long as drawing.
    top = figure.add_axes((0.05, 0.15, 0.44, 0.765))
    colours = figure.add_axes((0.05, 0.055, 0.2, 0.018))
    rows = [figure.add_axes((0.56, y, 0.425, h)) for y, h in _ROWS]
    for axis in rows[1:]:
        axis.sharex(rows[0])
    draw_track(top, shown.level, shown.gates, shown.obstacles)
    _draw_path(figure, top, colours, shown)
    for axis, name, i in zip(rows, "xyz", range(3), strict=False):
        axis.plot(shown.time, shown.setpoint[:, i], color="0.5", lw=1, ls="--", label="commanded")
        axis.plot(shown.time, shown.position[:, i], color="tab:red", lw=1.2, label="flown")
        axis.set_ylabel(f"{name} [m]")
    _openings(rows[2], shown)
    _margins(rows[3], shown)
    for axis in rows:
        for passed in shown.gate_times:
            axis.axvline(passed, color=_GATE, lw=0.8, alpha=0.5)
        for mark in shown.marks:
            colour = _MARKS[mark.kind]
            axis.axvspan(mark.time, mark.until, color=colour, alpha=0.15, lw=0)
            axis.axvline(mark.time, color=colour, lw=0.8 if mark.kind == "late" else 1.2)
        if len(shown.time) and shown.time[-1] > shown.ended + 0.5:
            axis.axvspan(shown.ended, shown.time[-1], color="0.92", lw=0, zorder=0)
        axis.grid(True, alpha=0.3)
        if axis is not rows[-1]:
            axis.tick_params(labelbottom=False)
    rows[-1].set_xlabel("time [s]")
    _legend(figure, rows[2])
    _name_marks(figure, rows[0], shown.marks)
    whole_file.save_figure(figure, file)


_ROWS = ((0.755, 0.14), (0.585, 0.14), (0.36, 0.195), (0.16, 0.17))  # bottom, height of axes


def draw_track(axis: Any, level: Level, gates: Array, obstacles: Array) -> None:
    """Draw arena, gates (true, and where the level has them), obstacles and goal from above."""
    from matplotlib.patches import Circle, Rectangle

    draw_arena(axis, level)
    for gate, row in zip(level.track.gates, gates, strict=True):
        nominal = np.array(gate.row)
        if not np.allclose(nominal[[0, 1, 5]], row[[0, 1, 5]]):
            axis.plot(*gate_line(nominal), color=_NOMINAL, lw=2, ls=":")
    for i, row in enumerate(gates):
        axis.plot(*gate_line(row), color=_GATE, lw=4, solid_capstyle="butt")
        axis.annotate(str(i), row[:2], xytext=(6, 6), textcoords="offset points", color=_GATE)
    for row in obstacles:
        axis.add_patch(Circle(row[:2], OBSTACLE_RADIUS, color=_OBSTACLE))
        half = BASE_WIDTH / 2
        foot = Rectangle(row[:2] - half, BASE_WIDTH, BASE_WIDTH, fill=False, ec=_OBSTACLE)
        axis.add_patch(foot)
    goal = level.goal
    place = goal.position[0], goal.position[1]
    axis.add_patch(Circle(place, goal.tolerance, color="tab:green", alpha=0.4))
    axis.set_aspect("equal")
    axis.set_xlabel("x [m]")
    axis.set_ylabel("y [m]")
    axis.grid(True, alpha=0.3)


def draw_arena(axis: Any, level: Level) -> None:
    """Draw the outer limits from above."""
    from matplotlib.patches import Rectangle

    low, high = level.arena.low, level.arena.high
    size = high[0] - low[0], high[1] - low[1]
    axis.add_patch(Rectangle((low[0], low[1]), *size, fill=False, ls="--"))
    axis.set_xlim(low[0] - 0.3, high[0] + 0.3)
    axis.set_ylim(low[1] - 0.3, high[1] + 0.3)


def gate_line(row: Array) -> tuple[list[float], list[float]]:
    """Ends of a gate (7,) from above, xs and ys, m."""
    half = BEAM_LENGTH / 2
    x, y, yaw = row[0], row[1], row[5]
    ux, uy = half * math.cos(yaw), half * math.sin(yaw)
    return [x - ux, x + ux], [y - uy, y + uy]


def _draw_path(figure: Any, axis: Any, bar: Any, shown: Picture) -> None:
    from matplotlib.collections import LineCollection

    path = shown.position[:, :2]
    if not len(path):
        bar.set_visible(False)
        return
    speed = np.linalg.norm(shown.velocity, axis=1)
    finite = speed[np.isfinite(speed)]
    segments = np.stack([path[:-1], path[1:]], axis=1)
    lines = LineCollection(list(segments), cmap="plasma", lw=2)
    lines.set_array(speed[1:])
    lines.set_clim(0.0, max(0.1, float(finite.max()) if len(finite) else 0.1))
    axis.add_collection(lines)
    figure.colorbar(lines, cax=bar, orientation="horizontal")
    bar.set_title("speed [m/s]", fontsize=8, pad=3)
    bar.tick_params(labelsize=8)
    axis.plot(*path[0], "o", color="black", ms=6, mfc="white")
    axis.plot(*path[-1], "s", color="black", ms=5, mfc="white")
    # Beyond the arena, the picture goes along, but not to the end of the world.
    inside = path[np.isfinite(path).all(axis=1) & (np.abs(path) < 20.0).all(axis=1)]
    if len(inside):
        (x0, x1), (y0, y1) = axis.get_xlim(), axis.get_ylim()
        low, high = inside.min(axis=0) - 0.3, inside.max(axis=0) + 0.3
        axis.set_xlim(min(x0, low[0]), max(x1, high[0]))
        axis.set_ylim(min(y0, low[1]), max(y1, high[1]))
    for number, mark in enumerate(_named(shown.marks), 1):
        place = [np.interp(mark.time, shown.time, path[:, i]) for i in range(2)]
        axis.plot(*place, "x", color=_MARKS[mark.kind], ms=9, mew=2)
        axis.annotate(
            str(number), place, xytext=(-4, 7), textcoords="offset points", ha="right",
            color=_MARKS[mark.kind], fontweight="bold",
        )  # fmt: skip


def _named(found: Iterable[Mark]) -> list[Mark]:
    """Marks that are named: what touched or broke something first, by time."""
    order = {"contact": 0, "safety": 0, "violation": 1}
    found = [mark for mark in found if mark.kind in order]
    weighty = sorted(found, key=lambda mark: (order[mark.kind], -mark.time))
    return sorted(weighty[:_MOST_MARKS], key=lambda mark: mark.time)


def _openings(axis: Any, shown: Picture) -> None:
    """Heights of the gates' openings, when they were passed or where the way came nearest."""
    if not len(shown.time):
        return
    top = max(0.5, float(np.nanmax(shown.position[:, 2], initial=0.0)))
    span = max(0.15, 0.012 * float(shown.time[-1] - shown.time[0]))
    found = gate_openings(shown.entities)[: len(shown.gate_times) + 1]
    for i, (centre, half) in enumerate(found):
        passed = i < len(shown.gate_times)
        height = centre[2]
        if passed:
            when = shown.gate_times[i]
        else:
            after = shown.gate_times[-1] if shown.gate_times else -1.0
            away = np.linalg.norm(shown.position - centre, axis=1)
            away[shown.time < after] = np.inf
            when = float(shown.time[int(np.argmin(away))])
        top = max(top, height + half + 2 * BEAM_WIDTH)
        style = {"color": _GATE, "alpha": 1.0 if passed else 0.45}
        low, high = height - half, height + half
        axis.fill_between([when - span, when + span], low, high, alpha=0.15, color=_GATE, lw=0)
        for bar in (low - BEAM_WIDTH, high):
            axis.fill_between([when - span, when + span], bar, bar + BEAM_WIDTH, lw=0, **style)
        name = str(i) if passed else f"{i} (nearest)"
        axis.annotate(name, (when, high + BEAM_WIDTH), xytext=(0, 2), ha="center",
                      textcoords="offset points", fontsize=8, **style)  # fmt: skip
    axis.set_ylim(min(-0.05, axis.get_ylim()[0]), min(top * 1.12, 20.0))


def _margins(axis: Any, shown: Picture) -> None:
    """Distance to the nearest gate, obstacle and limit over time, and the least of each named."""
    finite = np.isfinite(shown.position).all(axis=1)
    time, path = shown.time[finite], shown.position[finite]
    axis.set_ylabel("to nearest [m]")
    axis.set_ylim(0.0, _FAR)
    axis.axhline(VEHICLE_RADIUS, color="0.6", lw=0.8, ls=":")
    if not len(time):
        return
    found = distances(path, shown.entities)
    for kind, colour in (("gate", _GATE), ("obstacle", _OBSTACLE)):
        mine = {name: far for name, far in found.items() if name.startswith(kind)}
        if mine:
            far = np.stack(list(mine.values()))
            which = np.unravel_index(int(np.argmin(far)), far.shape)
            _line(axis, time, far.min(axis=0), colour, list(mine)[int(which[0])])
    few = np.unique(np.linspace(0, len(time) - 1, min(len(time), 300)).astype(int))
    fence = Fence.from_arena(shown.level.arena)
    room = np.array([fence.room(*path[i].tolist()) for i in few])
    _line(axis, time[few], room, _FENCE, "limits")
    axis.set_ylim(min(0.0, float(room.min()), *(float(f.min()) for f in found.values())), _FAR)


def _line(axis: Any, time: Array, far: Array, colour: str, name: str) -> None:
    least = int(np.argmin(far))
    axis.plot(time, far, color=colour, lw=1.1, label=f"{name} {far[least]:.2f} m")
    axis.plot(time[least], far[least], "v", color=colour, ms=5)


def _legend(figure: Any, heights: Any) -> None:
    """Off the data: what lines and marks mean, below the axes."""
    axes = figure.axes
    lines, names = heights.get_legend_handles_labels()
    near, told = axes[-1].get_legend_handles_labels()
    told = [f"nearest {name}" for name in told]
    figure.legend(
        [*lines, *near], [*names, *told], loc="lower left", bbox_to_anchor=(0.56, 0.025),
        ncols=3, fontsize=8, frameon=False,
    )  # fmt: skip


def _name_marks(figure: Any, axis: Any, found: Sequence[Mark]) -> None:
    """Number the marks in an axis over time, and say below the way what they are."""
    chosen = _named(found)
    for row, mark in enumerate(chosen):
        colour, number = _MARKS[mark.kind], str(row + 1)
        axis.annotate(
            number, (mark.time, 1.0), xycoords=("data", "axes fraction"), xytext=(0, 2),
            textcoords="offset points", ha="center", color=colour, fontsize=9, fontweight="bold",
        )  # fmt: skip
        text = unmarked(f"{number}  {mark.time:.2f} s  {mark.text}")
        figure.text(0.27, 0.084 - 0.017 * row, text, color=colour, fontsize=8)
    late: dict[str, int] = {}
    for mark in found:
        if mark.kind == "late":
            late[mark.name] = late.get(mark.name, 0) + mark.count
    told = [f"{name} (×{count})" for name, count in late.items()]
    if told:
        figure.text(0.05, 0.012, "grey: " + ", ".join(told), color="0.3", fontsize=8)
    more = sum(mark.kind != "late" for mark in found) - len(chosen)
    if more > 0:
        figure.text(0.5, 0.012, f"and {more} more", color="0.3", fontsize=8)
