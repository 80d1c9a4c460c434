"""What is drawn anew at a reset, and what pushes the vehicle about."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, model_validator

from crazyarena.levels.values import Force, Model, Number, Range, Triple, invalid, repeated


class StartRandomization(Model):
    """Uniform offsets ``[low, high]`` added to the start state; absent ones draw nothing."""

    x: Range | None = None
    """m"""
    vx: Range | None = None
    """m/s"""
    y: Range | None = None
    """m"""
    vy: Range | None = None
    """m/s"""
    z: Range | None = None
    """m"""
    vz: Range | None = None
    """m/s"""
    phi: Range | None = None
    """Roll, rad."""
    theta: Range | None = None
    """Pitch, rad."""
    psi: Range | None = None
    """Yaw, rad."""
    p: Range | None = None
    """rad/s"""
    q: Range | None = None
    """rad/s"""
    r: Range | None = None
    """rad/s"""


class InertiaRandomization(Model):
    """Uniform offsets ``[low, high]`` added to the vehicle; absent ones draw nothing."""

    mass: Range | None = None
    """kg"""
    ixx: Range | None = None
    """kg m^2"""
    iyy: Range | None = None
    """kg m^2"""
    izz: Range | None = None
    """kg m^2"""


class TrackRandomization(Model):
    """Uniform offsets ``[low, high]`` of x, y (m) and yaw (rad), one range for all three."""

    gates: Range
    obstacles: Range


class Randomization(Model):
    """What is drawn anew at a reset; absent parts draw nothing."""

    start: StartRandomization | None = None
    inertia: InertiaRandomization | None = None
    gates_and_obstacles: TrackRandomization | None = None


class ActionNoise(Model):
    """White Gaussian noise on the four rotor forces, new every physics tick."""

    std: Annotated[
        tuple[Annotated[Number, Field(ge=0.0, le=1.0)], ...],
        Field(min_length=4, max_length=4),
        repeated(4),
    ]
    """Standard deviation, N; one number stands for all four rotors."""


class RandomForce(Model):
    """Uniform force on the vehicle in the world frame, new every physics tick."""

    low: Annotated[tuple[Force, ...], Triple, repeated(3)]
    """N per axis; one number stands for all three."""
    high: Annotated[tuple[Force, ...], Triple, repeated(3)]
    """N per axis; one number stands for all three."""

    @model_validator(mode="after")
    def _is_a_range(self) -> Self:
        if any(a > b for a, b in zip(self.low, self.high, strict=True)):
            raise invalid(f"expected low <= high, found low {self.low}, high {self.high}")
        return self


class Disturbances(Model):
    """What pushes the simulated vehicle about; absent parts draw nothing."""

    action: ActionNoise | None = None
    dynamics: RandomForce | None = None
