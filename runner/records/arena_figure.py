"""The arena in three projections: fence, soft limit, keep-out zones and track, with heights."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from crazyarena import whole_file
from crazyarena.levels import Level
from crazyarena.plain_text import unmarked
from crazyarena.runner.records.bodies import bodies
from crazyarena.runner.records.scene import scene_update
from crazyarena.safety.fence import Fence

Array = NDArray[np.float64]

_CELLS = (72, 72, 32)
_EDGE = 1e-4  # m
_VIEWS = (("x", "y", "z"), ("x", "z", "y"), ("y", "z", "x"))
_OUTSIDE, _SOFT, _FREE, _ZONE, _PEOPLE = range(5)
_COLOURS = ("#ffffff", "#f6e27a", "#b8e0b0", "#e89090", "#8a1c1c")
_MEANINGS = ("", "within the soft margin", "allowed", "keep-out zone", "people")


def save_arena(path: Path, level: Level, fence: Fence, height: float) -> None:
    """Draw to a PNG: from above and from two sides, each along the whole third axis.

    A place is green where anything along the line of sight is allowed, yellow where nothing is
    but the soft margin, and hatched where a keep-out zone stands anywhere along it. What stands on
    the track is drawn with its true size. ``height`` m is marked in the views from the side.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.colors import ListedColormap
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    grid, kinds = _sampled(fence)
    figure = Figure(figsize=(14, 7.2), layout="constrained")
    FigureCanvasAgg(figure)
    mosaic = figure.subplot_mosaic("ab;ac", width_ratios=(1, 1.15))
    axes = [mosaic[name] for name in "abc"]
    colours = ListedColormap(list(_COLOURS))
    for view, (across, up, through) in zip(axes, _VIEWS, strict=True):
        a, b, c = ("xyz".index(name) for name in (across, up, through))
        free = np.where(kinds >= _ZONE, _OUTSIDE, kinds).max(axis=c)
        zones = np.where(kinds >= _ZONE, kinds, 0).max(axis=c)
        view.pcolormesh(grid[a], grid[b], free.T, shading="nearest", cmap=colours, vmin=0, vmax=4)
        if zones.any():
            view.contourf(
                grid[a], grid[b], (zones > 0).T.astype(float), levels=[0.5, 1.5], alpha=0.35,
                colors=[_COLOURS[int(zones.max())]], hatches=["//"],
            )  # fmt: skip
        _draw_track(view, level, a, b)
        if "z" in (across, up):
            view.axhline(height, color="0.4", lw=0.8, ls=":")
            low, high = fence.bounds[0][2], fence.bounds[1][2]
            for z in (low, high):
                view.annotate(f"{z:g} m", (1.0, z), xycoords=("axes fraction", "data"),
                              xytext=(5, 0), textcoords="offset points", va="center", fontsize=8,
                              color="0.3", annotation_clip=False)  # fmt: skip
        view.set_xlabel(f"{across} [m]")
        view.set_ylabel(f"{up} [m]")
        view.set_title(f"all of {through}, from {_side(through)}", fontsize=10)
        view.set_aspect("equal")
    handles: list[Any] = [Patch(fc=_COLOURS[k], label=_MEANINGS[k]) for k in (_FREE, _SOFT)]
    handles += [
        Patch(fc=_COLOURS[k], alpha=0.5, hatch="//", label=_MEANINGS[k])
        for k in (_ZONE, _PEOPLE)
        if (kinds == k).any()
    ]
    handles += axes[0].get_legend_handles_labels()[0]
    figure.legend(handles=handles, loc="outside lower center", ncols=6, fontsize=9, frameon=False)
    margin = f"hard fence, soft margin {fence.soft_margin:g} m; dotted: {height:g} m"
    figure.suptitle(unmarked(f"{level.name}: {margin}"))
    whole_file.save_figure(figure, path, dpi=100)


def _side(through: str) -> str:
    return {"z": "above", "y": "the side of low y", "x": "the side of low x"}[through]


def _sampled(fence: Fence) -> tuple[list[Array], NDArray[np.int64]]:
    """A grid over the arena, and of what kind each of its places is."""
    low, high = (np.array(corner, dtype=float) for corner in fence.bounds)
    pad = 0.05 * (high - low)
    grid = [np.linspace(low[k] - pad[k], high[k] + pad[k], cells) for k, cells in enumerate(_CELLS)]
    kinds = np.array(
        [[[_kind(fence, x, y, z) for z in grid[2]] for y in grid[1]] for x in grid[0]], dtype=int
    )
    return grid, kinds


def _kind(fence: Fence, x: float, y: float, z: float) -> int:
    for zone in fence.zones:
        if zone.distance(x, y, z) < 0.0:
            return _PEOPLE if zone.people else _ZONE
    room = fence.clearance(x, y, z)
    if room < 0.0:
        return _OUTSIDE
    return _SOFT if room < fence.soft_margin else _FREE


def _draw_track(view: Any, level: Level, a: int, b: int) -> None:
    """What stands on the track, with its true size, and names with heights."""
    gates = np.array([[*g.row[:2], g.centre[2], *g.row[3:]] for g in level.track.gates])
    obstacles = np.array([post.row for post in level.track.obstacles])
    scene = scene_update(gates.reshape(-1, 7), obstacles.reshape(-1, 6), level)["entities"]
    for entity in scene:
        name = str(entity["id"])
        if name == "goal":
            continue
        gate = name.startswith("gate")
        colour = "tab:blue" if gate else "tab:brown"
        corners = []
        for body in bodies(entity):
            corners.append(body.corners())
            _draw_outline(view, corners[-1][:, [a, b]], colour)
        every = np.concatenate(corners)
        number = int(name.split()[1])
        text = f"{number}" if gate else ""
        if b != 2:  # heights are to be seen in the other views
            high = level.track.gates[number].centre[2] if gate else every[:, 2].max()
            text = f"{number}: {high:.2f} m" if gate else f"{high:.2f} m"
        place = every[:, a].mean(), every[:, b].max()
        view.annotate(text, place, xytext=(0, 2), textcoords="offset points", fontsize=7,
                      ha="center", color=colour)  # fmt: skip
    start, goal = level.start.position, level.goal.position
    view.plot(start[a], start[b], "^", color="black", ls="none", label="start")
    view.plot(goal[a], goal[b], "*", color="black", ls="none", label="goal")
    for spot in (start, goal) if b != 2 else ():
        view.annotate(f"{spot[2]:.2f} m", (spot[a], spot[b]), xytext=(6, -3), fontsize=7,
                      textcoords="offset points")  # fmt: skip


def _draw_outline(view: Any, points: Array, colour: str) -> None:
    from matplotlib.patches import Polygon

    with contextlib.suppress(QhullError):  # seen along an edge
        points = points[ConvexHull(points).vertices]
    view.add_patch(Polygon(points, fc=colour, ec=colour, alpha=0.75, lw=0.8))
