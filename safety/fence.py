"""The arena as the watchdog sees it: where a vehicle may be, and how far that is from here."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from crazyarena.errors import InputError
from crazyarena.levels import Arena, GateType, Level, ShapeKind
from crazyarena.levels import Shape as ShapeSpec
from crazyarena.safety.shapes import Bounds, Box, Cylinder, Polytope, Prism, Shape, Union

Point = tuple[float, float, float]

_PROBE = 1e-4  # m, step of the numerical gradient
_GROUND = 0.01  # m, above the soft limit of the bottom: where standing vehicles are looked at


@dataclass(frozen=True, slots=True)
class Zone:
    """A solid to stay out of, by ``margin`` m."""

    name: str
    shape: Shape
    margin: float
    people: bool = False

    def distance(self, x: float, y: float, z: float) -> float:
        """Distance left until the margin is used up, m; negative inside."""
        return -self.shape.clearance(x, y, z) - self.margin


class Fence:
    """Where a vehicle may be.

    The fence has no floor: vehicles stand on it, and it stops them by itself. Points between
    the bottom of the arena and ``floor``, just above the soft limit, count as lying there.

    Parameters
    ----------
    box: hard outer limits, always in force.
    shapes: the vehicle must be in at least one of them as well; none for the box alone.
    soft_margin: distance of the soft limit inside the hard one, m.
    zones: to stay out of.

    Raises
    ------
    InputError: limits that contradict each other.
    """

    def __init__(
        self,
        box: Bounds,
        shapes: Iterable[Shape] = (),
        soft_margin: float = 0.05,
        zones: Iterable[Zone] = (),
    ) -> None:
        self.box = Box(*box)
        inner = tuple(shapes)
        self.shape: Shape | None = None
        if inner:
            self.shape = inner[0] if len(inner) == 1 else Union(inner)
        self.soft_margin = soft_margin
        self.zones = tuple(zones)
        self.people_zones = tuple(zone for zone in self.zones if zone.people)
        low, high = self.box.bounds
        if any(b - a <= 2.0 * soft_margin for a, b in zip(low, high, strict=True)):
            raise InputError(
                f"fence: soft_margin {soft_margin} m leaves nothing of the box {low} .. {high}"
            )
        if self.shape is not None:
            (lx, ly, lz), (hx, hy, hz) = self.shape.bounds
            if lx >= high[0] or ly >= high[1] or lz >= high[2]:
                raise InputError("arena.shapes: expected them inside low .. high, found none there")
            if hx <= low[0] or hy <= low[1] or hz <= low[2]:
                raise InputError("arena.shapes: expected them inside low .. high, found none there")
            self._bottom = max(low[2], lz)
        else:
            self._bottom = low[2]
        self.floor = self._bottom + soft_margin + _GROUND

    @classmethod
    def from_level(cls, level: Level) -> Fence:
        """The fence of a level; raises InputError if start or goal contradict it."""
        fence = cls.from_arena(level.arena, level)
        for name, point in (("start", level.start.position), ("goal", level.goal.position)):
            x, y, z = point
            if fence.clearance(x, y, z) < 0.0:
                raise InputError(
                    f"level {level.name}: {name}.position {list(point)} lies outside the arena's "
                    "shapes; move it inside or change arena.shapes"
                )
            for zone in fence.zones:
                if zone.distance(x, y, z) < 0.0:
                    raise InputError(
                        f"level {level.name}: {name}.position {list(point)} lies in the keep-out "
                        f"zone '{zone.name}' or its margin of {zone.margin} m"
                    )
        return fence

    @classmethod
    def from_arena(cls, arena: Arena, level: Level | None = None) -> Fence:
        """The fence of an arena, with the track of ``level`` if ``arena.track_margin`` asks."""
        zones = [Zone(z.name, make_shape(z.shape), z.margin, z.people) for z in arena.keep_out]
        if level is not None and arena.track_margin is not None:
            zones += track_zones(level, arena.track_margin)
        low, high = arena.low, arena.high
        return cls(
            ((low[0], low[1], low[2]), (high[0], high[1], high[2])),
            [make_shape(shape) for shape in arena.shapes],
            arena.soft_margin,
            zones,
        )

    @property
    def bounds(self) -> Bounds:
        """Box around everything the fence allows."""
        return self.box.bounds

    @property
    def is_convex(self) -> bool:
        """Whether the straight way between two places inside surely lies inside."""
        return self.shape is None and not self.zones

    def clearance(self, x: float, y: float, z: float) -> float:
        """Distance left to the hard limit, m; negative outside. Keep-out zones do not count."""
        if self._bottom <= z < self.floor:
            z = self.floor
        distance = self.box.clearance(x, y, z)
        if self.shape is not None:
            distance = min(distance, self.shape.clearance(x, y, z))
        return distance

    def zone_distance(self, x: float, y: float, z: float) -> float:
        """Distance left to the nearest keep-out zone, m; inf without zones."""
        return min((zone.distance(x, y, z) for zone in self.zones), default=math.inf)

    def room(self, x: float, y: float, z: float) -> float:
        """Distance left to whatever is nearest, fence or zone, m."""
        return min(self.clearance(x, y, z), self.zone_distance(x, y, z))

    def nearest(self, point: Point, margin: float, anchor: Point | None = None) -> Point:
        """A point with at least ``margin`` m of room, close to ``point``.

        Follows the gradient of the room; where that leads nowhere, goes towards ``anchor`` (a
        place known to be inside, e.g. the last one the vehicle was at).

        Raises
        ------
        InputError: no such point was found (``anchor`` lacks the room itself).
        """
        x, y, z = point
        for _ in range(48):
            room = self.room(x, y, z)
            if room >= margin:
                return x, y, z
            gx = self.room(x + _PROBE, y, z) - self.room(x - _PROBE, y, z)
            gy = self.room(x, y + _PROBE, z) - self.room(x, y - _PROBE, z)
            gz = self.room(x, y, z + _PROBE) - self.room(x, y, z - _PROBE)
            length = math.sqrt(gx * gx + gy * gy + gz * gz)
            if not length > 1e-9:
                break
            step = (margin - room + 1e-3) / length
            x, y, z = x + step * gx, y + step * gy, z + step * gz
        if anchor is None or self.room(*anchor) < margin:
            raise InputError(f"fence: no place with {margin} m of room near {list(point)}")
        near, far = 0.0, 1.0
        for _ in range(20):
            middle = 0.5 * (near + far)
            if self.room(*_between(point, anchor, middle)) >= margin:
                far = middle
            else:
                near = middle
        return _between(point, anchor, far)


def _between(a: Point, b: Point, share: float) -> Point:
    return (
        a[0] + share * (b[0] - a[0]),
        a[1] + share * (b[1] - a[1]),
        a[2] + share * (b[2] - a[2]),
    )


def make_shape(spec: ShapeSpec) -> Shape:
    """The solid that a level file describes."""
    if spec.kind is ShapeKind.BOX:
        assert spec.low is not None
        assert spec.high is not None
        return Box(spec.low, spec.high)
    if spec.kind is ShapeKind.POLYTOPE:
        assert spec.vertices is not None
        return Polytope(spec.vertices)
    assert spec.bottom is not None
    assert spec.top is not None
    if spec.kind is ShapeKind.PRISM:
        assert spec.points is not None
        return Prism(spec.points, spec.bottom, spec.top)
    assert spec.x is not None
    assert spec.y is not None
    assert spec.radius is not None
    return Cylinder(spec.x, spec.y, spec.radius, spec.bottom, spec.top)


def track_zones(level: Level, margin: float) -> list[Zone]:
    """Keep-out zones around the frames and stands of the gates and around the obstacles.

    Dimensions of the competition's models: beams of 0.05 m at 0.225 m from the centre of the
    opening, stands of 0.05 m radius (tall) or 0.15 m width (low), obstacles of 0.05 m radius up
    to 0.925 m on a foot of 0.15 m width. Roll and pitch are taken as zero. Gates that may move
    have none.
    """
    zones = []
    for index, gate in enumerate(level.track.gates):
        if gate.tracked:
            continue
        x, y, z = gate.centre
        for name, solid in gate_solids(x, y, z, gate.z, gate.yaw, gate.type):
            zones.append(Zone(f"gate {index} {name}", solid, margin))
    for index, post in enumerate(level.track.obstacles):
        name = f"obstacle {index}"
        pole, foot = pole_solids(post.x, post.y, post.z, post.yaw)
        zones += [Zone(name, pole, margin), Zone(f"{name} foot", foot, margin)]
    return zones


def pole_solids(x: float, y: float, foot: float, yaw: float) -> list[Shape]:
    """An obstacle with its foot at height ``foot``: pole, then the foot itself."""
    return [
        Cylinder(x, y, 0.05, foot, foot + 0.925),
        _bar(x, y, yaw, 0.0, 0.075, 0.075, foot, foot + 0.25),
    ]


def gate_solids(
    x: float, y: float, z: float, foot: float, yaw: float, kind: GateType
) -> list[tuple[str, Shape]]:
    """Frame and stand of a gate whose opening is centred at x, y, z, by name."""

    def beam(lateral: float, half: float, low: float, high: float) -> Shape:
        return _bar(x, y, yaw, lateral, half, 0.025, low, high)

    solids: list[tuple[str, Shape]] = [
        ("left", beam(-0.225, 0.025, z - 0.25, z + 0.25)),
        ("right", beam(0.225, 0.025, z - 0.25, z + 0.25)),
        ("lower beam", beam(0.0, 0.25, z - 0.25, z - 0.2)),
        ("upper beam", beam(0.0, 0.25, z + 0.2, z + 0.25)),
    ]
    if kind is GateType.TALL:
        solids.append(("stand", Cylinder(x, y, 0.05, foot, foot + 0.8)))
    else:
        solids.append(("stand", _bar(x, y, yaw, 0.0, 0.075, 0.075, foot, foot + 0.25)))
    return solids


def _bar(
    x: float,
    y: float,
    yaw: float,
    lateral: float,
    half_width: float,
    half_depth: float,
    low: float,
    high: float,
) -> Prism:
    """Upright cuboid at ``lateral`` m along (cos yaw, sin yaw) from (x, y)."""
    c, s = math.cos(yaw), math.sin(yaw)
    corners = [
        (x + c * u - s * v, y + s * u + c * v)
        for u, v in (
            (lateral - half_width, -half_depth),
            (lateral + half_width, -half_depth),
            (lateral + half_width, half_depth),
            (lateral - half_width, half_depth),
        )
    ]
    return Prism(corners, low, high)
