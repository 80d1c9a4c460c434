"""Paths flown so far, of a live flight: what is sent to browsers once is not sent again.

A browser that draws slowly would otherwise fall behind the flight: its path grows all the time.
"""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyarena.runner.viewer.fleet import linear

_CHUNK = 2048  # points of all vehicles together, in a piece that is sent once
_MOST_SEGMENTS = 150_000  # that are shown at all; the oldest pieces go


class Trails:
    """Draws growing paths of ``count`` vehicles into a viser server."""

    def __init__(self, scene: Any) -> None:
        self._scene = scene
        self._pieces: deque[Any] = deque()
        self._tail: Any = None
        self._begun = 0  # number of the first point that is in no piece

    def clear(self) -> None:
        """Show nothing, and begin anew."""
        for piece in self._pieces:
            piece.remove()
        self._pieces.clear()
        self._show_tail(None)
        self._begun = 0

    def show(self, points: NDArray[Any], end: int, shades: NDArray[np.uint8]) -> None:
        """Show paths.

        Parameters
        ----------
        points: (n, k, 3) m, the newest of each path; end: how many there were in all.
        shades: (n, 3) colours.
        """
        count, known, _ = points.shape
        first = end - known  # number of points[:, 0]
        size = max(8, min(256, _CHUNK // max(1, count)))
        self._begun = max(self._begun, first)
        while end - self._begun > size:
            start = self._begun - first
            piece = points[:, start : start + size + 1]
            handle = self._lines(f"/paths/{self._begun}", piece, shades)
            if handle is not None:
                self._pieces.append(handle)
            self._begun += size
        while len(self._pieces) * size * count > _MOST_SEGMENTS:
            self._pieces.popleft().remove()
        self._show_tail(self._lines("/paths/newest", points[:, self._begun - first :], shades))

    def _show_tail(self, handle: Any) -> None:
        # A node of the same name has taken the place of the one before.
        if handle is None and self._tail is not None:
            self._tail.remove()
        self._tail = handle

    def _lines(self, name: str, points: NDArray[Any], shades: NDArray[np.uint8]) -> Any:
        segments = np.stack([points[:, :-1], points[:, 1:]], axis=2)
        good = np.isfinite(segments).all(axis=(2, 3))
        if not good.any():
            return None
        colours = np.broadcast_to(linear(shades)[:, None, None, :], segments.shape)
        return self._scene.add_line_segments(
            name,
            segments[good],
            np.ascontiguousarray(colours[good]),
            thickness=2.5,
            thickness_units="screen",
        )
