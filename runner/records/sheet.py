"""A contact sheet: the ways of many episodes from above, side by side in one picture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from crazyarena import whole_file
from crazyarena.plain_text import unmarked
from crazyarena.runner.records.ground import Ground

Array = NDArray[np.float64]

MOST_TILES = 120
_POINTS = 200
_GOOD, _BAD = "tab:green", "tab:red"


@dataclass
class Tile:
    """An episode on the sheet. path: (n, 2) m; gates: their ends (2, 2) m from above."""

    index: int
    clean: bool
    text: str
    path: Array
    gates: list[Array]


def tile(index: int, clean: bool, text: str, position: Array, gates: list[Array]) -> Tile:
    """Make a tile of an episode's positions (n, 3), which it thins out."""
    few = np.unique(np.linspace(0, max(0, len(position) - 1), _POINTS).astype(int))
    path = position[few, :2] if len(position) else np.empty((0, 2))
    return Tile(index, clean, text, np.array(path), gates)


def chosen(tiles: Sequence[Tile]) -> list[Tile]:
    """Those that a sheet has room for: failures before the others, by number."""
    first = sorted(tiles, key=lambda t: (t.clean, t.index))[:MOST_TILES]
    return sorted(first, key=lambda t: t.index)


def save_sheet(file: Path, ground: Ground, tiles: Sequence[Tile], isolated: bool = False) -> None:
    """Write a PNG: green ways completed cleanly, red ones did not; a cross where they ended."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.collections import LineCollection, PatchCollection
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

    shown = chosen(tiles)
    across = max(1, math.ceil(math.sqrt(len(shown) * 1.5)))
    down = max(1, math.ceil(len(shown) / across))
    low, high = np.array(ground.low[:2]), np.array(ground.high[:2])
    size = (high - low) * 1.06
    pitch = size + [0.0, 0.16 * size[1]]
    inches = 1.35
    figure = Figure(
        figsize=(across * inches + 0.3, down * inches * pitch[1] / pitch[0] + 0.7), dpi=100
    )
    FigureCanvasAgg(figure)
    head = 0.55 / figure.get_figheight()
    axis = figure.add_axes((0.01, 0.01, 0.98, 0.98 - head))
    ways: dict[str, list[Array]] = {_GOOD: [], _BAD: []}
    boxes, bars, ends = [], [], []
    # All in one axis: a hundred of them would take longer to draw than the flights to fly.
    for place, each in enumerate(shown):
        corner = np.array([place % across, down - 1 - place // across]) * pitch
        shift = corner - low
        colour = _GOOD if each.clean else _BAD
        path = np.clip(each.path, low - 0.03 * (high - low), high + 0.03 * (high - low)) + shift
        ways[colour].append(path)
        boxes.append(Rectangle(corner, *(high - low)))
        bars += [line + shift for line in each.gates]
        if len(path):
            ends.append((*path[-1], colour))
        axis.text(
            corner[0], corner[1] + high[1] - low[1], unmarked(f" {each.index}: {each.text}"),
            color=colour, fontsize=6.5, va="bottom", clip_on=True,
        )  # fmt: skip
    axis.add_collection(PatchCollection(boxes, fc="none", ec="0.7", lw=0.6))
    axis.add_collection(LineCollection(bars, colors="tab:blue", linewidths=1.6))
    for colour, paths in ways.items():
        axis.add_collection(LineCollection(paths, colors=colour, linewidths=0.9))
    for colour in ways:
        points = [(x, y) for x, y, own in ends if own == colour]
        if points:
            axis.plot(*zip(*points, strict=True), "x", color=colour, ms=4)
    axis.set_xlim(-0.02 * size[0], across * pitch[0])
    axis.set_ylim(-0.02 * size[1], down * pitch[1])
    axis.set_aspect("equal", anchor="N")
    axis.axis("off")
    clean = sum(t.clean for t in tiles)
    title = f"{ground.name}: {clean} of {len(tiles)} episodes clean" + (
        "" if isolated else " (not isolated)"
    )
    if len(shown) < len(tiles):
        title += f"; {len(shown)} are shown, all failures first"
    figure.suptitle(unmarked(title), fontsize=10, y=1.0 - 0.15 / figure.get_figheight(), va="top")
    whole_file.save_figure(figure, file)
