"""Crazyflies over radio, USB or UDP, behind the one interface of all backends."""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from crazyarena.clock import Clock, VirtualClock
from crazyarena.crazyswarm_compat import commands as c
from crazyarena.crazyswarm_compat.checks import beyond_memory, check
from crazyarena.crazyswarm_compat.config import FleetConfig
from crazyarena.crazyswarm_compat.options import warn
from crazyarena.crazyswarm_compat.radio import packets as pk
from crazyarena.crazyswarm_compat.radio.air_sharing import AirSharing
from crazyarena.crazyswarm_compat.radio.budget import Budget
from crazyarena.crazyswarm_compat.radio.client import init_drivers
from crazyarena.crazyswarm_compat.radio.connecting import patiently, wrong_uri
from crazyarena.crazyswarm_compat.radio.events import EventLog, LinkEvent
from crazyarena.crazyswarm_compat.radio.link import VehicleLink
from crazyarena.crazyswarm_compat.radio.options import RadioOptions
from crazyarena.crazyswarm_compat.radio.preflight import Preparation, prepare_vehicle
from crazyarena.crazyswarm_compat.radio.quality import LinkStatistics
from crazyarena.crazyswarm_compat.radio.script_report import ScriptReport
from crazyarena.crazyswarm_compat.radio.telemetry import OnState, SupervisorState, is_stopped
from crazyarena.errors import BackendError, CommandError, InputError
from crazyarena.types import Pose, Telemetry, Vector

_LOG = logging.getLogger(__name__)
_MONITOR_PERIOD = 0.05  # s
_END = 3.0  # s, for threads that have been told to end


class RadioBackend:
    """Every vehicle of a fleet over its ``uri``, connected when this returns.

    Parameters
    ----------
    fleet: vehicles with a link each, as ``radio://0/80/2M/E7E7E7E701`` or
        ``udp://127.0.0.1:19850``; whatever cflib opens.
    clock: a wall clock; the backend does not run on simulated time.
    options: see :class:`.options.RadioOptions`.

    Raises
    ------
    InputError
        if a vehicle has no link, or two have the same.
    BackendError
        if a vehicle does not answer; the message names each of them.
    """

    def __init__(
        self, fleet: FleetConfig, clock: Clock, options: RadioOptions | None = None
    ) -> None:
        if isinstance(clock, VirtualClock):
            raise InputError("the radio backend needs a wall clock, not a simulated one")
        _check_uris(fleet)
        init_drivers()
        self.clock = clock
        self.options = options or RadioOptions()
        self.fleet = fleet
        self._events = EventLog()
        self._watchdog_lock = threading.Lock()
        self._watchdog: dict[int, float] = {}  # vehicles that are fed, and when by ourselves
        self._watchdog_period = math.inf
        self._closed = False
        self._reconnecting: dict[int, threading.Thread] = {}
        self._retry_at: dict[int, float] = {}
        budgets: dict[str, Budget] = {}
        self._links = {
            config.id: VehicleLink(
                config,
                clock,
                self.options,
                budgets.setdefault(radio, self._budget(radio)),
                self._events,
            )
            for config in fleet.vehicles
            for radio in (_radio_of(str(config.uri)),)
        }
        self._air = AirSharing(fleet, self.options, self._links)
        try:
            self._connect_all()
        except BaseException:
            self.close()
            raise
        self._monitor = threading.Thread(target=self._watch, name="radio-monitor", daemon=True)
        self._monitor.start()

    def _budget(self, radio: str) -> Budget:
        if not radio.startswith("radio://") or self.options.driver == "scheduled":
            return Budget()
        rate = self.options.packets_per_second
        return Budget(rate, max(1.0, 0.04 * rate))

    def _connect_all(self) -> None:
        links = list(self._links.values())
        deadline = self.clock.now() + self.options.connect_timeout
        failures: list[str] = []

        def connect(link: VehicleLink) -> None:
            try:
                patiently(
                    lambda: link.connect(max(1.0, deadline - self.clock.now())),
                    self.clock,
                    deadline - self.clock.now(),
                )
            except BackendError as error:
                failures.append(str(error))

        cache = self.options.cache
        if cache is not None and not (cache.is_dir() and any(cache.glob("*.json"))):
            # The first one fills the cache for the others.
            connect(links.pop(0))
        if links:
            with ThreadPoolExecutor(len(links), thread_name_prefix="connect") as pool:
                list(pool.map(connect, links))
        if failures:
            raise BackendError("; ".join(failures))

    # Backend

    @property
    def vehicles(self) -> Sequence[int]:
        """Ids in the order of the fleet."""
        return tuple(self._links)

    def send(self, command: c.Command, vehicle: int | None = None) -> None:
        """Put a command on its way; returns at once, whatever the link does.

        Raises
        ------
        CommandError
            if no vehicle could execute it: not finite, beyond the packet's range, no such id.
        BackendError
            for a parameter that does not exist.
        """
        if vehicle is None:
            check(command, "all vehicles")
            for link in self._links.values():
                link.send(command)
        else:
            link = self._link(vehicle)
            check(command, link.name)
            link.send(command)

    def send_external_poses(self, poses: Mapping[int, Pose]) -> None:
        """Forward measured poses by vehicle id: the newest wins, at most
        ``options.outbox.extpose_rate`` per vehicle; unknown ids are only told to vehicles that
        avoid collisions. A pose whose quaternion is not finite goes as a position."""
        now = self.clock.now()
        served = self._air.broadcast(poses, now)
        for ident, link in self._links.items():
            pose = poses.get(ident)
            outgoing: tuple[pk.Packet, ...] = ()
            if pose is not None:
                link.last_pose = (now, pose)
                outgoing = () if ident in served else self._own_pose(ident, pose)
            if link.hears_peers:
                outgoing += pk.packed_positions(
                    [(peer, other.position) for peer, other in poses.items() if peer != ident]
                )
            if outgoing:
                link.outbox.extpose(outgoing, now)

    def _own_pose(self, ident: int, pose: Pose) -> tuple[pk.Packet, ...]:
        if self.options.poses == "packed":
            packed = pk.packed_poses([(ident, pose)])
            if packed:
                return packed
        packet = pk.external_pose(pose)
        return () if packet is None else (packet,)

    def send_external_positions(self, positions: Mapping[int, Vector]) -> None:
        """Forward measured positions (3,) m by vehicle id, where no attitude was measured."""
        unknown = np.full(4, math.nan)
        self.send_external_poses({k: Pose(p, unknown) for k, p in positions.items()})

    def telemetry(self, vehicle: int) -> Telemetry:
        """Last known health, without waiting; link quality of links that have no measure of
        their own is the share of echoes that came back."""
        link = self._link(vehicle)
        latest = link.telemetry.latest
        if latest.link_quality is None:
            loss = link.pings.summary()[0]
            if loss is not None:
                return replace(latest, link_quality=1.0 - loss)
        return latest

    def stopped_since(self, time: float) -> int:
        """How many vehicles have confirmed an emergency stop sent at ``time`` s: their motors
        are locked, or, of firmware that does not say so, they were heard after it."""
        count = 0
        for link in self._links.values():
            latest = link.telemetry.latest
            if latest.timestamp > time:
                count += latest.supervisor is None or is_stopped(latest.supervisor)
        return count

    def get_param(self, vehicle: int, name: str) -> float:
        """Value of ``group.name``, after writes under way are acknowledged (blocks for those).

        Raises
        ------
        BackendError
            if the firmware has no such parameter, or does not answer.
        """
        return self._link(vehicle).parameters.get(name)

    def param_names(self, vehicle: int) -> Sequence[str]:
        """Names of all parameters of a vehicle, as ``group.name``."""
        return self._link(vehicle).parameters.names()

    def param_is_whole(self, vehicle: int, name: str) -> bool:
        """Whether a parameter holds whole numbers; BackendError if there is none."""
        return self._link(vehicle).parameters.whole(name)

    def close(self) -> None:
        """Release the links; idempotent. Nothing is sent: a vehicle that flies a high-level
        command goes on flying it, one that followed a stream is stopped by its firmware."""
        if self._closed:
            return
        self._closed = True
        closers = [
            threading.Thread(target=link.close, name=f"close-{link.name}")
            for link in self._links.values()
        ]
        for closer in closers:
            try:
                closer.start()
            except RuntimeError:
                # At the end of the interpreter there are no new threads.
                closer.run()
        for closer in closers:
            if closer.ident is not None:
                closer.join()
        monitor = getattr(self, "_monitor", None)
        for thread in (monitor, *self._reconnecting.values()):
            if thread is not None:
                thread.join(timeout=_END)
        self._events.close()

    # Beyond the common interface

    def on_state(self, vehicle: int, listener: OnState) -> None:
        """Have ``listener(telemetry, stamp)`` called at every estimate that a vehicle sends, with
        the vehicle's time stamp (ms modulo 2^24), in the thread of the link."""
        self._link(vehicle).telemetry.on_state.append(listener)

    def set_param(self, vehicle: int, name: str, value: float) -> None:
        """Write ``group.name`` and read it back (blocks).

        Raises
        ------
        BackendError
            if there is none, it is not acknowledged in time, or it reads back differently.
        CommandError
            if it is read-only or the value does not fit its type.
        """
        self._link(vehicle).set_param(name, value)

    def upload_trajectory(
        self, vehicle: int, trajectory_id: int, piece_offset: int, pieces: ArrayLike
    ) -> None:
        """Store pieces (n, 33) as a trajectory and wait until the vehicle has acknowledged all
        of it; :meth:`send` does the same in the background.

        Raises
        ------
        BackendError
            if it is refused or not acknowledged within ``options.upload_timeout``.
        CommandError
            for pieces that do not fit.
        """
        link = self._link(vehicle)
        rows = np.asarray(pieces, dtype=np.float64)
        command = c.UploadTrajectory(trajectory_id, piece_offset, rows)
        check(command, link.name)
        too_much = beyond_memory(command)
        if too_much is not None:
            raise CommandError(f"{link.name}: uploadTrajectory: {too_much}")
        link.upload(int(trajectory_id), int(piece_offset), rows)

    def prepare(
        self, preparation: Preparation | None = None, vehicles: Sequence[int] | None = None
    ) -> None:
        """Make vehicles ready for take-off, all at once (blocks): estimator and controller
        selected and read back, estimator reset and converged, battery, arming.

        External poses must be coming in meanwhile, from another thread.

        Raises
        ------
        BackendError
            naming each vehicle that is not ready, with what was found and what to do.
        """
        chosen = [self._link(ident) for ident in (self.vehicles if vehicles is None else vehicles)]
        wanted = preparation or Preparation()
        failures: list[str] = []

        def one(link: VehicleLink) -> None:
            try:
                prepare_vehicle(link, wanted, self.clock)
            except (BackendError, CommandError) as error:
                failures.append(str(error))

        with ThreadPoolExecutor(max(1, len(chosen)), thread_name_prefix="prepare") as pool:
            list(pool.map(one, chosen))
        if failures:
            raise BackendError("; ".join(failures))

    def prepare_onboard(self) -> None:
        """As :meth:`prepare`, of vehicles that know their place by positioning decks."""
        self.prepare(Preparation(onboard=True))

    def arm_watchdog(self, vehicle: int | None = None, feed_period: float | None = None) -> None:
        """Start the onboard emergency-stop watchdog: from now on it must be fed at least once a
        second, or the motors stop and the vehicle is locked until reboot. It cannot be disarmed.

        ``feed_period`` s lets the backend feed it, which guards against a dead link or process
        but not against a program that hangs; without it call :meth:`feed_watchdog`.
        """
        with self._watchdog_lock:
            if feed_period is not None:
                if not 0 < feed_period <= 0.5:
                    raise InputError(f"feed_period is {feed_period}; it must be 0 to 0.5 s")
                self._watchdog_period = feed_period
            for ident in self.vehicles if vehicle is None else (vehicle,):
                self._link(ident).feed_watchdog()
                self._watchdog[ident] = self.clock.now()

    def feed_watchdog(self) -> None:
        """Feed the watchdogs that were armed; returns at once."""
        for ident in tuple(self._watchdog):
            self._links[ident].feed_watchdog()

    def recover(self, vehicle: int) -> None:
        """Ask a crashed vehicle to recover; see ``supervisor(vehicle).crashed`` for success."""
        self._link(vehicle).recover()

    def supervisor(self, vehicle: int) -> SupervisorState | None:
        """Supervisor state by name, None before it is known."""
        bits = self._link(vehicle).telemetry.latest.supervisor
        return None if bits is None else SupervisorState.from_bits(bits)

    def connected(self, vehicle: int) -> bool:
        """Whether the vehicle was heard within ``options.link_timeout``."""
        return self._link(vehicle).connected

    def protocol(self, vehicle: int) -> int:
        """CRTP protocol version of its firmware: 12 in 2026, 4 in 2022."""
        return self._link(vehicle).protocol

    def statistics(self, vehicle: int) -> LinkStatistics:
        """Traffic by class and quality of the link."""
        return self._link(vehicle).statistics()

    def subscribe(self, listener: Callable[[LinkEvent], None]) -> Callable[[], None]:
        """Call ``listener(event)`` from a thread of the backend for every event; returns a
        function that unsubscribes."""
        return self._events.subscribe(listener)

    def take_events(self) -> list[LinkEvent]:
        """Events since the last call, oldest first."""
        return self._events.take()

    def script_report(self, guarded: bool = False) -> ScriptReport:
        """What is to be told to a script that flies these vehicles."""
        return ScriptReport(self._links, self._events, self.clock, self.options.gone_after, guarded)

    # Supervision

    def _link(self, vehicle: int) -> VehicleLink:
        try:
            return self._links[vehicle]
        except (KeyError, TypeError):
            known = ", ".join(map(str, self._links))
            raise CommandError(f"no vehicle with id {vehicle!r}; the fleet has {known}") from None

    def _watch(self) -> None:
        due = self.clock.now()
        while not self._closed:
            # A stall is not made up for.
            due = max(due + _MONITOR_PERIOD, self.clock.now())
            self.clock.sleep_until(due)
            now = self.clock.now()
            for link in self._links.values():
                link.check_silence(now)
                link.note_supervisor()
                self._maybe_reconnect(link, now)
            self._feed_by_ourselves(now)
            self._air.look(now, self._events)

    def _feed_by_ourselves(self, now: float) -> None:
        with self._watchdog_lock:
            for ident, fed in self._watchdog.items():
                if now - fed >= self._watchdog_period:
                    self._watchdog[ident] = now
                    self._links[ident].feed_watchdog()

    def _maybe_reconnect(self, link: VehicleLink, now: float) -> None:
        if not self.options.reconnect or link.connected or link.id in self._reconnecting:
            return
        if not link.driver_gone and now - link.last_heard < 3.0 * self.options.link_timeout:
            return  # it may come back by itself
        if now < self._retry_at.get(link.id, -math.inf):
            return
        thread = threading.Thread(
            target=self._reconnect, args=(link,), name=f"reconnect-{link.name}", daemon=True
        )
        self._reconnecting[link.id] = thread
        thread.start()

    def _reconnect(self, link: VehicleLink) -> None:
        try:
            link.drop()
            link.connect(self.options.connect_timeout)
        except BackendError as error:
            _LOG.info("%s", error)
        except Exception:
            _LOG.exception("%s: reconnecting failed", link.name)
        finally:
            self._retry_at[link.id] = self.clock.now() + self.options.reconnect_interval
            self._reconnecting.pop(link.id, None)


def _radio_of(uri: str) -> str:
    """What air time is shared on: the dongle of a radio link, else the link itself."""
    if uri.startswith("radio://"):
        return "/".join(uri.split("/")[:3])
    return uri


def _check_uris(fleet: FleetConfig) -> None:
    if not fleet.vehicles:
        raise InputError(f"{fleet.source}: no vehicles")
    seen: dict[str, str] = {}
    for config in fleet.vehicles:
        if not config.uri:
            raise InputError(
                f"{fleet.source}: {config.name}: found no link; expected a channel, or a uri such "
                "as radio://0/80/2M/E7E7E7E701 or udp://127.0.0.1:19850"
            )
        wrong = wrong_uri(config.uri)
        if wrong is not None:
            raise InputError(f"{fleet.source}: {config.name}: uri: found {config.uri!r}; {wrong}")
        if config.uri in seen:
            raise InputError(
                f"{fleet.source}: {config.name}: {config.uri} is already used by "
                f"{seen[config.uri]}; give every vehicle its own link"
            )
        seen[config.uri] = config.name


def open_radio(fleet: FleetConfig, clock: Clock, options: Any = None) -> RadioBackend:
    """Backend ``radio`` of :func:`~crazyarena.crazyswarm_compat.registry.open_backend`:
    connects, then writes the firmware parameters of the fleet's configuration."""
    # A script does not listen to events: what can be mended by itself is.
    own = RadioOptions(reconnect=True, parameters="all" if fleet.read_all else "needed")
    chosen = options if isinstance(options, RadioOptions) else own
    backend = RadioBackend(fleet, clock, chosen)
    try:
        for config in fleet.vehicles:
            known = set(backend.param_names(config.id))
            for name, value in config.firmware_params.items():
                if name in known:
                    backend.set_param(config.id, name, value)
                else:
                    warn(f"{config.name}: firmware_params: no parameter {name!r} in its firmware")
    except BaseException:
        backend.close()
        raise
    return backend
