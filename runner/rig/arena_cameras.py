"""Cameras of a virtual arena by any protocol: the server on one side, the source on the other."""

from __future__ import annotations

import socket
from collections.abc import Sequence
from typing import Any

from crazyarena.clock import Clock
from crazyarena.errors import InputError
from crazyarena.mocap.camera_model import CameraModel
from crazyarena.mocap.opening import SourceSpec
from crazyarena.mocap.serve import Outlet

PROTOCOLS = ("zenoh", "qualisys", "natnet", "vrpn")


def free_places(protocol: str) -> dict[str, Any]:
    """Ports that nobody has, for :func:`serve` and :func:`source`; raises InputError."""
    if protocol not in PROTOCOLS:
        raise InputError(f"--mocap: found {protocol!r}; choose one of {', '.join(PROTOCOLS)}")
    return {"protocol": protocol, "port": _free_port(), "data_port": _free_port()}


def serve(place: dict[str, Any], names: Sequence[str], clock: Clock) -> Outlet:
    """The camera system: bodies ``names``, publishing at ``place``."""
    port = place["port"]
    if place["protocol"] == "qualisys":
        from crazyarena.mocap.vendor_server import QualisysServer

        return QualisysServer(names, port)
    if place["protocol"] == "natnet":
        from crazyarena.mocap.natnet_server import NatNetServer

        return NatNetServer(names, port, multicast=True, data_port=place["data_port"])
    if place["protocol"] == "vrpn":
        from crazyarena.mocap.vrpn_server import VrpnServer

        return VrpnServer(names, port)
    from crazyarena.mocap.zenoh_link import ZenohPublisher

    return ZenohPublisher(clock, listen=[endpoint(place)])


def source(place: dict[str, Any], cameras: dict[str, Any], **options: Any) -> SourceSpec:
    """The pose source that finds the cameras at ``place``.

    ``cameras`` are fields of their :class:`~crazyarena.mocap.camera_model.CameraModel`, whose
    latency is stated to sources that cannot know it, as one measures it in an arena; ``options``
    are further ones of the source.
    """
    port, protocol = place["port"], place["protocol"]
    if protocol == "zenoh":
        return SourceSpec("zenoh", {"connect": [endpoint(place)], **options})
    own: dict[str, Any] = {"latency": CameraModel(**cameras).latency}
    if protocol == "qualisys":
        own |= {"hostname": "127.0.0.1", "port": port}
        return SourceSpec("qualisys", {**own, **options})
    if protocol == "natnet":
        own |= {"hostname": "127.0.0.1", "port_command": port, "interface_ip": "127.0.0.1"}
        return SourceSpec("optitrack", {**own, **options})
    return SourceSpec("vrpn", {**own, "hostname": f"tcp://localhost:{port}", **options})


def endpoint(place: dict[str, Any]) -> str:
    """Zenoh endpoint of a place."""
    return f"tcp/127.0.0.1:{place['port']}"


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
