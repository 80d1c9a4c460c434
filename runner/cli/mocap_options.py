"""What the motion-capture subcommands share: opening the source the user names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from crazyarena.errors import InputError

if TYPE_CHECKING:
    from crazyarena.clock import Clock
    from crazyarena.levels import Level
    from crazyarena.mocap.source import PoseSource, SourceSpec
    from crazyarena.types import Pose

SOURCE_HELP = (
    "Where poses come from: vicon, qualisys, optitrack, vrpn, nokov, fzmotion, zenoh or replay."
)
HOST_HELP = "Host of the camera software, or zenoh endpoint such as tcp/10.0.0.5:7447."
OPTION_HELP = "Further option of the source, KEY=VALUE, under its own name (repeatable)."


def parse_options(pairs: Sequence[str]) -> dict[str, str]:
    """Read ``KEY=VALUE`` arguments."""
    options = {}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not equals or not key:
            raise InputError(f"--option: found {pair!r}; write KEY=VALUE")
        options[key] = value
    return options


def named_source(kind: str, host: str | None, pairs: Sequence[str]) -> SourceSpec:
    """The source of ``--mocap``, ``--host`` and ``--option``, to be opened."""
    from crazyarena.mocap.source import SourceSpec

    options: dict[str, Any] = dict(parse_options(pairs))
    if kind == "zenoh":
        for key in ("connect", "listen"):
            if key in options:
                options[key] = options[key].split(",")
        if host is not None:
            options["connect"] = [host]
    else:
        if host is not None and kind != "replay":
            options["hostname"] = host
        for key in ("latency", "stall_after", "retry_after", "connect_timeout", "speed"):
            if key in options:
                try:
                    options[key] = float(options[key])
                except ValueError:
                    raise InputError(
                        f"--option {key}: found {options[key]!r}; need a number"
                    ) from None
    return SourceSpec(kind, options)


def open_named_source(
    kind: str, host: str | None, pairs: Sequence[str], clock: Clock
) -> PoseSource:
    """Open the source of ``--mocap``, ``--host`` and ``--option``."""
    return named_source(kind, host, pairs).open(clock)


def nominal_track(level: Level) -> Mapping[str, Pose]:
    """Poses of the level's track bodies: ``gate1``, ``gate2``, ..., ``obstacle1``, ...

    The origin of each body is the foot of the gate or pillar, its heading the level's yaw.
    """
    import math

    import numpy as np

    from crazyarena.types import Pose

    poses = {}
    rows = {
        "gate": [gate.row for gate in level.track.gates],
        "obstacle": [obstacle.row for obstacle in level.track.obstacles],
    }
    for kind, things in rows.items():
        for number, row in enumerate(things, 1):
            x, y, z, _, _, yaw = row[:6]
            half = 0.5 * yaw
            poses[f"{kind}{number}"] = Pose(
                np.array([x, y, z]),
                np.array([0.0, 0.0, math.sin(half), math.cos(half)]),
            )
    return poses
