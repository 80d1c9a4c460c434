"""The arena seen from above and from two sides: fence, soft limit, keep-out zones, track."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from crazyarena import whole_file
from crazyarena.levels import Level
from crazyarena.safety.fence import Fence

_CELLS = 160
_VIEWS = (("x", "y", "z"), ("x", "z", "y"), ("y", "z", "x"))


def save_arena(path: Path, level: Level, fence: Fence, height: float) -> None:
    """Draw to a PNG.

    Each view is a cut: from above at ``height`` m, from the sides through the start's x and y.
    Green is allowed, yellow lies within the soft margin, red is a keep-out zone (dark: people).
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.colors import ListedColormap
    from matplotlib.figure import Figure

    low, high = (np.array(corner) for corner in fence.bounds)
    figure = Figure(figsize=(13, 5.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 3)
    colours = ListedColormap(["white", "#f6e27a", "#b8e0b0", "#e89090", "#8a1c1c"])
    start = np.array(level.start.position)
    for view, (across, up, through) in zip(axes, _VIEWS, strict=True):
        a, b, c = ("xyz".index(name) for name in (across, up, through))
        place = start.copy()
        place[2] = height
        pad = 0.3
        horizontal = np.linspace(low[a] - pad, high[a] + pad, _CELLS)
        vertical = np.linspace(low[b] - pad, high[b] + pad, _CELLS)
        cells = np.zeros((_CELLS, _CELLS))
        for i, v in enumerate(vertical):
            for j, h in enumerate(horizontal):
                point = place.copy()
                point[a], point[b] = h, v
                cells[i, j] = _kind(fence, *point.tolist())
        view.imshow(
            cells,
            origin="lower",
            extent=(horizontal[0], horizontal[-1], vertical[0], vertical[-1]),
            cmap=colours,
            vmin=0,
            vmax=4,
            interpolation="nearest",
        )
        view.set_xlabel(f"{across}, m")
        view.set_ylabel(f"{up}, m")
        view.set_title(f"{through} = {place[c]:.2f} m")
        for index, gate in enumerate(level.track.gates):
            span = 0.25 * np.array([np.cos(gate.yaw), np.sin(gate.yaw), 0.0])
            ends = np.array([gate.centre - span, gate.centre + span])
            view.plot(ends[:, a], ends[:, b], color="tab:blue", linewidth=2)
            view.annotate(str(index), (gate.centre[a], gate.centre[b]), color="tab:blue")
        for post in level.track.obstacles:
            spot = (post.x, post.y, post.z)
            view.plot(spot[a], spot[b], "s", color="black", markersize=4)
        view.plot(start[a], start[b], "^", color="black", label="start")
        goal = level.goal.position
        view.plot(goal[a], goal[b], "*", color="black", label="goal")
        view.set_aspect("equal")
    axes[0].legend(fontsize="small")
    figure.suptitle(f"{level.name}: hard fence, soft margin {fence.soft_margin:g} m")
    whole_file.save_figure(figure, path, dpi=120)


def _kind(fence: Fence, x: float, y: float, z: float) -> int:
    for zone in fence.zones:
        if zone.distance(x, y, z) < 0.0:
            return 4 if zone.people else 3
    room = fence.clearance(x, y, z)
    if room < 0.0:
        return 0
    return 1 if room < fence.soft_margin else 2
