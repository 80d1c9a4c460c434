"""What a script on real vehicles needs besides its backend: links, poses, preparation."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from crazyarena.clock import Clock
from crazyarena.crazyswarm_compat.backend import Backend
from crazyarena.crazyswarm_compat.config import FleetConfig
from crazyarena.crazyswarm_compat.options import warn
from crazyarena.crazyswarm_compat.registry import pose_parts
from crazyarena.errors import InputError


def with_uris(fleet: FleetConfig, uris: str | None) -> FleetConfig:
    """The fleet on the links of ``--uri`` (comma-separated, in file order); None keeps its own.

    Raises
    ------
    InputError
        if their number is not that of the vehicles.
    """
    if uris is None:
        return fleet
    links = [uri.strip() for uri in uris.split(",") if uri.strip()]
    if len(links) != len(fleet.vehicles):
        raise InputError(
            f"--uri: found {len(links)} links; {fleet.source} has {len(fleet.vehicles)} vehicles, "
            "give one each, in that order"
        )
    vehicles = tuple(
        replace(vehicle, uri=uri) for vehicle, uri in zip(fleet.vehicles, links, strict=True)
    )
    return replace(fleet, vehicles=vehicles)


class PoseFeed:
    """Forwards the poses of a motion-capture system to the vehicles until closed.

    Parameters
    ----------
    spec: ``SOURCE`` or ``SOURCE:HOST`` as in ``--mocap``; a zenoh host is an endpoint such as
        ``tcp/127.0.0.1:7447``. Bodies are named like the vehicles of ``fleet``.
    rate: poses per second and vehicle.

    Raises
    ------
    InputError
        for an unknown source.
    DependencyMissing
        if the package behind it is not installed.
    """

    def __init__(
        self, spec: str, fleet: FleetConfig, backend: Backend, clock: Clock, rate: float = 100.0
    ) -> None:
        kind, _, host = spec.partition(":")
        options: dict[str, Any] = {}
        if host:
            options = {"connect": [host]} if kind == "zenoh" else {"hostname": host}
        parts = pose_parts()
        source = parts["open_source"](kind, clock=clock, **options)
        names = {vehicle.name: vehicle.id for vehicle in fleet.vehicles}
        estimator = parts["PoseEstimator"](tuple(names))
        estimator.warm_up()
        forwarder = parts["PoseForwarder"](
            names, backend.send_external_poses, clock, rate=rate, threaded=True
        )
        self._pipeline = parts["PosePipeline"](source, estimator, clock, forwarder=forwarder)
        self._pipeline.start()

    def close(self) -> None:
        """Stop forwarding and close the source; idempotent."""
        self._pipeline.close()


def start_hardware(
    fleet: FleetConfig, backend: Backend, clock: Clock, mocap: str | None
) -> PoseFeed | None:
    """Feed poses from ``mocap`` and prepare the vehicles; None leaves both to somebody else.

    Raises
    ------
    BackendError
        naming each vehicle that is not ready to fly, and why.
    """
    if mocap is None:
        warn(
            "no --mocap: the vehicles get no external poses from this script and are not "
            "prepared for flight"
        )
        return None
    feed = PoseFeed(mocap, fleet, backend, clock)
    prepare = getattr(backend, "prepare", None)
    try:
        if prepare is not None:
            prepare()
    except BaseException:
        feed.close()
        raise
    return feed
