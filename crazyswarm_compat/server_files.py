"""Crazyswarm2's other files: ``server.yaml`` and ``motion_capture.yaml``, beside the vehicle list.

What has a meaning here is read: where poses come from, when a link or the cameras are worth a
warning, whether all parameters are fetched. The rest is named as not read.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from crazyarena.crazyswarm_compat.yaml_node import Node, load_yaml

SERVER, MOTION_CAPTURE = "server.yaml", "motion_capture.yaml"
# Those that say that there are no cameras, or only made-up ones.
_NO_CAMERAS = ("none", "mock")
_FLAGS = {"sim": "--backend, --vis and --dt say how to simulate"}


@dataclass(frozen=True, slots=True)
class LinkLimits:
    """From where on a link is worth a warning.

    period: s, between looks. pose_rate: Hz, least and most poses that are sent to a vehicle.
    latency: s, of a round trip, median. ack_rate, receive_rate: shares of packets that are
    acknowledged, and that arrive by the vehicle's own count. None: never.
    """

    period: float = 1.0
    pose_rate: tuple[float, float] | None = None
    latency: float | None = None
    ack_rate: float | None = None
    receive_rate: float | None = None


@dataclass(frozen=True, slots=True)
class ServerFile:
    """What ``server.yaml`` says.

    read_all: fetch all parameters when connecting. unread: remarks on the rest of it.
    """

    limits: LinkLimits
    read_all: bool
    unread: tuple[str, ...]


def read_server(folder: Path, sim: bool) -> ServerFile | None:
    """Read the file in ``folder``, None if there is none; ``sim``: what flies is simulated.

    Raises
    ------
    InputError: naming file and field.
    """
    path = folder / SERVER
    if not path.is_file():
        return None
    node = _parameters(load_yaml(path, SERVER), "/crazyflie_server")
    if node is None:
        return ServerFile(LinkLimits(), False, (f"{path} is not read: it has no ros__parameters",))
    read: set[str] = set()

    def at(name: str) -> Node:
        read.add(name)
        found = node
        for key in name.split("."):
            found = found.get(key)
            if found.absent:
                break
        return found

    limits = LinkLimits(
        1.0 / _positive(at("warnings.frequency"), 1.0),
        _range(at("warnings.motion_capture.warning_if_rate_outside")),
        _scaled(at("warnings.communication.max_unicast_latency"), 1e-3),
        _share(at("warnings.communication.min_unicast_ack_rate")),
        _share(at("warnings.communication.min_unicast_receive_rate")),
    )
    read_all = at("firmware_params.query_all_values_on_connect").flag(False)
    left = [name for name in _names(node) if not any(_within(name, done) for done in read)]
    about = [name for name in left if (name.partition(".")[0] == "sim") == sim]
    unread = []
    if about:
        flag = _FLAGS["sim"] if sim else "it has no meaning here"
        unread.append(f"{path}: not read: {', '.join(about)}; {flag}")
    return ServerFile(limits, read_all, tuple(unread))


def read_motion_capture(folder: Path) -> tuple[str | None, str | None]:
    """What ``--mocap`` would have to be to say the same as the file in ``folder``, and a remark;
    None where there is no file, or it names no camera system.

    Raises
    ------
    InputError: naming file and field.
    """
    path = folder / MOTION_CAPTURE
    if not path.is_file():
        return None, None
    node = _parameters(load_yaml(path, MOTION_CAPTURE), "/motion_capture_tracking")
    if node is None or node.get("type").absent:
        return None, f"{path} is not read: it names no type of motion capture"
    kind = node.get("type").text()
    if kind in _NO_CAMERAS:
        return None, f"{path}: type {kind!r} has no poses of real vehicles"
    mode = node.get("mode").value
    remark = None
    if mode not in (None, "motionCapture"):
        remark = (
            f"{path}: mode {mode!r} is not read: the bodies of the camera system are taken, named "
            "like the vehicles"
        )
    host = node.get("hostname")
    return (kind if host.absent else f"{kind}:{host.text()}"), remark


def _parameters(document: Node, name: str) -> Node | None:
    node = document.get(name)
    if node.absent:
        node = document.get("/**")
    if node.absent:
        return None
    node = node.get("ros__parameters")
    return None if node.absent else node


def _names(node: Node, prefix: str = "") -> Iterator[str]:
    """Dotted names of two levels: enough to find the place."""
    for key, child in node.mapping_or_empty().items():
        name = f"{prefix}{key}"
        if isinstance(child.value, dict) and name.count(".") < 2 and not name.startswith("sim"):
            yield from _names(child, f"{name}.")
        elif isinstance(child.value, dict) and not prefix:
            yield from (f"{name}.{inner}" for inner in child.value)
        else:
            yield name


def _within(name: str, whole: str) -> bool:
    return name == whole or name.startswith(f"{whole}.")


def _positive(node: Node, default: float) -> float:
    value = node.number(default)
    if not value > 0.0:
        raise node.fail("a number above 0")
    return value


def _scaled(node: Node, unit: float) -> float | None:
    return None if node.absent else unit * _positive(node, 1.0)


def _share(node: Node) -> float | None:
    if node.absent:
        return None
    value = node.number()
    if not 0.0 <= value <= 1.0:
        raise node.fail("a share from 0 to 1")
    return value


def _range(node: Node) -> tuple[float, float] | None:
    if node.absent:
        return None
    if not isinstance(node.value, list) or len(node.value) != 2:
        raise node.fail("two numbers [least, most] in Hz")
    low, high = (item.number() for item in node.items())
    if not (math.isfinite(low) and low <= high):
        raise node.fail("two numbers [least, most] in Hz")
    return low, high
