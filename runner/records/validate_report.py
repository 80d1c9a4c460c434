"""Table and figure of a validation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from crazyarena import whole_file
from crazyarena.plain_text import shown_line
from crazyarena.runner.records.validate import PURE_DELAY, Pair, medians
from crazyarena.sim_backend.vehicles import Vehicle

_NAME = 20  # characters


def tables(pairs: Sequence[Pair], vehicle: Vehicle) -> list[Any]:
    """Rich tables that fit 80 columns: a row a flight, then the medians of each controller."""
    from rich import box
    from rich.table import Table

    title = f"{vehicle.name} against real flights"
    each = Table(title=title, box=box.SIMPLE_HEAD, collapse_padding=True, pad_edge=False)
    each.add_column("flight", overflow="fold", min_width=7, max_width=_NAME)
    each.add_column("", no_wrap=True)
    for name in ("RMSE", "aligned", "lag", "x", "y", "z", "hover"):
        each.add_column(name, justify="right", no_wrap=True)
    for pair in pairs:
        o = pair.outcome
        each.add_row(
            _short(o.name),
            o.controller[:3],
            _number(o.rmse),
            _number(o.aligned),
            f"{1000 * o.lag:+.0f}",
            *(f"{100 * value:+.1f}" for value in o.offset),
            f"{o.strength:.2f}" if o.calibrated else "model",
        )
    each.caption = (
        "m; lag ms behind reality; x, y, z mean offset cm; aligned: best clock offset within 50 ms"
    )
    of = Table(title="Medians", box=box.SIMPLE_HEAD, padding=(0, 1))
    of.add_column("", overflow="fold")
    for name in medians(pairs):
        of.add_column(name, justify="right", no_wrap=True)
    rows = (
        ("flights", "flights", "{:.0f}"),
        ("3-D RMSE, m", "rmse", "{:.3f}"),
        ("… with the best clock offset", "aligned", "{:.3f}"),
        ("horizontal RMSE, m", "plane", "{:.3f}"),
        ("… with the best clock offset", "plane_aligned", "{:.3f}"),
        ("simulation behind reality, s", "lag", "{:+.3f}"),
        ("take-off later than reality, s", "takeoff_difference", "{:+.2f}"),
        ("sag of the real battery, V", "sag_real", "{:.2f}"),
        ("sag of the simulated battery, V", "sag_simulated", "{:.2f}"),
        ("for comparison: perfect tracking, m", "ideal", "{:.3f}"),
        (f"for comparison: delay of {PURE_DELAY} s, m", "delayed", "{:.3f}"),
    )
    found = medians(pairs)
    for label, key, form in rows:
        of.add_row(
            label,
            *(
                form.format(group[key]) if math.isfinite(group[key]) else "-"
                for group in found.values()
            ),
        )
    return [each, of]


def _short(name: str) -> str:
    from rich.markup import escape

    name = shown_line(name)
    return escape(name) if len(name) <= _NAME else escape(name[: _NAME - 1]) + "…"


def _number(value: float) -> str:
    return f"{value:.3f}" if math.isfinite(value) else "-"


def save_figure(file: Path, pairs: Sequence[Pair], vehicle: Vehicle) -> None:
    """A page of the flights: paths from above, height over time and distance over time."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    count = len(pairs)
    figure, axes = plt.subplots(
        count, 3, figsize=(12.0, 2.6 * count + 0.6), squeeze=False, layout="constrained"
    )
    for (top, height, apart), pair in zip(axes, pairs, strict=True):
        o, time = pair.outcome, pair.simulated.time
        real = pair.real.pose.at(time)
        simulated = pair.simulated.position
        start = pair.real.start
        target = pair.real.setpoint
        if len(target):
            top.plot(*target.value[:, :2].T, color="0.8", lw=0.8)
            height.plot(target.time - start, target.value[:, 2], color="0.8", lw=0.8)
        for path, colour, label in ((real, "C0", "real"), (simulated, "C3", "simulated")):
            top.plot(path[:, 0], path[:, 1], color=colour, lw=1.0, label=label)
            height.plot(time - start, path[:, 2], color=colour, lw=1.0)
        top.set_aspect("equal", adjustable="datalim")
        top.set_title(f"{_short(o.name)} ({o.controller})", fontsize=8)
        apart.plot(time - start, np.linalg.norm(simulated - real, axis=1), color="C3", lw=1.0)
        apart.axhline(o.rmse, color="0.5", lw=0.8)
        apart.set_title(
            f"RMSE {o.rmse:.3f} m, aligned {o.aligned:.3f} m, lag {1000 * o.lag:+.0f} ms",
            fontsize=8,
        )
        apart.set_ylim(bottom=0.0)
        for axis, label in ((top, "y, m"), (height, "z, m"), (apart, "distance, m")):
            axis.set_ylabel(label, fontsize=8)
            axis.tick_params(labelsize=7)
            axis.grid(alpha=0.3)
    axes[0][0].legend(fontsize=7, loc="upper right")
    for axis, label in zip(axes[-1], ("x, m", "time, s", "time, s"), strict=True):
        axis.set_xlabel(label, fontsize=8)
    figure.suptitle(f"{vehicle.name} against real flights", fontsize=10)
    whole_file.save_figure(figure, file, dpi=100)
    plt.close(figure)
