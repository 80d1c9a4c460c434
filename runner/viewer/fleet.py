"""What moves, in the browser: vehicles, what they are told, where they would stop, their paths.

Fifty vehicles are as many messages as one: every kind of thing is one batch.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyarena.runner.viewer.solids import Array, ball, box, cylinder

# Colours of vehicles and of flights beside each other; told apart by people who see red and
# green alike (Okabe and Ito 2008).
PALETTE = np.array(
    [
        [0, 114, 178],
        [230, 159, 0],
        [0, 158, 115],
        [204, 121, 167],
        [86, 180, 233],
        [213, 94, 0],
        [240, 228, 66],
        [110, 110, 110],
    ],
    np.uint8,
)
_SETPOINT = (255, 190, 0)
_STOP = (220, 40, 30)
_NOSE = (40, 40, 40)
_ARM = 0.046  # m, from the middle to a motor
_DRAWN = 2.0  # times as large as it is: in a whole arena it would hardly be seen


def colours(count: int) -> NDArray[np.uint8]:
    """(count, 3) colours, told apart as long as there are few."""
    return PALETTE[np.arange(count) % len(PALETTE)]


def quadrotor() -> tuple[Array, NDArray[np.uint32]]:
    """A small X quadrotor, nose along +x; motors 92 mm apart across, drawn twice as large."""
    parts = [box((0.03, 0.03, 0.018))]
    for k in range(4):
        angle = (0.25 + 0.5 * k) * np.pi
        c, s = np.cos(angle), np.sin(angle)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        arm, arm_faces = box((_ARM, 0.007, 0.006))
        parts.append(((arm + [0.5 * _ARM, 0.0, 0.0]) @ turn.T, arm_faces))
        disc, disc_faces = cylinder(0.0225, 0.003)
        parts.append((disc + [_ARM * c, _ARM * s, 0.012], disc_faces))
    starts = np.cumsum([0] + [len(vertices) for vertices, _ in parts[:-1]])
    faces = [faces + np.uint32(start) for (_, faces), start in zip(parts, starts, strict=True)]
    vertices = np.concatenate([vertices for vertices, _ in parts])
    return _DRAWN * vertices, np.concatenate(faces)


def wxyz(quaternions: Array) -> Array:
    """Quaternions (n, 4) from our order x, y, z, w to viser's; what is none is no turn."""
    turned = quaternions[:, [3, 0, 1, 2]].copy()
    good = np.isfinite(turned).all(axis=1) & (np.abs(turned).sum(axis=1) > 0.0)
    turned[~good] = (1.0, 0.0, 0.0, 0.0)
    return turned


def linear(shades: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """sRGB colours 0..255 as the browser takes those of single points: linear in light."""
    share = shades.astype(np.float64) / 255.0
    light = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return np.round(255.0 * light).astype(np.uint8)


class _Batch:
    """As many copies of one mesh as there are places; those at NaN are not seen."""

    def __init__(self, scene: Any, name: str, mesh: tuple[Array, Any], **look: Any) -> None:
        self._scene, self._name, self._mesh, self._look = scene, name, mesh, look
        self._handle: Any = None
        self._count = -1

    def place(self, positions: Array, turns: Array | None = None, colour: Any = None) -> None:
        seen = np.asarray(np.isfinite(positions).all(axis=1))
        count = len(positions)
        where = np.where(seen[:, None], positions, 0.0).astype(np.float32)
        scales = seen.astype(np.float32)
        if turns is None:
            turns = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
        turns = turns.astype(np.float32)
        if self._handle is None or count != self._count:
            if self._handle is not None:
                self._handle.remove()
            look = dict(self._look)
            if colour is not None:
                look["batched_colors"] = colour
            self._handle = self._scene.add_batched_meshes_simple(
                self._name, *self._mesh, turns, where, batched_scales=scales, lod="off", **look
            )
            self._count = count
            self._last = (where, turns, scales)
            return
        handle, last = self._handle, self._last
        if not np.array_equal(where, last[0]):
            handle.batched_positions = where
        if not np.array_equal(turns, last[1]):
            handle.batched_wxyzs = turns
        if not np.array_equal(scales, last[2]):
            handle.batched_scales = scales
        if colour is not None and not np.array_equal(self._handle.batched_colors, colour):
            self._handle.batched_colors = colour
        self._last = (where, turns, scales)


class Fleet:
    """Draws vehicles into a viser server."""

    def __init__(self, scene: Any, ghosts: NDArray[np.float64] | None = None) -> None:
        """ghosts: (n,) opacity of each vehicle; None for as solid as they are."""
        look: dict[str, Any] = {"flat_shading": True, "side": "double", "cast_shadow": True}
        if ghosts is not None:
            look["batched_opacities"] = ghosts.astype(np.float32)
        self._scene = scene
        self._bodies = _Batch(scene, "/vehicles/bodies", quadrotor(), **look)
        nose, faces = box((0.022, 0.012, 0.012))
        self._noses = _Batch(
            scene,
            "/vehicles/noses",
            (_DRAWN * (nose + [0.024, 0.0, 0.0]), faces),
            batched_colors=_NOSE,
        )
        self._setpoints = _Batch(
            scene, "/vehicles/setpoints", ball((0.04, 0.04, 0.04)), batched_colors=_SETPOINT
        )
        self._stops = _Batch(
            scene,
            "/vehicles/predicted stop",
            ball((0.07, 0.07, 0.07)),
            batched_colors=_STOP,
            opacity=0.6,
        )
        self._shells: _Batch | None = None
        self._radii: tuple[float, ...] = ()
        self._links: Any = None
        self._ways: Any = None
        self._paths: Any = None

    def place(
        self,
        positions: Array,
        quaternions: Array,
        colour: NDArray[np.uint8] | None = None,
        setpoints: Array | None = None,
        stops: Array | None = None,
    ) -> None:
        """Positions (n, 3) m and attitudes (n, 4) x, y, z, w; further (n, 3) m, NaN for none."""
        turns = wxyz(quaternions)
        own = colours(len(positions)) if colour is None else colour
        self._bodies.place(positions, turns, linear(own))
        self._noses.place(positions, turns)
        nowhere = np.full_like(positions, np.nan)
        self._setpoints.place(nowhere if setpoints is None else setpoints)
        stops = nowhere if stops is None else stops
        self._stops.place(stops)
        ways = np.stack([positions, stops], axis=1)
        known = np.asarray(np.isfinite(ways).all(axis=(1, 2)))
        self._show_ways(ways[known])

    def drawn(self, positions: Array, edges: Any, radii: Any) -> None:
        """What a script draws: lines between vehicles by index, ellipsoids (3,) m around them."""
        ends = []
        for edge in edges if isinstance(edges, list) else ():
            if isinstance(edge, list) and len(edge) == 2:
                a, b = edge
                if isinstance(a, int) and isinstance(b, int) and max(a, b) < len(positions):
                    ends.append(positions[[a, b]])
        if self._links is not None:
            self._links.remove()
            self._links = None
        if ends:
            self._links = self._scene.add_line_segments(
                "/drawn/graph", np.array(ends), _NOSE, thickness=1.5, thickness_units="screen"
            )
        size = tuple(float(r) for r in radii) if isinstance(radii, list) else ()
        if len(size) != 3 or not np.isfinite(size).all():
            size = ()
        if size != self._radii:
            self._radii = size
            if self._shells is not None:
                self._shells.place(np.full((len(positions), 3), np.nan))
            self._shells = None
            if size:
                shell = ball([2.0 * radius for radius in size])
                self._shells = _Batch(
                    self._scene, "/drawn/ellipsoids", shell, batched_colors=_SETPOINT, opacity=0.15
                )
        if self._shells is not None:
            self._shells.place(positions)

    def _show_ways(self, ways: Array) -> None:
        if self._ways is None:
            if not len(ways):
                return
            self._ways = self._scene.add_line_segments(
                "/vehicles/way to stop", ways, _STOP, thickness=2.0, thickness_units="screen"
            )
        elif not np.array_equal(self._ways.points, ways.astype(np.float32)):
            self._ways.points = ways.astype(np.float32) if len(ways) else np.zeros((1, 2, 3))

    def segments(self, segments: NDArray[Any], shades: NDArray[np.uint8]) -> None:
        """Paths as (n, 2, 3) m with colours (n, 2, 3)."""
        if self._paths is not None:
            self._paths.remove()
            self._paths = None
        if len(segments):
            self._paths = self._scene.add_line_segments(
                "/paths",
                segments,
                linear(shades),
                thickness=2.5,
                thickness_units="screen",
            )
