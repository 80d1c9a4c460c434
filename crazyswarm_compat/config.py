"""Vehicle lists as they are: ``crazyflies.yaml`` of Crazyswarm 1 and of Crazyswarm2.

Only what flying needs is interpreted; unknown keys are left alone. Every complaint names the
file, the field, what was found and what would be right.
"""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from crazyarena.crazyswarm_compat.yaml_node import Node, load_yaml
from crazyarena.errors import InputError

# What Crazyswarm 1 keeps in its launch file rather than in the vehicle list.
LAUNCH_PARAMS: Mapping[str, float] = {
    "commander.enHighLevel": 1.0,
    "stabilizer.estimator": 2.0,
    "stabilizer.controller": 2.0,
    "locSrv.extPosStdDev": 1e-3,
    "locSrv.extQuatStdDev": 0.5e-1,
}

# Limits that Crazyswarm ships for plausible motion between two frames.
_DYNAMICS_1 = {
    "max_velocity": ("maxXVelocity", "maxYVelocity", "maxZVelocity"),
    "max_angular_velocity": ("maxRollRate", "maxPitchRate", "maxYawRate"),
}


@dataclass(frozen=True, slots=True)
class VehicleConfig:
    """One vehicle of the fleet.

    initial_position m, world; firmware_params ``group.name`` -> value with the precedence of
    the file format already applied; ``tracking`` is ``"vendor"`` or ``"librigidbodytracker"``
    where the file says so; ``vehicle`` is the name or file of the model that simulations fly;
    marker and dynamics name the tracker's configurations.
    """

    id: int
    name: str
    initial_position: tuple[float, float, float]
    uri: str | None = None
    channel: int | None = None
    type: str | None = None
    firmware_params: Mapping[str, float] = field(default_factory=dict)
    tracking: str | None = None
    marker: str | None = None
    dynamics: str | None = None
    big_quad: bool = False
    battery_warning: float = 3.8
    battery_critical: float = 3.7
    reference_frame: str = "world"
    vehicle: str | None = None


@dataclass(frozen=True, slots=True)
class FleetConfig:
    """The vehicles in file order, how broadcasts are repeated on a radio, what the file says
    about ``guard`` (see :mod:`.options`), and ``read_all``: fetch all parameters when connecting.
    """

    vehicles: tuple[VehicleConfig, ...]
    source: str
    broadcast_repeats: int = 15
    broadcast_delay: float = 0.001
    guard: str | None = None
    read_all: bool = False


@dataclass(frozen=True, slots=True)
class MarkerConfig:
    """Markers of a rigid body: ``points`` and ``offset`` in m, body frame."""

    points: tuple[tuple[float, float, float], ...]
    offset: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class DynamicsConfig:
    """Bounds for plausible motion: m/s, rad/s (roll, pitch, yaw), rad, m."""

    max_velocity: tuple[float, float, float] = (2.0, 2.0, 3.0)
    max_angular_velocity: tuple[float, float, float] = (20.0, 20.0, 10.0)
    max_roll: float = 1.4
    max_pitch: float = 1.4
    max_fitness_score: float = 0.001


@dataclass(frozen=True, slots=True)
class VehicleType:
    """One entry of Crazyswarm 1's ``crazyflieTypes.yaml``."""

    name: str
    big_quad: bool
    battery_warning: float
    battery_critical: float
    marker: str
    dynamics: str
    firmware_params: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class TypesConfig:
    """Crazyswarm 1's ``crazyflieTypes.yaml``."""

    types: Mapping[str, VehicleType]
    markers: Mapping[str, MarkerConfig]
    dynamics: Mapping[str, DynamicsConfig]


def _params(node: Node) -> dict[str, float]:
    """``group: {name: value}`` as ``group.name -> value``."""
    return {
        f"{group}.{name}": value.number()
        for group, names in node.mapping_or_empty().items()
        for name, value in names.mapping().items()
    }


def _vehicle(*nodes: Node) -> str | None:
    """Model of a simulated vehicle, from the first of some nodes that names one; a file lies
    beside the vehicle list."""
    for node in nodes:
        named = node.get("vehicle")
        if named.absent:
            continue
        name = named.text()
        beside = Path(node.source).parent / name
        return str(beside) if name.endswith((".yaml", ".yml")) and beside.is_file() else name
    return None


def _unique_ids(vehicles: Sequence[VehicleConfig], nodes: Sequence[Node]) -> None:
    seen: dict[int, str] = {}
    for vehicle, node in zip(vehicles, nodes, strict=True):
        if vehicle.id in seen:
            raise InputError(
                f"{node.source}: {node.path}: id {vehicle.id} is already used by "
                f"{seen[vehicle.id]}; give every vehicle its own id"
            )
        seen[vehicle.id] = node.path


def load_crazyflies_1(
    given: str | os.PathLike[str], types: TypesConfig | None = None
) -> FleetConfig:
    """Read Crazyswarm 1's vehicle list (path ending in ``.yaml``, or YAML text).

    Parameters
    ----------
    types: contents of ``crazyflieTypes.yaml``; its firmware parameters are overridden by those
        of the vehicle, and override those of the launch file (:data:`LAUNCH_PARAMS`).
        Simulation needs none.

    Raises
    ------
    InputError
        naming file and field.
    """
    document = load_yaml(given, "crazyflies.yaml")
    entries = document.get("crazyflies")
    if entries.absent:
        raise InputError(
            f"{document.source}: crazyflies: missing; expected a list of vehicles with id and "
            "initialPosition"
        )
    nodes = entries.items()
    vehicles = []
    for node in nodes:
        number = node.get("id").integer(0, 255)
        channel = node.get("channel")
        kind = node.get("type")
        kind_name = None if kind.absent else kind.text()
        entry = None
        if types is not None:
            if kind_name is None:
                raise kind.fail(f"one of the types {', '.join(types.types)}")
            entry = types.types.get(kind_name)
            if entry is None:
                raise kind.fail(f"one of the types {', '.join(types.types)}")
        channel_number = None if channel.absent else channel.integer(0, 125)
        vehicles.append(
            VehicleConfig(
                id=number,
                name=f"cf{number}",
                initial_position=node.get("initialPosition").vector(),
                uri=None
                if channel_number is None
                else f"radio://0/{channel_number}/2M/E7E7E7E7{number:02X}",
                channel=channel_number,
                type=kind_name,
                firmware_params={
                    **LAUNCH_PARAMS,
                    **(entry.firmware_params if entry else {}),
                    **_params(node.get("firmwareParams")),
                },
                marker=entry.marker if entry else None,
                dynamics=entry.dynamics if entry else None,
                big_quad=entry.big_quad if entry else False,
                battery_warning=entry.battery_warning if entry else 3.8,
                battery_critical=entry.battery_critical if entry else 3.7,
                vehicle=_vehicle(node, document),
            )
        )
    _unique_ids(vehicles, nodes)
    return FleetConfig(tuple(vehicles), document.source, guard=_guard(document))


def load_types_1(given: str | os.PathLike[str]) -> TypesConfig:
    """Read Crazyswarm 1's ``crazyflieTypes.yaml`` (path or text); raises InputError."""
    document = load_yaml(given, "crazyflieTypes.yaml")
    types = {}
    for name, node in document.get("crazyflieTypes").mapping().items():
        types[name] = VehicleType(
            name=name,
            big_quad=node.get("bigQuad").flag(False),
            battery_warning=node.get("batteryVoltageWarning").number(3.8),
            # The misspelt key is the one that every file in the field uses.
            battery_critical=node.get("batteryVoltateCritical").number(3.7),
            marker=str(node.get("markerConfiguration").integer(0, 1000)),
            dynamics=str(node.get("dynamicsConfiguration").integer(0, 1000)),
            firmware_params=_params(node.get("firmwareParams")),
        )
    markers = {}
    for name, node in document.get("markerConfigurations").mapping_or_empty().items():
        count = node.get("numPoints").integer(0, 1000)
        points = node.get("points").mapping_or_empty()
        if len(points) < count:
            raise node.get("points").fail(f"{count} points, as numPoints says")
        markers[name] = MarkerConfig(
            points=tuple(point.vector() for point in list(points.values())[:count]),
            offset=node.get("offset").vector(),
        )
    dynamics = {}
    for name, node in document.get("dynamicsConfigurations").mapping_or_empty().items():
        default = DynamicsConfig()
        vectors = {
            ours: tuple(
                node.get(key).number(fallback)
                for key, fallback in zip(keys, getattr(default, ours), strict=True)
            )
            for ours, keys in _DYNAMICS_1.items()
        }
        dynamics[name] = DynamicsConfig(
            max_velocity=vectors["max_velocity"],  # type: ignore[arg-type]
            max_angular_velocity=vectors["max_angular_velocity"],  # type: ignore[arg-type]
            max_roll=node.get("maxRoll").number(default.max_roll),
            max_pitch=node.get("maxPitch").number(default.max_pitch),
            max_fitness_score=node.get("maxFitnessScore").number(default.max_fitness_score),
        )
    for name, found, known in (
        ("numMarkerConfigurations", len(markers), document.get("numMarkerConfigurations")),
        ("numDynamicsConfigurations", len(dynamics), document.get("numDynamicsConfigurations")),
    ):
        if not known.absent and known.integer(0, 1000) > found:
            raise InputError(f"{document.source}: {name}: says {known.value}, but {found} follow")
    return TypesConfig(types, markers, dynamics)


class _Problem(NamedTuple):
    text: str
    refused: bool


def _id_of(uri: str, name: str, others: Sequence[VehicleConfig]) -> tuple[int, _Problem | None]:
    """Number by which a vehicle goes: the last byte of its address, where that is free."""
    number = int(uri[-2:], 16)
    same = [other for other in others if int(str(other.uri)[-2:], 16) == number]
    for other in same:
        if _link_of(str(other.uri)) == _link_of(uri):
            return number, _Problem(f"a link of its own; {other.name} has this one", True)
    if not same:
        taken = {other.id for other in others}
        if number not in taken:
            return number, None
    free = max(set(range(256)) - {other.id for other in others} - {number})
    names = ", ".join(other.name for other in same) or "a vehicle before it"
    return free, _Problem(
        f"the last byte of its address is that of {names}; {name} goes by number {free} here, and "
        "crazyfliesById holds the last of them (crazyfliesByName has all)",
        False,
    )


def _link_of(uri: str) -> str:
    """What a vehicle hears: a radio link without the dongle; cflib's default rate is 2M."""
    return uri.partition("://")[2].partition("/")[2] if uri.startswith("radio://") else uri


_URI = re.compile(r"^[a-z]+://.*[0-9a-fA-F]{2}$")


def load_crazyflies_2(given: str | os.PathLike[str]) -> FleetConfig:
    """Read Crazyswarm2's ``crazyflies.yaml`` (file versions 1 to 3; path or text).

    Values of ``robots`` override those of ``robot_types``, which override those of ``all``.
    Disabled robots and objects without a connection are left out.

    Raises
    ------
    InputError
        naming file and field.
    """
    document = load_yaml(given, "crazyflies.yaml")
    version = document.get("fileversion")
    if not version.absent:
        version.integer(1, 3)
    types = document.get("robot_types").mapping_or_empty()
    common = document.get("all")
    common = Node({}, common.source, common.path) if common.absent else common
    vehicles: list[VehicleConfig] = []
    for name, node in document.get("robots").mapping().items():
        if not node.get("enabled").flag(True):
            continue
        type_node = node.get("type")
        if type_node.text() not in types:
            raise type_node.fail(f"one of the robot_types {', '.join(types) or '(none given)'}")
        kind = types[type_node.text()]
        connection = kind.get("connection")
        if not connection.absent and connection.value not in ("crazyflie", "none"):
            raise connection.fail("crazyflie or none")
        if connection.value == "none":
            continue
        uri = node.get("uri")
        if not _URI.match(uri.text()):
            raise uri.fail("a link such as radio://0/80/2M/E7E7E7E701, ending in two hex digits")
        capture = kind.get("motion_capture")
        capture = Node({}, capture.source, capture.path) if capture.absent else capture
        battery = kind.get("battery")
        battery = Node({}, battery.source, battery.path) if battery.absent else battery
        frame = next(
            (n.text() for n in (x.get("reference_frame") for x in (node, kind, common))
             if not n.absent),
            "world",
        )  # fmt: skip
        number, problem = _id_of(uri.text(), name, vehicles)
        if problem is not None:
            if problem.refused:
                raise uri.fail(problem.text)
            warnings.warn(f"{uri.source}: {uri.path}: {problem.text}", stacklevel=3)
        vehicles.append(
            VehicleConfig(
                id=number,
                name=name,
                initial_position=node.get("initial_position").vector(),
                uri=uri.text(),
                channel=_channel(uri.text()),
                type=type_node.text(),
                firmware_params={
                    **_params(common.get("firmware_params")),
                    **_params(kind.get("firmware_params")),
                    **_params(node.get("firmware_params")),
                },
                tracking=capture.get("tracking").value,
                marker=capture.get("marker").value,
                dynamics=capture.get("dynamics").value,
                big_quad=kind.get("big_quad").flag(False),
                battery_warning=battery.get("voltage_warning").number(3.8),
                battery_critical=battery.get("voltage_critical").number(3.7),
                reference_frame=frame,
                vehicle=_vehicle(node, kind, common, document),
            )
        )
    repeats = common.get("broadcasts")
    repeats = Node({}, repeats.source, repeats.path) if repeats.absent else repeats
    count = repeats.get("num_repeats")
    return FleetConfig(
        tuple(vehicles),
        document.source,
        broadcast_repeats=15 if count.absent else count.integer(0, 1000),
        broadcast_delay=repeats.get("delay_between_repeats_ms").number(1.0) / 1e3,
        guard=_guard(document),
    )


def load_crazyflies(given: str | os.PathLike[str]) -> FleetConfig:
    """Read the vehicle list of either generation: ``robots`` make it one of Crazyswarm2."""
    document = load_yaml(given, "crazyflies.yaml")
    return load_crazyflies_1(given) if document.get("robots").absent else load_crazyflies_2(given)


def _guard(document: Node) -> str | None:
    """Arena of the key ``guard``; a file is looked for beside the vehicle list first."""
    node = document.get("guard")
    if node.absent:
        return None
    text = node.text()
    arena, comma, rest = text.partition(",")
    beside = Path(document.source).parent / arena
    return f"{beside}{comma}{rest}" if beside.is_file() else text


def _channel(uri: str) -> int | None:
    parts = uri.split("/")
    return int(parts[3]) if uri.startswith("radio://") and parts[3].isdecimal() else None
