"""Two groups of flights in one picture: from above, over time, and their distance."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from crazyarena import whole_file
from crazyarena.plain_text import unmarked
from crazyarena.runner.records.compare import Comparison
from crazyarena.runner.records.figure import draw_track
from crazyarena.runner.records.ground import gate_line, ground_of

COLOURS = ("tab:blue", "tab:red")


def title(comparison: Comparison) -> str:
    """Names both sides: how many flights of what, on which level and vehicle."""
    levels = sorted({f.level for group in comparison.groups for f in group if f.level})
    sides = [
        f"{name} ({len(group)} flight{'s' * (len(group) != 1)}, vehicle {vehicle})"
        for name, group, vehicle in zip(
            comparison.names, comparison.groups, comparison.vehicles, strict=True
        )
    ]
    on = f" on {', '.join(levels)}" if levels else ""
    return f"{sides[1]} against {sides[0]}{on}"


def save_figure(file: Path, comparison: Comparison) -> None:
    """Write a PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 8), dpi=100)
    FigureCanvasAgg(figure)
    figure.suptitle(unmarked(title(comparison)), fontsize=11, x=0.02, ha="left")
    top = figure.add_axes((0.05, 0.1, 0.44, 0.8))
    rows = [figure.add_axes((0.56, 0.735 - 0.215 * i, 0.425, 0.17)) for i in range(4)]
    for axis in rows[1:]:
        axis.sharex(rows[0])
    _arena(top, comparison)
    for flights, colour, name in zip(comparison.groups, COLOURS, comparison.names, strict=True):
        for i, flight in enumerate(flights):
            label = unmarked(name) if i == 0 else None
            top.plot(*flight.position[:, :2].T, color=colour, lw=0.9, alpha=0.7, label=label)
    top.set_aspect("equal")
    top.set_xlabel("x [m]")
    top.set_ylabel("y [m]")
    top.grid(True, alpha=0.3)
    means = (comparison.mean_a, comparison.mean_b)
    stds = (comparison.std_a, comparison.std_b)
    time = comparison.time
    for i, axis_name in enumerate("xyz"):
        axis = rows[i]
        for mean, std, colour in zip(means, stds, COLOURS, strict=True):
            axis.plot(time, mean[:, i], color=colour, lw=1)
            low, high = mean[:, i] - std[:, i], mean[:, i] + std[:, i]
            axis.fill_between(time, low, high, color=colour, alpha=0.2, lw=0)
        axis.set_ylabel(f"{axis_name} [m]")
        axis.tick_params(labelbottom=False)
    for flights, colour in zip(comparison.groups, COLOURS, strict=True):
        gates = min(len(flight.gate_times) for flight in flights)
        for passed in np.mean([flight.gate_times[:gates] for flight in flights], axis=0):
            for axis in rows:
                axis.axvline(passed, color=colour, lw=0.8, alpha=0.4)
    last = rows[3]
    last.plot(time, 100 * comparison.distance, color="black", lw=1)
    worst = int(np.argmax(comparison.distance))
    last.plot(time[worst], 100 * comparison.distance[worst], "v", color="black", ms=5)
    last.set_title(
        f"{100 * comparison.distance.mean():.1f} cm apart on average, at most "
        f"{100 * comparison.distance[worst]:.1f} cm at {time[worst]:.2f} s",
        fontsize=8,
        loc="left",
        pad=3,
    )
    last.set_ylabel("distance [cm]")
    last.set_xlabel("time [s]; vertical lines: gates")
    for axis in rows:
        axis.grid(True, alpha=0.3)
    figure.legend(
        *top.get_legend_handles_labels(), loc="lower left", bbox_to_anchor=(0.05, 0.0), ncols=2,
        fontsize=8, frameon=False,
    )  # fmt: skip
    whole_file.save_figure(figure, file)


def _arena(axis: object, comparison: Comparison) -> None:
    """The track of the first flight that tells of one, and where those of the others differ."""
    courses = [f.course for group in comparison.groups for f in group if f.course is not None]
    if not courses:
        return
    first = courses[0]
    draw_track(axis, ground_of(first.level, first.gates, first.obstacles))
    for course in courses[1:]:
        if len(course.gates) != len(first.gates) or not np.allclose(course.gates, first.gates):
            for row in course.gates:
                axis.plot(*gate_line(row).T, color="tab:cyan", lw=2, alpha=0.6)  # type: ignore[attr-defined]
