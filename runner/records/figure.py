"""One picture an episode, which answers why it ended: the way from above, its axes over time with
what happened on it, and how near the nearest thing was."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyarena import whole_file
from crazyarena.plain_text import unmarked
from crazyarena.runner.records.ground import Ground
from crazyarena.runner.records.marks import Mark
from crazyarena.runner.records.picture import Picture
from crazyarena.sim_backend.physics.sizes import BEAM_WIDTH, VEHICLE_RADIUS

Array = NDArray[np.float64]

_GATE, _NOMINAL, _OBSTACLE = "tab:blue", "0.6", "tab:brown"
_KINDS = {"gate": _GATE, "obstacle": _OBSTACLE, "limits": "tab:green"}
_MARKS = {"contact": "red", "violation": "darkorange", "safety": "purple", "late": "0.45"}
_MOST_MARKS = 5  # named in a picture; the others are drawn
_FAR = 1.0  # m, what is further away than this is no matter of margins


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
    draw_track(top, shown.ground)
    _draw_path(figure, top, colours, shown)
    for axis, name, i in zip(rows, "xyz", range(3), strict=False):
        if np.isfinite(shown.setpoint).any():  # attitudes are no places
            axis.plot(
                shown.time, shown.setpoint[:, i], color="0.5", lw=1, ls="--", label="commanded"
            )
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


def draw_track(axis: Any, ground: Ground) -> None:
    """Draw arena, gates (true, and where the level has them), obstacles and goal from above."""
    from matplotlib.patches import Circle, Rectangle

    low, high = ground.low, ground.high
    size = high[0] - low[0], high[1] - low[1]
    axis.add_patch(Rectangle((low[0], low[1]), *size, fill=False, ls="--"))
    axis.set_xlim(low[0] - 0.3, high[0] + 0.3)
    axis.set_ylim(low[1] - 0.3, high[1] + 0.3)
    for line in ground.nominal:
        axis.plot(*line.T, color=_NOMINAL, lw=2, ls=":")
    for i, line in enumerate(ground.gates):
        axis.plot(*line.T, color=_GATE, lw=4, solid_capstyle="butt")
        # Beyond its end: beside it may lie the place that the level file has.
        along = line[1] - line[0]
        place = line[1] + 0.15 * along / max(1e-9, float(np.linalg.norm(along)))
        axis.annotate(str(i), place, ha="center", va="center", color=_GATE)
    foot = ground.foot
    for place in ground.obstacles:
        axis.add_patch(Circle(place, ground.radius, color=_OBSTACLE))
        if foot:
            corner = place - foot / 2
            axis.add_patch(Rectangle(corner, foot, foot, fill=False, ec=_OBSTACLE))
    if ground.goal is not None:
        x, y, reach = ground.goal
        axis.add_patch(Circle((x, y), reach, color="tab:green", alpha=0.4))
    axis.set_aspect("equal")
    axis.set_xlabel("x [m]")
    axis.set_ylabel("y [m]")
    axis.grid(True, alpha=0.3)


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
    chosen = _named(shown.marks)
    places = np.array([[np.interp(mark.time, shown.time, path[:, i]) for i in range(2)]
                       for mark in chosen]).reshape(-1, 2)  # fmt: skip
    for mark, place in zip(chosen, places, strict=True):
        axis.plot(*place, "x", color=_MARKS[mark.kind], ms=9, mew=2)
    (x0, x1), (y0, y1) = axis.get_xlim(), axis.get_ylim()
    for number, first in numbered(places, 0.05 * max(x1 - x0, y1 - y0)):
        place, mark = places[first], chosen[first]
        axis.annotate(
            number, place, xytext=(-4, 7), textcoords="offset points", ha="right",
            color=_MARKS[mark.kind], fontweight="bold",
        )  # fmt: skip


def numbered(places: Array, near: float) -> list[tuple[str, int]]:
    """Numbers of marks as they can be read: those within ``near`` of the first of some are told
    with it, ``"2,3"``.

    places: (n, 1) s or (n, 2) m, in order. Returns texts, from 1, and the row of each first.
    """
    groups: list[list[int]] = []
    for row, place in enumerate(places):
        for group in groups:
            if np.linalg.norm(place - places[group[0]]) < near:
                group.append(row)
                break
        else:
            groups.append([row])
    return [(",".join(str(row + 1) for row in group), group[0]) for group in groups]


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
    for hole in shown.openings:
        top = max(top, hole.high + 2 * BEAM_WIDTH)
        style = {"color": _GATE, "alpha": 1.0 if hole.passed else 0.45}
        times = [hole.when - span, hole.when + span]
        axis.fill_between(times, hole.low, hole.high, alpha=0.15, color=_GATE, lw=0)
        for bar in (hole.low - BEAM_WIDTH, hole.high):
            axis.fill_between(times, bar, bar + BEAM_WIDTH, lw=0, **style)
        number = hole.gate.removeprefix("gate ")
        told = number if hole.passed else f"{number} (nearest)"
        axis.annotate(told, (hole.when, hole.high + BEAM_WIDTH), xytext=(0, 2), ha="center",
                      textcoords="offset points", fontsize=8, **style)  # fmt: skip
    axis.set_ylim(min(-0.05, axis.get_ylim()[0]), min(top * 1.12, 20.0))


def _margins(axis: Any, shown: Picture) -> None:
    """Distance to the nearest gate, obstacle and limit over time, and the least of each named."""
    axis.set_ylabel("to nearest [m]")
    axis.set_ylim(0.0, _FAR)
    axis.axhline(VEHICLE_RADIUS, color="0.6", lw=0.8, ls=":")
    for margin in shown.margins:
        colour = _KINDS[margin.kind]
        least = int(np.argmin(margin.far))
        label = f"{margin.name} {margin.far[least]:.2f} m"
        axis.plot(margin.time, margin.far, color=colour, lw=1.1, label=label)
        axis.plot(margin.time[least], margin.far[least], "v", color=colour, ms=5)
    axis.set_ylim(min(0.0, *(float(m.far.min()) for m in shown.margins), 0.0), _FAR)


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
    times = np.array([[mark.time] for mark in chosen]).reshape(-1, 1)
    begin, end = axis.get_xlim()
    for number, first in numbered(times, 0.02 * (end - begin)):
        axis.annotate(
            number, (chosen[first].time, 1.0), xycoords=("data", "axes fraction"), xytext=(0, 2),
            textcoords="offset points", ha="center", color=_MARKS[chosen[first].kind], fontsize=9,
            fontweight="bold",
        )  # fmt: skip
    for row, mark in enumerate(chosen):
        colour = _MARKS[mark.kind]
        text = unmarked(f"{row + 1}  {mark.time:.2f} s  {mark.text}")
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
