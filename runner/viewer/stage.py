"""What stands still, in the browser: floor, track as built and as told, limits, start."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from crazyarena.runner.viewer.solids import Array, Lines, Mesh, bodies, box_edges, shape_edges

HARD = (0.85, 0.2, 0.15, 1.0)
SOFT = (0.95, 0.65, 0.15, 1.0)
KEEP_OUT = (0.75, 0.1, 0.45, 1.0)
_ROOM = {"low": [-2.0, -2.0, 0.0], "high": [2.0, 2.0, 2.0]}


def rgb(colour: Iterable[float]) -> tuple[int, int, int]:
    """Colour 0..1 as 0..255."""
    r, g, b = (round(255 * min(1.0, max(0.0, float(part)))) for part in list(colour)[:3])
    return r, g, b


class Stage:
    """Draws scenes (docs/viewer.md) into a viser server; each replaces the one before, and only
    what has changed is drawn anew."""

    def __init__(self, scene: Any) -> None:
        self._scene = scene
        self._drawn: dict[str, Any] = {}
        self._handles: dict[str, list[Any]] = {}
        self._part = ""
        scene.set_up_direction("+z")

    def show(self, fields: Mapping[str, Any]) -> None:
        """Draw a scene."""
        arena = fields.get("arena")
        arena = arena if isinstance(arena, Mapping) else {}
        if self._begin("arena", arena):
            self._floor(*self._bounds(arena))
            self._limits(arena)
        for name in ("track", "nominal", "drawn"):
            if self._begin(name, fields.get(name)):
                self._entities(name, fields.get(name))

    def _begin(self, part: str, fields: Any) -> bool:
        """Whether a part has to be drawn; what was drawn of it is gone then."""
        if part in self._drawn and self._drawn[part] == fields:
            return False
        for handle in self._handles.get(part, ()):
            handle.remove()
        self._drawn[part], self._handles[part], self._part = fields, [], part
        return True

    @staticmethod
    def bounds(fields: Mapping[str, Any]) -> tuple[Array, Array]:
        """Corners (3,) m of what a scene's camera should see."""
        arena = fields.get("arena")
        return Stage._bounds(arena if isinstance(arena, Mapping) else {})

    @staticmethod
    def _bounds(arena: Mapping[str, Any]) -> tuple[Array, Array]:
        try:
            low, high = np.array(arena["low"], float), np.array(arena["high"], float)
            if low.shape == high.shape == (3,) and bool(np.all(low < high)):
                return np.maximum(low, -100.0), np.minimum(high, 100.0)
        except (KeyError, TypeError, ValueError):
            pass
        return np.array(_ROOM["low"]), np.array(_ROOM["high"])

    def _floor(self, low: Array, high: Array) -> None:
        middle = 0.5 * (low + high)
        width, depth = (float(np.ceil(b - a)) + 2.0 for a, b in zip(low[:2], high[:2], strict=True))
        self._keep(
            self._scene.add_grid(
                "/floor",
                width=width,
                height=depth,
                position=(float(np.round(middle[0])), float(np.round(middle[1])), -0.001),
            )
        )

    def _limits(self, arena: Mapping[str, Any]) -> None:
        if "low" not in arena:
            return
        try:
            margin = float(arena.get("soft_margin", 0.0))
            low, high = np.array(arena["low"], float), np.array(arena["high"], float)
            hard, soft = [box_edges(low, high)], []
            inside = np.array([margin, margin, 0.0])
            soft.append(box_edges(low + inside, high - inside - [0.0, 0.0, margin]))
            for shape in arena.get("shapes", ()):
                hard.append(shape_edges(shape))
                if margin:
                    soft.append(shape_edges(shape, margin))
            zones = [shape_edges(zone["shape"]) for zone in arena.get("keep_out", ())]
        except (KeyError, TypeError, ValueError):
            return  # a recording from elsewhere
        self._lines("fence/hard", Lines(np.concatenate(hard), HARD), 2.0)
        if margin:
            self._lines("fence/soft margin", Lines(np.concatenate(soft), SOFT), 1.0)
        if zones:
            self._lines("fence/keep out", Lines(np.concatenate(zones), KEEP_OUT), 2.0)

    def _entities(self, name: str, entities: Any) -> None:
        meshes, lines = bodies(entities)
        for k, mesh in enumerate(meshes):
            self._mesh(f"{name}/{k}", mesh)
        for k, line in enumerate(lines):
            self._lines(f"{name}/lines {k}", line, 2.0)

    def _mesh(self, name: str, mesh: Mesh) -> None:
        alpha = mesh.colour[3]
        self._keep(
            self._scene.add_mesh_simple(
                f"/{name}",
                mesh.vertices,
                mesh.faces,
                color=rgb(mesh.colour),
                opacity=None if alpha >= 1.0 else alpha,
                flat_shading=True,
                side="double",
            )
        )

    def _lines(self, name: str, lines: Lines, thickness: float) -> None:
        if len(lines.segments):
            self._keep(
                self._scene.add_line_segments(
                    f"/{name}",
                    lines.segments,
                    rgb(lines.colour),
                    thickness=thickness,
                    thickness_units="screen",
                )
            )

    def _keep(self, handle: Any) -> None:
        self._handles[self._part].append(handle)
