"""What a level of lsy_drone_racing is: validated, immutable models of its TOML file.

Only what a flight or a check needs is modelled; the file's whole content is kept beside it
(:attr:`LsyLevel.config`), because controllers read from it what they like. Keys that are not
known here are warned of, as they are ignored there. SI units, radians; attitudes are roll, pitch,
yaw about fixed axes (R = Rz Ry Rx); a gate's pose is that of its opening's centre, flown through
along its x axis; a pole stands below its position.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from crazyarena.levels.values import (
    Angle,
    Flag,
    Number,
    Position,
    Speed,
    Triple,
    Whole,
    invalid,
)

MODELS = ("cf21B_500", "cf2x_L250", "cf2x_P250", "cf2x_T350")
PHYSICS = ("first_principles",)
MAX_STEPS = 1500
"""Steps of the environment after which an episode ends."""

SINGLE, RACE = "DroneRacing-v0", "MultiDroneRacing-v0"
"""``env.id`` of one drone alone, and of several on one track."""
MOST_OFFSET = 100.0
"""m, by which something may be drawn away from its place."""
PER_DRONE = ("freq", "sensor_range", "control_mode")
"""What a race has in ``env.kwargs``, one table a drone, instead of in ``env``."""

DRAWN_DRONE = ("drone_inertia", "drone_mass", "drone_pos", "drone_rpy")
DRAWN_TRACK = ("gate_pos", "gate_rpy", "obstacle_pos")


class LsyRng(StrEnum):
    """Random generator behind a level."""

    PCG64 = "pcg64"
    """``numpy.random.default_rng(seed)``, drawn in the order of :mod:`.draw`."""
    THREEFRY = "threefry"
    """jax's own, key by key: a seed stands for the same numbers as there."""


class LsyProfile(StrEnum):
    """Which world a level is flown in."""

    SUCCESSOR = "successor"
    """lsy_drone_racing's own simulation, for comparison with published results."""
    ARENA = "arena"
    """Today's firmware with latency, packet loss and battery sag, as in a real arena."""


class Open(BaseModel):
    """A table whose further keys are left alone."""

    model_config = ConfigDict(frozen=True, extra="ignore", defer_build=True)


def _seed(value: Any) -> Any:
    return -1 if value in ("random", None) else value


_Kwarg = Number | tuple[Number, ...] | tuple[tuple[Number, ...], ...]


class Spec(Open):
    """A distribution: ``fn(key, shape, **kwargs) * scale + offset``."""

    fn: Literal["uniform", "normal"]
    kwargs: dict[Literal["minval", "maxval"], _Kwarg] = Field(default_factory=dict)
    scale: _Kwarg = 1.0
    offset: _Kwarg = 0.0

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.fn == "normal" and self.kwargs:
            raise invalid("normal takes no minval or maxval; use scale and offset", "kwargs")
        low, high = np.array(self.low), np.array(self.high)
        try:
            wrong = bool(np.any(low > high))
        except ValueError:
            wrong = True
        if wrong:
            raise invalid("expected minval <= maxval, of one shape", "kwargs")
        return self

    @property
    def low(self) -> Any:
        """``minval`` of a uniform one."""
        return dict(self.kwargs).get("minval", 0.0)

    @property
    def high(self) -> Any:
        """``maxval`` of a uniform one."""
        return dict(self.kwargs).get("maxval", 1.0)

    def fits(self, shape: tuple[int, ...]) -> bool:
        """Whether its numbers broadcast to ``shape``."""
        try:
            for value in (*self.kwargs.values(), self.scale, self.offset):
                if np.broadcast_shapes(np.shape(value), shape) != shape:
                    return False
        except ValueError:
            return False
        return True

    @property
    def reach(self) -> float:
        """Largest number that it gives; of a normal one that of a standard deviation."""
        ends = (self.low, self.high) if self.fn == "uniform" else (-1.0, 1.0)
        scale, offset = np.array(self.scale), np.array(self.offset)
        try:
            return max(float(np.max(np.abs(np.array(end) * scale + offset))) for end in ends)
        except ValueError:
            return 0.0  # of shapes that do not go together, which is told elsewhere

    def bounds(self, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray] | None:
        """Lowest and highest value, or None where there is none (``normal``)."""
        if self.fn == "normal":
            return None
        ends = [
            np.array(end, float) * np.array(self.scale) + np.array(self.offset)
            for end in (self.low, self.high)
        ]
        low, high = np.minimum(*ends), np.maximum(*ends)
        return np.broadcast_to(low, shape), np.broadcast_to(high, shape)


class LsyGate(Open):
    pos: Position
    rpy: Annotated[tuple[Angle, ...], Triple] = (0.0, 0.0, 0.0)


class LsyPole(Open):
    pos: Position


class LsyStart(Open):
    pos: Position
    rpy: Annotated[tuple[Angle, ...], Triple] = (0.0, 0.0, 0.0)
    vel: Annotated[tuple[Speed, ...], Triple] = (0.0, 0.0, 0.0)
    ang_vel: Annotated[tuple[Speed, ...], Triple] = (0.0, 0.0, 0.0)


class SafetyLimits(Open):
    """What a real race ends at; the simulation has fixed bounds of its own."""

    pos_limit_low: Position = (-2.5, -1.5, -1e-3)
    pos_limit_high: Position = (2.5, 1.5, 2.0)

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if any(a >= b for a, b in zip(self.pos_limit_low, self.pos_limit_high, strict=True)):
            raise invalid("expected pos_limit_low below pos_limit_high in all three")
        return self


class LsyTrack(Open):
    randomize: Flag = False
    gate_order: tuple[Whole, ...] | None = None
    """Gates in flying order, counted from 1; a minus sign flies one against its x axis."""
    gates: Annotated[tuple[LsyGate, ...], Field(min_length=1, max_length=100)]
    obstacles: Annotated[tuple[LsyPole, ...], Field(max_length=100)] = ()
    drones: Annotated[tuple[LsyStart, ...], Field(min_length=1, max_length=10)]
    safety_limits: SafetyLimits = Field(default_factory=SafetyLimits)

    @property
    def order(self) -> tuple[int, ...]:
        """:attr:`gate_order`, or all gates as they are listed."""
        return self.gate_order or tuple(range(1, len(self.gates) + 1))

    @model_validator(mode="after")
    def _order_names_gates(self) -> Self:
        if self.gate_order is not None and len(self.gate_order) == 0:
            raise invalid("expected at least one gate", "gate_order")
        for index, number in enumerate(self.gate_order or ()):
            if not 1 <= abs(number) <= len(self.gates):
                raise invalid(
                    f"expected a gate from 1 to {len(self.gates)}, or minus that, found {number}",
                    f"gate_order.{index}",
                )
        if self.randomize and len(self.obstacles) not in (0, len(self.gates)):
            raise invalid(
                f"randomize needs as many obstacles as gates ({len(self.gates)}), "
                f"found {len(self.obstacles)}",
                "obstacles",
            )
        return self


class LsyDisturbances(Open):
    action: Spec | None = None
    """Added to every entry of the command, once a step."""
    dynamics: Spec | None = None
    """Force on the body, N, world frame, anew each tick."""


class LsyRandomizations(BaseModel):
    """Offsets drawn at a reset. Unknown names are errors there, too."""

    model_config = ConfigDict(frozen=True, extra="forbid", defer_build=True)

    drone_pos: Spec | None = None
    drone_rpy: Spec | None = None
    drone_mass: Spec | None = None
    drone_inertia: Spec | None = None
    gate_pos: Spec | None = None
    gate_rpy: Spec | None = None
    obstacle_pos: Spec | None = None

    @model_validator(mode="after")
    def _within_reach(self) -> Self:
        for name in ("drone_pos", "gate_pos", "obstacle_pos"):
            spec = getattr(self, name)
            if spec is not None and spec.reach > MOST_OFFSET:
                raise invalid(
                    f"expected offsets within {MOST_OFFSET:g} m, found {spec.reach:g}", name
                )
        return self

    @model_validator(mode="before")
    @classmethod
    def _only_known(cls, data: Any) -> Any:
        if isinstance(data, dict):
            for key in data:
                if key not in cls.model_fields:
                    raise invalid(
                        f"unknown randomisation (allowed: {', '.join(cls.model_fields)})", str(key)
                    )
        return data


_Freq = Annotated[Whole, Field(ge=1, le=1000)]
_Range = Annotated[Number, Field(ge=0.0, le=100.0)]
_Mode = Literal["state", "attitude"]


class LsyRacer(Open):
    """One drone of a race. As there, the first one's range and mode are those of all."""

    freq: _Freq = 50
    """Hz, at which its controller is asked; the fastest one's is that of the environment."""
    sensor_range: _Range = 0.5
    control_mode: _Mode = "state"


class LsyEnv(Open):
    id: Literal["DroneRacing-v0", "MultiDroneRacing-v0"] = "DroneRacing-v0"
    kwargs: Annotated[tuple[LsyRacer, ...], Field(max_length=10)] = ()
    """Of a race: its drones, in the order of ``track.drones``."""
    seed: Annotated[Whole, BeforeValidator(_seed), Field(ge=-1, le=2**32 - 1)] = -1
    """-1 (or ``"random"``): a new one each time."""
    freq: _Freq = 50
    sensor_range: _Range = 0.5
    control_mode: _Mode = "state"
    track: LsyTrack
    disturbances: LsyDisturbances = Field(default_factory=LsyDisturbances)
    randomizations: LsyRandomizations = Field(default_factory=LsyRandomizations)

    @model_validator(mode="before")
    @classmethod
    def _of_a_race(cls, data: Any) -> Any:
        """The environment of a race: as fast as its fastest drone, else as its first."""
        racers = data.get("kwargs") if isinstance(data, dict) else None
        if not isinstance(racers, list) or data.get("id") != RACE:
            return data
        racers = [racer for racer in racers if isinstance(racer, dict)]
        rates = [r["freq"] for r in racers if isinstance(r.get("freq"), int)]
        first = racers[0] if racers else {}
        rest = {k: v for k, v in data.items() if k not in PER_DRONE}
        named = {k: first[k] for k in PER_DRONE if k in first}
        return {**rest, **named, **({"freq": max(rates)} if rates else {})}

    @property
    def drones(self) -> int:
        """How many fly."""
        return len(self.track.drones) if self.id == RACE else 1

    @model_validator(mode="after")
    def _racers(self) -> Self:
        if self.id != RACE:
            return self
        if len(self.kwargs) != self.drones:
            raise invalid(
                f"expected a table for each of the {self.drones} drones in track.drones, "
                f"found {len(self.kwargs)}",
                "kwargs",
            )
        for index, racer in enumerate(self.kwargs):
            if self.freq % racer.freq:
                raise invalid(
                    f"expected a divisor of the highest one ({self.freq}), found {racer.freq}",
                    f"kwargs.{index}.freq",
                )
        return self

    @model_validator(mode="after")
    def _shapes(self) -> Self:
        gates, poles, drones = len(self.track.gates), len(self.track.obstacles), self.drones
        command = 13 if self.control_mode == "state" else 4
        shapes: dict[str, dict[str, tuple[int, ...]]] = {
            "randomizations": {
                "drone_pos": (1, drones, 3),
                "drone_rpy": (1, drones, 3),
                "drone_mass": (1, drones, 1),
                "drone_inertia": (1, drones, 3, 3),
                "gate_pos": (1, gates, 3),
                "gate_rpy": (1, gates, 3),
                "obstacle_pos": (1, poles, 3),
            },
            "disturbances": {"action": (1, drones, command), "dynamics": (1, drones, 3)},
        }
        for table, names in shapes.items():
            for name, shape in names.items():
                spec = getattr(getattr(self, table), name)
                if spec is not None and not spec.fits(shape):
                    raise invalid(
                        f"expected numbers that broadcast to {list(shape)}", f"{table}.{name}"
                    )
        return self


class LsySim(Open):
    physics: Literal["first_principles"] = "first_principles"
    drone_model: Literal["cf21B_500", "cf2x_L250", "cf2x_P250", "cf2x_T350"] = "cf21B_500"
    freq: Annotated[Whole, Field(ge=50, le=10_000)] = 500
    attitude_freq: Annotated[Whole, Field(ge=50, le=10_000)] = 500

    @model_validator(mode="before")
    @classmethod
    def _renamed(cls, data: Any) -> Any:
        # crazyflow 0.2 calls it dynamics; before 2025-08 the model was called analytical.
        if isinstance(data, dict):
            data = dict(data)
            if "physics" not in data and "dynamics" in data:
                data["physics"] = data["dynamics"]
            if data.get("physics") == "analytical":
                data["physics"] = "first_principles"
        return data


class LsyController(Open):
    file: str = ""


def _listed(value: Any) -> Any:
    return [value] if isinstance(value, dict) else value


class LsyDeploy(Open):
    """What is looked at before a real race."""

    check_race_track: Flag = True
    check_drone_start_pos: Flag = True


class LsyLevel(Open):
    """One level of lsy_drone_racing; see the module's text for units and frames."""

    name: str = "level"
    rng: LsyRng = LsyRng.PCG64
    profile: LsyProfile = LsyProfile.SUCCESSOR
    controller: Annotated[
        tuple[LsyController, ...], BeforeValidator(_listed), Field(max_length=10)
    ] = ()
    """One table, or one for each drone of a race."""
    deploy: LsyDeploy = Field(default_factory=LsyDeploy)
    sim: LsySim = Field(default_factory=LsySim)
    env: LsyEnv
    config: dict[str, Any] = Field(default_factory=dict)
    """The whole file, as plain values."""
    warnings: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _rates(self) -> Self:
        for name, rate in (
            ("env.freq", self.env.freq),
            ("sim.attitude_freq", self.sim.attitude_freq),
        ):
            if self.sim.freq % rate:
                raise invalid(
                    f"expected a divisor of sim.freq ({self.sim.freq}), found {rate}", name
                )
        return self

    @model_validator(mode="after")
    def _world_of_a_race(self) -> Self:
        if self.race and self.profile is not LsyProfile.SUCCESSOR:
            raise invalid("races of several drones are flown in profile successor only", "profile")
        return self

    @property
    def race(self) -> bool:
        """Whether several drones fly at once."""
        return self.env.id == RACE

    @property
    def drones(self) -> int:
        """How many drones fly."""
        return self.env.drones

    @property
    def periods(self) -> tuple[int, ...]:
        """Steps of the environment from one question to a drone's controller to the next."""
        if not self.race:
            return (1,)
        return tuple(self.env.freq // racer.freq for racer in self.env.kwargs)

    def config_of(self, drone: int) -> dict[str, Any]:
        """The whole file as the controller of a drone gets it: in a race with its own rate."""
        if not self.race:
            return self.config
        own = {
            "freq": self.env.kwargs[drone].freq,
            "sensor_range": self.env.sensor_range,
            "control_mode": self.env.control_mode,
        }
        return {**self.config, "env": {**self.config.get("env", {}), **own}}

    @property
    def duration(self) -> float:
        """Time limit of an episode, s."""
        return MAX_STEPS / self.env.freq

    @property
    def ticks(self) -> int:
        """Physics ticks a step of the environment."""
        return self.sim.freq // self.env.freq

    @property
    def command_size(self) -> int:
        """Numbers in a command."""
        return 13 if self.env.control_mode == "state" else 4
