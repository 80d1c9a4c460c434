"""What a level is: validated, immutable models.

Units are SI and radians throughout; the world frame has z up and its origin on the floor in
the middle of the arena; roll, pitch and yaw are rotations about fixed axes (R = Rz Ry Rx).
A :class:`Level` that exists is one that can be flown: every number is finite, the track lies
inside the arena, and no random draw can make mass or inertia negative.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Any, Self

from pydantic import Field, model_validator

from crazyarena.levels.arena import Arena, ArenaFile, KeepOut, Shape, ShapeKind
from crazyarena.levels.randomization import (
    ActionNoise,
    Disturbances,
    InertiaRandomization,
    RandomForce,
    Randomization,
    StartRandomization,
    TrackRandomization,
)
from crazyarena.levels.track import Gate, GateMotion, GateType, Obstacle, Track
from crazyarena.levels.values import (
    Angle,
    Flag,
    Model,
    Number,
    Position,
    Speed,
    Triple,
    Whole,
    invalid,
)

__all__ = [
    "FIRMWARE_FREQUENCY",
    "INERTIA_NAMES",
    "STATE_NAMES",
    "ActionNoise",
    "Arena",
    "ArenaFile",
    "Constraints",
    "Disturbances",
    "Gate",
    "GateMotion",
    "GateType",
    "Goal",
    "InertiaRandomization",
    "KeepOut",
    "Level",
    "Obstacle",
    "Profile",
    "RandomForce",
    "Randomization",
    "RngKind",
    "Shape",
    "ShapeKind",
    "Start",
    "StartRandomization",
    "Track",
    "TrackRandomization",
    "Vehicle",
]

FIRMWARE_FREQUENCY = 500
"""Hz; the rate of the simulated firmware, and so of the physics below it."""

STATE_NAMES = ("x", "vx", "y", "vy", "z", "vz", "phi", "theta", "psi", "p", "q", "r")
"""Order of the start state, of its random draws and of the competition's observations."""

INERTIA_NAMES = ("mass", "ixx", "iyy", "izz")
"""Order in which inertial properties are drawn."""


class Profile(StrEnum):
    """Which world a simulated level runs in."""

    COMPETITION = "competition"
    """The IROS 2022 simulation with its quirks, for comparison with published results."""
    ARENA = "arena"
    """Today's firmware with latency, packet loss and battery sag, as in a real arena."""


class RngKind(StrEnum):
    """Random generator behind a level; decides the numbers a seed stands for."""

    PCG64 = "pcg64"
    """``numpy.random.default_rng(seed)``; what gym >= 0.22 uses."""
    GYM021 = "gym021"
    """Mersenne Twister seeded as gym 0.21 did; the generator of the 2022 competition."""


class Start(Model):
    """Nominal state at the beginning of an episode."""

    position: Position
    """m"""
    velocity: Annotated[tuple[Speed, ...], Triple] = (0.0, 0.0, 0.0)
    """World frame, m/s."""
    attitude: Annotated[tuple[Angle, ...], Triple] = (0.0, 0.0, 0.0)
    """Roll, pitch, yaw, rad."""
    rates: Annotated[tuple[Speed, ...], Triple] = (0.0, 0.0, 0.0)
    """p, q, r, rad/s."""
    tolerance: Annotated[Number, Field(gt=0.0, le=5.0)] = 0.15
    """How far (horizontally) from ``position`` a real vehicle may stand before take-off, m."""

    @property
    def state(self) -> list[float]:
        """The 12 numbers in the order of ``STATE_NAMES``."""
        (x, y, z), (vx, vy, vz) = self.position, self.velocity
        return [x, vx, y, vy, z, vz, *self.attitude, *self.rates]


class Goal(Model):
    """Where to hover after the last gate."""

    position: Position
    """m"""
    tolerance: Annotated[Number, Field(gt=0.0, le=5.0)] = 0.15
    """Radius that counts as being there, m."""
    hold: Annotated[Number, Field(ge=0.0, le=60.0)] = 2.0
    """How long to stay, without a break, s."""


class Vehicle(Model):
    """Which vehicle flies, and its nominal inertial properties; what the contestant is told.

    A bare name or file stands for ``model``. In the arena profile what is not given is the
    model's; the competition profile has a vehicle of its own and takes no model.
    """

    model: Annotated[str, Field(min_length=1, max_length=1000)] | None = None
    """Name or file of a vehicle model (docs/fidelity.md); the default vehicle if absent."""
    spread: Flag = False
    """Simulations draw a vehicle from the spread of the model for every episode."""
    mass: Annotated[Number, Field(gt=0.0, le=1.0)] = 0.03454
    """kg"""
    ixx: Annotated[Number, Field(gt=0.0, le=0.01)] = 1.4e-5
    """kg m^2"""
    iyy: Annotated[Number, Field(gt=0.0, le=0.01)] = 1.4e-5
    """kg m^2"""
    izz: Annotated[Number, Field(gt=0.0, le=0.01)] = 2.17e-5
    """kg m^2"""

    @model_validator(mode="before")
    @classmethod
    def _named(cls, data: Any) -> Any:
        return {"model": data} if isinstance(data, str) else data


class Constraints(Model):
    """Which limits the referee holds the vehicle to."""

    input: Flag = True
    """Rotor forces within what the motors can do."""
    state: Flag = True
    """Position within the arena's hard limits."""


class Level(Model):
    """One competition level. Immutable; see the module's text for units and frames."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$")] = "level"
    """Short name for reports and file names."""
    profile: Profile = Profile.COMPETITION
    seed: Annotated[Whole, Field(ge=0, le=2**63 - 1)] = 1337
    rng: RngKind = RngKind.PCG64
    reseed_on_reset: Flag = True
    """True: every episode draws the same numbers. False: later episodes continue the stream."""
    num_episodes: Annotated[Whole, Field(ge=1, le=10_000)] = 1
    episode_length: Annotated[Number, Field(gt=0.0, le=3600.0)] = 33.0
    """s"""
    control_frequency: Annotated[Whole, Field(ge=1, le=FIRMWARE_FREQUENCY)] = 30
    """How often the contestant is asked, Hz."""
    physics_frequency: Annotated[Whole, Field(ge=1, le=10_000)] = FIRMWARE_FREQUENCY
    """Hz; no other one. Files of the competition state it."""
    use_firmware: Flag = True
    """Nothing else: files of the competition state it, and the contestant's constructor is told."""
    verbose: Flag = False
    """Handed to the contestant's constructor."""
    done_on_collision: Flag = True
    done_on_violation: Flag = True
    done_on_completion: Flag = True
    vehicle: Vehicle = Field(default_factory=Vehicle)
    arena: Arena = Field(default_factory=Arena)
    constraints: Constraints = Field(default_factory=Constraints)
    start: Start
    goal: Goal
    track: Track
    randomization: Randomization = Field(default_factory=Randomization)
    disturbances: Disturbances = Field(default_factory=Disturbances)

    @model_validator(mode="after")
    def _is_flown_by_the_firmware(self) -> Self:
        if not self.use_firmware:
            raise invalid(
                "expected true: everything is flown through the firmware, by cmdFirmware, as it "
                "was scored; found false",
                "use_firmware",
            )
        if self.physics_frequency != FIRMWARE_FREQUENCY:
            raise invalid(
                f"expected {FIRMWARE_FREQUENCY}, the rate of the firmware, found "
                f"{self.physics_frequency}",
                "physics_frequency",
            )
        return self

    @model_validator(mode="after")
    def _lies_inside_the_arena(self) -> Self:
        box = f"{list(self.arena.low)} .. {list(self.arena.high)} m"
        for index, gate in enumerate(self.track.gates):
            if not self.arena.contains(gate.centre):
                raise invalid(
                    f"expected a gate inside the arena {box}, found its centre at "
                    f"{_point(gate.centre)}",
                    f"track.gates.{index}",
                )
            if gate.motion is not None:
                x, y, z = gate.centre
                for sign in (-1.0, 1.0):
                    end = (x + sign * gate.motion.x, y + sign * gate.motion.y, z)
                    if not self.arena.contains(end):
                        raise invalid(
                            f"expected a gate that stays inside the arena {box}, found that it "
                            f"moves to {_point(end)}",
                            f"track.gates.{index}.motion",
                        )
        for index, obstacle in enumerate(self.track.obstacles):
            foot = (obstacle.x, obstacle.y, obstacle.z)
            if not self.arena.contains(foot):
                raise invalid(
                    f"expected an obstacle inside the arena {box}, found {_point(foot)}",
                    f"track.obstacles.{index}",
                )
        if not self.arena.contains(self.start.position):
            raise invalid(
                f"expected a start inside the arena {box}, found {_point(self.start.position)}",
                "start.position",
            )
        if not self.arena.contains(self.goal.position):
            raise invalid(
                f"expected a goal inside the arena {box}, found {_point(self.goal.position)}",
                "goal.position",
            )
        return self

    @model_validator(mode="after")
    def _moving_gates_are_measured(self) -> Self:
        if self.profile is Profile.COMPETITION and self.track.tracked:
            raise invalid(
                "needs profile: arena; the competition's simulation has no cameras",
                f"track.gates.{self.track.tracked[0]}.tracked",
            )
        return self

    @model_validator(mode="after")
    def _models_fly_in_the_arena(self) -> Self:
        if self.profile is Profile.COMPETITION and self.vehicle.model is not None:
            raise invalid(
                "needs profile: arena; the competition's simulation has a vehicle of its own",
                "vehicle.model",
            )
        return self

    @model_validator(mode="after")
    def _inertia_stays_positive(self) -> Self:
        ranges = self.randomization.inertia
        for name in INERTIA_NAMES:
            offset = getattr(ranges, name, None)
            nominal = getattr(self.vehicle, name)
            if offset is not None and nominal + offset[0] <= 0.0:
                raise invalid(
                    f"expected a low bound above {-nominal:g} (minus the nominal value), "
                    f"found {offset[0]:g}: the drawn {name} could not be positive",
                    f"randomization.inertia.{name}",
                )
        return self


def _point(position: tuple[float, ...]) -> str:
    return "[" + ", ".join(f"{value:g}" for value in position) + "]"
