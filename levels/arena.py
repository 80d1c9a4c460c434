"""The room that is flown in: limits, shapes, zones to keep out of."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Self

from pydantic import Field, model_validator

from crazyarena.levels.values import Flag, Length, Model, Number, Position, invalid


class ShapeKind(StrEnum):
    """Solids that an arena is made of."""

    BOX = "box"
    PRISM = "prism"
    """Upright, over a polygon that may be concave."""
    CYLINDER = "cylinder"
    """Upright."""
    POLYTOPE = "polytope"
    """The convex hull of points."""


_SHAPE_FIELDS = {
    ShapeKind.BOX: ("low", "high"),
    ShapeKind.PRISM: ("points", "bottom", "top"),
    ShapeKind.CYLINDER: ("x", "y", "radius", "bottom", "top"),
    ShapeKind.POLYTOPE: ("vertices",),
}
_Corner = Annotated[tuple[Length, ...], Field(min_length=2, max_length=2)]


class Shape(Model):
    """One solid: ``box`` (low, high), ``prism`` (points, bottom, top), ``cylinder`` (x, y, radius,
    bottom, top) or ``polytope`` (vertices); m."""

    kind: ShapeKind
    low: Position | None = None
    high: Position | None = None
    points: Annotated[tuple[_Corner, ...], Field(min_length=3, max_length=64)] | None = None
    """Corners [x, y] in order, either way round."""
    bottom: Length | None = None
    top: Length | None = None
    x: Length | None = None
    y: Length | None = None
    radius: Annotated[Number, Field(gt=0.0, le=100.0)] | None = None
    vertices: Annotated[tuple[Position, ...], Field(min_length=4, max_length=64)] | None = None

    @model_validator(mode="after")
    def _has_its_fields(self) -> Self:
        wanted = _SHAPE_FIELDS[self.kind]
        for name in type(self).model_fields:
            given = getattr(self, name) is not None
            if name != "kind" and given != (name in wanted):
                needs = f"a {self.kind.value} has {', '.join(wanted)}"
                raise invalid(
                    f"not a field of this shape: {needs}" if given else f"missing: {needs}", name
                )
        low, high = self.low or (), self.high or ()
        if any(a >= b for a, b in zip(low, high, strict=True)):
            raise invalid(f"expected low < high on every axis, found {low} .. {high}")
        if self.bottom is not None and self.top is not None and not self.bottom < self.top:
            raise invalid(f"expected bottom < top, found {self.bottom} and {self.top}", "top")
        return self


class KeepOut(Model):
    """A zone vehicles must stay out of."""

    name: Annotated[str, Field(min_length=1, max_length=64)]
    shape: Shape
    margin: Annotated[Number, Field(ge=0.0, le=5.0)] = 0.1
    """How far from its surface vehicles must stay, m."""
    people: Flag = False
    """People may be in it: a vehicle inside has its motors cut at once."""


class Arena(Model):
    """The fence: a box the vehicle may not leave, which is also the state constraint of the
    level, and what else lies in it."""

    low: Position = (-3.0, -3.0, -0.1)
    """Hard limit x, y, z, m."""
    high: Position = (3.0, 3.0, 2.0)
    """Hard limit x, y, z, m."""
    soft_margin: Annotated[Number, Field(ge=0.0, le=10.0)] = 0.05
    """How far inside the hard limit the soft limit lies, m. The floor has none: vehicles
    stand on it."""
    shapes: Annotated[tuple[Shape, ...], Field(max_length=16)] = ()
    """The vehicle must be in at least one of them, and in the box; none: anywhere in the box."""
    keep_out: Annotated[tuple[KeepOut, ...], Field(max_length=32)] = ()
    track_margin: Annotated[Number, Field(gt=0.0, le=1.0)] | None = None
    """How far a vehicle's centre must stay from the gates' frames and the obstacles, m; absent:
    touching them is the referee's business, not the watchdog's."""

    @model_validator(mode="after")
    def _is_a_box(self) -> Self:
        for axis, low, high in zip("xyz", self.low, self.high, strict=True):
            if high - low <= 2.0 * self.soft_margin:
                raise invalid(
                    f"expected low + 2 * soft_margin < high on every axis, found "
                    f"{axis}: low {low}, high {high}, soft_margin {self.soft_margin}"
                )
        return self

    @property
    def soft_low(self) -> tuple[float, float, float]:
        """Soft limit x, y, z, m."""
        return self.low[0] + self.soft_margin, self.low[1] + self.soft_margin, self.low[2]

    @property
    def soft_high(self) -> tuple[float, float, float]:
        """Soft limit x, y, z, m."""
        x, y, z = (value - self.soft_margin for value in self.high)
        return x, y, z

    def contains(self, point: tuple[float, ...], *, soft: bool = False) -> bool:
        """Whether ``point`` (x, y, z in m) lies inside the hard (or soft) limits."""
        low, high = (self.soft_low, self.soft_high) if soft else (self.low, self.high)
        return all(a <= value <= b for a, value, b in zip(low, point, high, strict=True))


class ArenaFile(Model):
    """A file with nothing but an arena, for flights without a track."""

    name: str = "arena"
    arena: Arena
