"""What a level is: validated, immutable models.

Units are SI and radians throughout; the world frame has z up and its origin on the floor in
the middle of the arena; roll, pitch and yaw are rotations about fixed axes (R = Rz Ry Rx).
A :class:`Level` that exists is one that can be flown: every number is finite, the track lies
inside the arena, and no random draw can make mass or inertia negative.
"""

from __future__ import annotations

import difflib
import math
from enum import StrEnum
from typing import Annotated, Any, Self

from pydantic import (
    AfterValidator,
    AllowInfNan,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    Strict,
    model_validator,
)
from pydantic_core import PydanticCustomError

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


def invalid(message: str, key: str | int | None = None) -> PydanticCustomError:
    """Validation error about ``key`` of the model at hand (or about all of it)."""
    # The text goes in as a value: pydantic would take braces in it for placeholders.
    return PydanticCustomError("level", "{text}", {"text": message, "key": key})


def unknown_key(key: str, allowed: list[str]) -> str:
    """Say that a field does not exist, with the closest one that does."""
    close = difflib.get_close_matches(key, allowed, n=1)
    hint = f", did you mean '{close[0]}'?" if close else ""
    return f"unknown field{hint} (allowed: {', '.join(allowed)})"


def _ordered(value: tuple[float, ...]) -> tuple[float, ...]:
    if value[0] > value[1]:
        raise invalid(f"expected [low, high] with low <= high, found [{value[0]}, {value[1]}]")
    return value


def _repeat(count: int) -> BeforeValidator:
    def expand(value: Any) -> Any:
        plain_number = isinstance(value, int | float) and not isinstance(value, bool)
        return (value,) * count if plain_number else value

    return BeforeValidator(expand)


Number = Annotated[float, Strict(), AllowInfNan(False)]
Whole = Annotated[int, Strict()]
Flag = Annotated[bool, Strict()]
Length = Annotated[Number, Field(ge=-100.0, le=100.0)]
Angle = Annotated[Number, Field(ge=-6.2832, le=6.2832)]
Speed = Annotated[Number, Field(ge=-50.0, le=50.0)]
Force = Annotated[Number, Field(ge=-10.0, le=10.0)]
Triple = Field(min_length=3, max_length=3)
Position = Annotated[tuple[Length, ...], Triple]
Range = Annotated[tuple[Number, ...], Field(min_length=2, max_length=2), AfterValidator(_ordered)]


class _Model(BaseModel):
    # Validators are built when a level is first loaded, not when the package is imported.
    model_config = ConfigDict(frozen=True, extra="forbid", defer_build=True)

    @model_validator(mode="before")
    @classmethod
    def _only_known_fields(cls, data: Any) -> Any:
        if isinstance(data, dict):
            for key in data:
                if key not in cls.model_fields:
                    raise invalid(unknown_key(str(key), list(cls.model_fields)), str(key))
        return data


class GateMotion(_Model):
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


class Gate(_Model):
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


class Obstacle(_Model):
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


class Track(_Model):
    """Gates in flying order, and obstacles."""

    gates: Annotated[tuple[Gate, ...], Field(max_length=100)] = ()
    obstacles: Annotated[tuple[Obstacle, ...], Field(max_length=100)] = ()

    @property
    def tracked(self) -> tuple[int, ...]:
        """Indices of the gates that are followed during the run."""
        return tuple(i for i, gate in enumerate(self.gates) if gate.tracked)


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


class Shape(_Model):
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


class KeepOut(_Model):
    """A zone vehicles must stay out of."""

    name: Annotated[str, Field(min_length=1, max_length=64)]
    shape: Shape
    margin: Annotated[Number, Field(ge=0.0, le=5.0)] = 0.1
    """How far from its surface vehicles must stay, m."""
    people: Flag = False
    """People may be in it: a vehicle inside has its motors cut at once."""


class Arena(_Model):
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


class ArenaFile(_Model):
    """A file with nothing but an arena, for flights without a track."""

    name: str = "arena"
    arena: Arena


class Start(_Model):
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


class Goal(_Model):
    """Where to hover after the last gate."""

    position: Position
    """m"""
    tolerance: Annotated[Number, Field(gt=0.0, le=5.0)] = 0.15
    """Radius that counts as being there, m."""
    hold: Annotated[Number, Field(ge=0.0, le=60.0)] = 2.0
    """How long to stay, without a break, s."""


class Vehicle(_Model):
    """Nominal inertial properties; what the contestant is told."""

    mass: Annotated[Number, Field(gt=0.0, le=1.0)] = 0.03454
    """kg"""
    ixx: Annotated[Number, Field(gt=0.0, le=0.01)] = 1.4e-5
    """kg m^2"""
    iyy: Annotated[Number, Field(gt=0.0, le=0.01)] = 1.4e-5
    """kg m^2"""
    izz: Annotated[Number, Field(gt=0.0, le=0.01)] = 2.17e-5
    """kg m^2"""


class StartRandomization(_Model):
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


class InertiaRandomization(_Model):
    """Uniform offsets ``[low, high]`` added to the vehicle; absent ones draw nothing."""

    mass: Range | None = None
    """kg"""
    ixx: Range | None = None
    """kg m^2"""
    iyy: Range | None = None
    """kg m^2"""
    izz: Range | None = None
    """kg m^2"""


class TrackRandomization(_Model):
    """Uniform offsets ``[low, high]`` of x, y (m) and yaw (rad), one range for all three."""

    gates: Range
    obstacles: Range


class Randomization(_Model):
    """What is drawn anew at a reset; absent parts draw nothing."""

    start: StartRandomization | None = None
    inertia: InertiaRandomization | None = None
    gates_and_obstacles: TrackRandomization | None = None


class ActionNoise(_Model):
    """White Gaussian noise on the four rotor forces, new every physics tick."""

    std: Annotated[
        tuple[Annotated[Number, Field(ge=0.0, le=1.0)], ...],
        Field(min_length=4, max_length=4),
        _repeat(4),
    ]
    """Standard deviation, N; one number stands for all four rotors."""


class RandomForce(_Model):
    """Uniform force on the vehicle in the world frame, new every physics tick."""

    low: Annotated[tuple[Force, ...], Triple, _repeat(3)]
    """N per axis; one number stands for all three."""
    high: Annotated[tuple[Force, ...], Triple, _repeat(3)]
    """N per axis; one number stands for all three."""

    @model_validator(mode="after")
    def _is_a_range(self) -> Self:
        if any(a > b for a, b in zip(self.low, self.high, strict=True)):
            raise invalid(f"expected low <= high, found low {self.low}, high {self.high}")
        return self


class Disturbances(_Model):
    """What pushes the simulated vehicle about; absent parts draw nothing."""

    action: ActionNoise | None = None
    dynamics: RandomForce | None = None


class Constraints(_Model):
    """Which limits the referee holds the vehicle to."""

    input: Flag = True
    """Rotor forces within what the motors can do."""
    state: Flag = True
    """Position within the arena's hard limits."""


class Level(_Model):
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
    """Hz"""
    use_firmware: Flag = True
    """False: the contestant's ``cmdSimOnly`` flies without firmware; for debugging only."""
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
    def _frequencies_fit(self) -> Self:
        if self.use_firmware and self.physics_frequency != FIRMWARE_FREQUENCY:
            raise invalid(
                f"expected {FIRMWARE_FREQUENCY} (the firmware's rate; other rates need "
                f"use_firmware: false), found {self.physics_frequency}",
                "physics_frequency",
            )
        if not self.use_firmware and self.physics_frequency % self.control_frequency:
            raise invalid(
                f"expected a multiple of control_frequency ({self.control_frequency}), "
                f"found {self.physics_frequency}",
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
