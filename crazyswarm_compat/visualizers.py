"""Viewers of a simulated fleet: none, matplotlib (also headless), the viewer in the browser."""

from __future__ import annotations

import importlib.util
import os
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from crazyarena.crazyswarm_compat.live_visualizer import LiveVisualizer
from crazyarena.errors import DependencyMissing, InputError
from crazyarena.viewer_process import ViewOptions

Edges = Sequence[tuple[int, int]]


class VisNull:
    """Shows nothing.

    ``in_wall_time``: draws a fleet that is not simulated, too.
    """

    in_wall_time = False

    def setGraph(self, edges: Edges) -> None:
        """Draw lines between the vehicles ``(i, j)``, by index."""

    def showEllipsoids(self, radii: ArrayLike) -> None:
        """Draw an ellipsoid of ``radii`` (3,) m around every vehicle."""

    def follow(self, link: Any, guard: Any) -> None:
        """What the fleet flies on, and what guards it, if anything."""

    def update(self, t: float, crazyflies: Sequence[Any]) -> None:
        """Show the present positions, at time ``t`` s."""

    def render(self) -> NDArray[np.uint8] | None:
        """Picture of the last update, RGB (height, width, 3); None without one."""
        return None

    def close(self) -> None:
        """Idempotent."""


def _may_have_display() -> bool:
    """Whether a window could be opened, as far as that is known without matplotlib."""
    if not sys.platform.startswith("linux"):
        return True
    return any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY", "MPLBACKEND"))


class VisMatplotlib(VisNull):
    """Matplotlib window, or frames in memory where there is no display.

    Without a display nothing is drawn, nor even loaded, until somebody asks for a frame.
    """

    def __init__(self, flags: Any = None) -> None:
        self._figure: Any = None
        self._axes: Any = None
        self._points: Any = None
        self._lines: Any = None
        self._surfaces: list[Any] = []
        self._edges: Edges = ()
        self._radii: NDArray[np.float64] | None = None
        self._crazyflies: Sequence[Any] = ()
        self._t = 0.0
        self._stale = True
        self._interactive = False
        if _may_have_display():
            # Imported here because it takes longer than many a simulation.
            import matplotlib

            drawn_only = {"agg", "pdf", "svg", "ps"}
            self._interactive = matplotlib.get_backend().lower() not in drawn_only
        if self._interactive:
            self._open()

    def _open(self) -> None:
        if self._interactive:
            from matplotlib import pyplot

            pyplot.ion()
            self._figure = pyplot.figure(figsize=(8, 6))
        else:
            from matplotlib.backends.backend_agg import FigureCanvasAgg
            from matplotlib.figure import Figure

            self._figure = Figure(figsize=(8, 6))
            FigureCanvasAgg(self._figure)
        self._axes = self._figure.add_subplot(projection="3d")
        self._axes.set(xlim=(-5, 5), ylim=(-5, 5), zlim=(0, 3))
        self._axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")

    def setGraph(self, edges: Edges) -> None:
        self._edges = list(edges)

    def showEllipsoids(self, radii: ArrayLike) -> None:
        self._radii = np.asarray(radii, dtype=np.float64)

    def update(self, t: float, crazyflies: Sequence[Any]) -> None:
        self._t = t
        self._crazyflies = crazyflies
        self._stale = True
        if self._interactive:
            self._draw()
            self._figure.canvas.draw_idle()
            self._figure.canvas.flush_events()

    def _draw(self) -> None:
        from mpl_toolkits.mplot3d.art3d import Line3DCollection

        positions = np.array([cf.position() for cf in self._crazyflies]).reshape(-1, 3)
        colors = [cf.ledRGB for cf in self._crazyflies]
        x, y, z = positions.T
        if self._points is None or len(self._points.get_offsets()) != len(x):
            if self._points is not None:
                self._points.remove()
            self._points = self._axes.scatter(x, y, z, c=colors or None)
        else:
            self._points._offsets3d = (x, y, z)
            self._points.set_color(colors)
        if self._lines is not None:
            self._lines.remove()
            self._lines = None
        if self._edges:
            segments = [positions[[a, b]] for a, b in self._edges]
            self._lines = self._axes.add_collection3d(Line3DCollection(segments, colors="k"))
        for surface in self._surfaces:
            surface.remove()
        self._surfaces = []
        if self._radii is not None:
            u, v = np.mgrid[0 : 2 * np.pi : 12j, 0 : np.pi : 8j]
            sphere = np.array([np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v)])
            for center in positions:
                sx, sy, sz = center[:, None, None] + self._radii[:, None, None] * sphere
                self._surfaces.append(self._axes.plot_surface(sx, sy, sz, alpha=0.3))
        self._axes.set_title(f"t = {self._t:.2f} s")
        self._stale = False

    def render(self) -> NDArray[np.uint8]:
        if self._figure is None:
            self._open()
        if self._stale:
            self._draw()
        canvas: Any = self._figure.canvas
        canvas.draw()
        return np.asarray(canvas.buffer_rgba())[..., :3].copy()


class VisViser(LiveVisualizer, VisNull):
    """Scene in the browser; the address is printed when something first flies."""

    def __init__(self, port: int = 8080, pace: float = 1.0) -> None:
        if importlib.util.find_spec("viser") is None:
            raise DependencyMissing("viser", "viewer", "--vis viser")
        super().__init__(ViewOptions(port=port), pace)
        self.in_wall_time = pace == 0.0


def open_visualizer(name: str) -> VisNull:
    """Viewer for ``--vis name``; raises InputError for an unknown one."""
    kinds: dict[str, type[VisNull]] = {
        "null": VisNull,
        "mpl": VisMatplotlib,
        "viser": VisViser,
    }
    if name not in kinds:
        raise InputError(f"--vis: found {name!r}; expected one of {', '.join(kinds)}")
    return kinds[name]()
