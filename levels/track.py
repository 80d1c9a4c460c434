"""What stands in an arena: gates, obstacles, and gates that move."""

from __future__ import annotations

import math
from enum import StrEnum
from typing import Annotated, Self

from pydantic import Field, model_validator

from crazyarena.levels.values import Angle, Flag, Length, Model, Number, invalid


class GateType(StrEnum):
    """The two gates of the competition."""

    TALL = "tall"
    LOW = "low"

    @property
    def code(self) -> int:
        """Number used in rows and observations: 0 tall, 1 low."""
        return 0 if self is GateType.TALL else 1

    @property
    def height(self) -> float:
        """Height of the opening's centre above the gate's foot, m."""
        return 1.0 if self is GateType.TALL else 0.525


class GateMotion(Model):
    """How a simulated gate swings about the place where it was put: sinusoids of one period."""

    x: Length = 0.0
    """Amplitude, m."""
    y: Length = 0.0
    """Amplitude, m."""
    yaw: Angle = 0.0
    """Amplitude, rad."""
    period: Annotated[Number, Field(ge=1.0, le=3600.0)]
    """s"""
    phase: Angle = 0.0
    """At the time 0, rad."""

    def offset(self, time: float) -> tuple[float, float, float]:
        """What is added to x, y (m) and yaw (rad) at a time, s."""
        swing = math.sin(2.0 * math.pi * time / self.period + self.phase)
        return self.x * swing, self.y * swing, self.yaw * swing


class Gate(Model):
    """A gate as placed: its foot and its heading."""

    x: Length
    """m"""
    y: Length
    """m"""
    z: Length = 0.0
    """Height of the foot above the floor, m."""
    roll: Angle = 0.0
    """rad"""
    pitch: Angle = 0.0
    """rad"""
    yaw: Angle = 0.0
    """rad; the gate spans (cos yaw, sin yaw) and is flown through across it."""
    type: GateType
    tracked: Flag = False
    """It may move: the cameras follow its body during the run, and it is judged and told of
    where it is. Such gates stand upright on the floor; x, y and yaw are followed."""
    motion: GateMotion | None = None
    """Simulated arenas move it so; in a real one it moves by itself."""

    @model_validator(mode="after")
    def _moves_in_sight(self) -> Self:
        if self.motion is not None and not self.tracked:
            raise invalid(
                "a gate that moves must be followed: add tracked: true, or leave motion out",
                "motion",
            )
        return self

    @property
    def row(self) -> list[float]:
        """``[x, y, z, roll, pitch, yaw, type]`` with the foot's z, as the competition lists it."""
        return [self.x, self.y, self.z, self.roll, self.pitch, self.yaw, self.type.code]

    @property
    def centre(self) -> tuple[float, float, float]:
        """Nominal centre of the opening, m."""
        return self.x, self.y, self.z + self.type.height


class Obstacle(Model):
    """A pillar as placed: its foot and its heading."""

    x: Length
    """m"""
    y: Length
    """m"""
    z: Length = 0.0
    """Height of the foot above the floor, m."""
    roll: Angle = 0.0
    """rad"""
    pitch: Angle = 0.0
    """rad"""
    yaw: Angle = 0.0
    """rad"""

    @property
    def row(self) -> list[float]:
        """``[x, y, z, roll, pitch, yaw]`` with the foot's z, as the competition lists it."""
        return [self.x, self.y, self.z, self.roll, self.pitch, self.yaw]


class Track(Model):
    """Gates in flying order, and obstacles."""

    gates: Annotated[tuple[Gate, ...], Field(max_length=100)] = ()
    obstacles: Annotated[tuple[Obstacle, ...], Field(max_length=100)] = ()

    @property
    def tracked(self) -> tuple[int, ...]:
        """Indices of the gates that are followed during the run."""
        return tuple(i for i, gate in enumerate(self.gates) if gate.tracked)
