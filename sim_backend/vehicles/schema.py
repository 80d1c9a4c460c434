"""What a vehicle model is: validated, immutable, one file a kind of vehicle.

What the firmware takes its vehicle for (``firmware``) stands apart from what the vehicle is
(``body``, ``rotors``, ``battery``): they differ on real ones, and a dry run has to show how.
Every number may carry a spread, one standard deviation of the vehicles one might meet, and where
it comes from. SI units; axes x forward, y left, z up.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, Any, Generic, Self, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from crazyarena.levels.values import Number, invalid, unknown_key

_Value = TypeVar("_Value")


class Model(BaseModel):
    """A group of fields; unknown ones are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    @model_validator(mode="before")
    @classmethod
    def _only_known_fields(cls, data: Any) -> Any:
        if isinstance(data, dict):
            known = [field.alias or name for name, field in cls.model_fields.items()]
            for key in data:
                if key not in known:
                    raise invalid(unknown_key(str(key), known), str(key))
        return data


class Quantity(Model, Generic[_Value]):
    """A number or a list of numbers, its spread and its origin.

    A bare value in a file (or an override) is known exactly: its spread is 0.
    """

    value: _Value
    spread: Annotated[Number, Field(ge=0.0, lt=1.0)] = 0.0
    """One standard deviation, as a share of the value."""
    each: Annotated[Number, Field(ge=0.0, lt=1.0)] = 0.0
    """The same for the members of a list against each other."""
    origin: Annotated[str, Field(max_length=400)] = Field("", alias="from")
    """Where the number was taken from."""


def _bare(value: Any) -> Any:
    return value if isinstance(value, dict) else {"value": value}


def _number(low: float, high: float, *, above: bool = False) -> Any:
    bounds = Field(gt=low, le=high) if above else Field(ge=low, le=high)
    return Annotated[Quantity[Annotated[Number, bounds]], BeforeValidator(_bare)]


def _numbers(count: int, low: float, high: float, *, above: bool = False) -> Any:
    bounds = Field(gt=low, le=high) if above else Field(ge=low, le=high)
    member = Annotated[Number, bounds]
    size = Field(min_length=count, max_length=count)
    return Annotated[
        Quantity[Annotated[tuple[member, ...], size]],  # type: ignore[valid-type]
        BeforeValidator(_bare),
    ]


Scalar = Quantity[float]
Vector = Quantity[tuple[float, ...]]


class Firmware(Model):
    """What a build of the firmware takes its vehicle for."""

    thrust: _numbers(4, -10.0, 10.0)  # type: ignore[valid-type]
    """Thrust (N) of one motor over its volts, ascending powers up to the third."""
    max_force: _number(0.0, 5.0, above=True)  # type: ignore[valid-type]
    """N of one motor, at full command."""
    min_force: _number(0.0, 5.0)  # type: ignore[valid-type]
    """N of one motor; it stands still below."""
    arm: _number(0.0, 1.0, above=True)  # type: ignore[valid-type]
    """m, from the centre to a motor."""
    yaw_torque: _number(0.0, 1.0, above=True)  # type: ignore[valid-type]
    """N m per N of thrust."""
    params: dict[Annotated[str, Field(max_length=26)], Number] = Field(default_factory=dict)
    """``group.name`` -> value after boot, where it is not the firmware's own default."""

    @model_validator(mode="after")
    def _can_be_inverted(self) -> Self:
        c0, c1, c2, c3 = self.thrust.value
        if c3 <= 0.0:
            raise invalid(f"expected a last coefficient > 0, found {c3:g}", "thrust")
        if self.min_force.value >= self.max_force.value:
            raise invalid(f"expected less than max_force ({self.max_force.value:g})", "min_force")
        del c0
        # The slope c1 + 2 c2 v + 3 c3 v^2 is smallest at v = -c2 / (3 c3).
        lowest = max(0.0, -c2 / (3.0 * c3))
        if c1 + 2.0 * c2 * lowest + 3.0 * c3 * lowest**2 <= 0.0:
            raise invalid(
                f"expected a thrust that rises with the voltage, found that it falls at "
                f"{lowest:.2f} V",
                "thrust",
            )
        return self


class Body(Model):
    """The rigid body."""

    mass: _number(0.0, 5.0, above=True)  # type: ignore[valid-type]
    """kg, as it flies."""
    inertia: _numbers(3, 0.0, 0.1, above=True)  # type: ignore[valid-type]
    """kg m^2 about x, y, z."""
    arm: _numbers(2, 0.0, 1.0, above=True)  # type: ignore[valid-type]
    """m, of the rotors from the centre along x and y."""
    drag: _numbers(3, 0.0, 1.0)  # type: ignore[valid-type]
    """N per m/s along x, y, z."""


class Rotors(Model):
    """Motors and propellers; M1 front right, M2 back right, M3 back left, M4 front left."""

    thrust: _numbers(4, -10.0, 10.0)  # type: ignore[valid-type]
    """Steady thrust (N) of one motor over its volts, ascending powers up to the third."""
    strength: _numbers(4, 0.0, 3.0)  # type: ignore[valid-type]
    """Thrust of M1..M4 relative to that; below 1 for worn ones."""
    lag_up: _number(0.0, 1.0)  # type: ignore[valid-type]
    """s, time constant of a rising rotor speed."""
    lag_down: _number(0.0, 1.0)  # type: ignore[valid-type]
    """s, of a falling one."""
    yaw_torque: _number(0.0, 1.0)  # type: ignore[valid-type]
    """N m per N of thrust."""
    inertia: _number(0.0, 1e-3)  # type: ignore[valid-type]
    """kg m^2 of rotor and propeller about their axis."""
    speed: _number(0.0, 1e6, above=True)  # type: ignore[valid-type]
    """rad/s per root of the thrust in N."""
    ground: _number(0.0, 0.1)  # type: ignore[valid-type]
    """m^2: close to the floor thrust grows by this over the squared height of the rotors."""


Pair = Annotated[tuple[Number, ...], Field(min_length=2, max_length=2)]


def _rows(value: Any) -> Any:
    return value if isinstance(value, dict) else {"table": value}


class OpenCircuit(Model):
    """Battery voltage without load."""

    table: Annotated[tuple[Pair, ...], Field(min_length=2, max_length=100)]
    """``[share of the charge drawn, V]``, from 0 to 1."""
    origin: Annotated[str, Field(max_length=400)] = Field("", alias="from")

    @model_validator(mode="after")
    def _falls(self) -> Self:
        if self.table[0][0] != 0.0 or self.table[-1][0] != 1.0:
            raise invalid("expected shares from 0 to 1", "table")
        for (a, high), (b, low) in pairwise(self.table):
            if not (a < b and high >= low > 0.0):
                raise invalid(
                    f"expected rising shares and falling volts, found [{a:g}, {high:g}] before "
                    f"[{b:g}, {low:g}]",
                    "table",
                )
        return self


class Battery(Model):
    """The battery and what is drawn from it."""

    open_circuit: Annotated[OpenCircuit, BeforeValidator(_rows)]
    capacity: _number(0.0, 100.0, above=True)  # type: ignore[valid-type]
    """A h"""
    resistance: _number(0.0, 10.0)  # type: ignore[valid-type]
    """Ohm, of cell, leads and connector."""
    current: _number(0.0, 1e4)  # type: ignore[valid-type]
    """A of one motor per N^1.5 of its nominal thrust."""
    idle_current: _number(0.0, 100.0)  # type: ignore[valid-type]
    """A of everything but the motors."""
    drawn: _number(0.0, 1.0)  # type: ignore[valid-type]
    """Share of the charge that is gone at take-off; its spread is absolute and upwards."""


class Sensors(Model):
    """White noise on a sample (1 ms) of the inertial sensors, one standard deviation an axis."""

    gyro: _number(0.0, 10.0)  # type: ignore[valid-type]
    """rad/s"""
    accelerometer: _number(0.0, 100.0)  # type: ignore[valid-type]
    """m/s^2"""


class Estimation(Model):
    """What the estimator on board is told of the cameras."""

    position_std: _number(0.0, 1.0, above=True)  # type: ignore[valid-type]
    """m (``locSrv.extPosStdDev``)"""
    quaternion_std: _number(0.0, 3.0, above=True)  # type: ignore[valid-type]
    """rad (``locSrv.extQuatStdDev``)"""


class Markers(Model):
    """The rigid body that the cameras follow."""

    offset: _numbers(3, -0.5, 0.5)  # type: ignore[valid-type]
    """m, of its origin from the centre of mass, in body axes."""


class Vehicle(Model):
    """One kind of vehicle; ``sim_backend/vehicles/*.yaml`` are instances."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$")] = "vehicle"
    description: Annotated[str, Field(max_length=400)] = ""
    firmware: Firmware
    body: Body
    rotors: Rotors
    battery: Battery
    sensors: Sensors
    estimation: Estimation
    markers: Markers
