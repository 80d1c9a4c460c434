"""What a script on real vehicles needs besides its backend: links, poses, preparation."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from crazyarena.clock import Clock
from crazyarena.crazyswarm_compat.backend import Backend
from crazyarena.crazyswarm_compat.commands import Land
from crazyarena.crazyswarm_compat.config import FleetConfig
from crazyarena.crazyswarm_compat.guard import FleetGuard
from crazyarena.crazyswarm_compat.options import warn
from crazyarena.crazyswarm_compat.registry import pose_parts
from crazyarena.errors import BackendError, InputError

ONBOARD = "onboard"
_START_TOLERANCE = 0.3  # m
_FLYING, _HIGH_LEVEL_ACTIVE = 1 << 4, 1 << 8  # of supervisor.info
_LANDING_SPEED = 0.5  # m/s
_LANDING_TIMEOUT = 10.0  # s
_LOW = 0.15  # m
_SETTLE = 0.5  # s


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
    on_frame: called with every frame and what the estimator made of it.

    Attributes
    ----------
    estimate: ``estimate(name)`` is a body's estimate now. statistics: of what each vehicle was
        sent, by id.

    Raises
    ------
    InputError
        for an unknown source.
    DependencyMissing
        if the package behind it is not installed.
    """

    def __init__(
        self,
        spec: str,
        fleet: FleetConfig,
        backend: Backend,
        clock: Clock,
        rate: float = 100.0,
        on_frame: Sequence[Callable[[Any, Any], None]] = (),
    ) -> None:
        kind, _, host = spec.partition(":")
        options: dict[str, Any] = {}
        if host:
            options = {"connect": [host]} if kind in ("zenoh", "ros2") else {"hostname": host}
        parts = pose_parts()
        source = parts["open_source"](kind, clock=clock, **options)
        names = {vehicle.name: vehicle.id for vehicle in fleet.vehicles}
        estimator = parts["PoseEstimator"](tuple(names))
        estimator.warm_up()
        forwarder = parts["PoseForwarder"](
            names, backend.send_external_poses, clock, rate=rate, threaded=True
        )
        self.statistics: Callable[[], dict[int, Any]] = forwarder.statistics
        self._pipeline = parts["PosePipeline"](
            source, estimator, clock, forwarder=forwarder, on_frame=on_frame
        )
        self.estimate: Callable[[str], Any] = self._pipeline.estimate
        self._pipeline.start()

    def close(self) -> None:
        """Stop forwarding and close the source; idempotent."""
        self._pipeline.close()


def land_flying(backend: Backend, clock: Clock) -> None:
    """Land what still flies, and wait for it: a script that ends in the air, by an error or
    Ctrl-C, would leave its vehicles hovering until their batteries are empty."""
    flying = [v for v in backend.vehicles if _is_flying(backend, v)]
    if not flying:
        return
    warn(f"the script ends while vehicles {flying} fly: landing them")
    for vehicle in flying:
        state = backend.telemetry(vehicle).state
        height = 1.0 if state is None else float(state.position[2])
        duration = max(1.5, height / _LANDING_SPEED)
        backend.send(Land(0.0, duration), vehicle)
    deadline = clock.now() + _LANDING_TIMEOUT
    while clock.now() < deadline and any(_is_flying(backend, v) for v in flying):
        clock.sleep_until(clock.now() + 0.1)
    # The plan ends a little before the vehicle touches down; until then it needs poses.
    clock.sleep_until(clock.now() + _SETTLE)


def _is_flying(backend: Backend, vehicle: int) -> bool:
    telemetry, connected = backend.telemetry(vehicle), getattr(backend, "connected", None)
    flags = telemetry.supervisor
    if flags is None or not flags & _FLYING or not (connected is None or connected(vehicle)):
        return False
    # The firmware keeps the bit for 2 s after touchdown.
    high = telemetry.state is None or bool(telemetry.state.position[2] > _LOW)
    return high or bool(flags & _HIGH_LEVEL_ACTIVE)


def _compare_starts(fleet: FleetConfig, backend: Backend) -> None:
    """Warn of vehicles that do not stand where the vehicle list says: scripts plan from there."""
    for vehicle in fleet.vehicles:
        state = backend.telemetry(vehicle.id).state
        if state is None:
            continue
        distance = math.dist(state.position[:2], vehicle.initial_position[:2])
        if distance > _START_TOLERANCE:
            x, y = state.position[:2]
            warn(
                f"{vehicle.name} stands at ({x:.2f}, {y:.2f}), {distance:.2f} m from its initial "
                f"position in {fleet.source}"
            )


def _with_frozen(error: BackendError, names: Sequence[str]) -> BackendError:
    return BackendError(
        f"{error}; {', '.join(names)}: a guard passes on no pose that repeats the last one to the "
        "bit: a camera system that is frozen, or simulated cameras without noise (crazyarena "
        "virtual-cf --camera-noise)"
    )


def _prepare(
    fleet: FleetConfig, backend: Backend, prepare: Callable[[], None] | None, watchdog: bool
) -> None:
    if prepare is not None:
        prepare()
        _compare_starts(fleet, backend)
    arm_watchdog = getattr(backend, "arm_watchdog", None)
    if watchdog and arm_watchdog is not None:
        arm_watchdog(feed_period=0.2)


def start_hardware(
    fleet: FleetConfig,
    backend: Backend,
    clock: Clock,
    mocap: str | None,
    watchdog: bool,
    guard: FleetGuard | None = None,
    lookout: Any = None,
) -> PoseFeed | None:
    """Feed poses from ``mocap`` and prepare the vehicles; None leaves both to somebody else.

    ``onboard`` instead of a source: they have decks that tell them where they are; nobody watches.
    ``watchdog`` arms the onboard emergency-stop watchdog, fed until the link is closed; a
    ``guard`` arms and feeds it by itself, and gets all poses first. A ``lookout`` sees every frame
    and passes on the poses.

    Raises
    ------
    InputError
        for a guard without poses.
    BackendError
        naming each vehicle that is not ready to fly, and why.
    """
    if mocap is None:
        if guard is not None:
            raise InputError("--guard: watches real vehicles by their poses; add --mocap")
        warn(
            "no --mocap: the vehicles get no external poses from this script and are not "
            "prepared for flight"
        )
        return None
    if mocap == ONBOARD:
        if guard is not None:
            raise InputError(
                "--guard: watches vehicles from outside; with --mocap onboard nothing sees them. "
                "Fly without it, or a trial: crazyarena fly --mocap onboard"
            )
        _prepare(fleet, backend, getattr(backend, "prepare_onboard", None), watchdog)
        return None
    listeners = tuple(who.on_frame for who in (guard, lookout) if who is not None)
    feed = PoseFeed(mocap, fleet, guard or lookout or backend, clock, on_frame=listeners)
    try:
        if guard is not None:
            guard.watch(feed.estimate)
        prepare = getattr(backend, "prepare", None)
        try:
            _prepare(fleet, backend, prepare, watchdog and guard is None)
        except BackendError as error:
            if guard is None or not guard.frozen():
                raise
            raise _with_frozen(error, guard.frozen()) from error
    except BaseException:
        feed.close()
        raise
    return feed
