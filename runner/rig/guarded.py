"""Crazyswarm scripts under the safety of an arena: one gate for the fleet, a guard per vehicle.

What stands behind ``--guard``. The script's commands pass the command gate; the watchdog sees
every vehicle through a pose pipeline and feeds its emergency-stop watchdog; an emergency stop
comes from ``crazyarena estop`` or a second Ctrl-C. Over the radio the pipeline is that of
``--mocap``, and all poses pass the gate. In simulation the vehicles keep the perfect poses of
their backend, so that a script flies exactly as without a guard, and the watchdog looks through
simulated cameras of its own, in virtual time.
"""

from __future__ import annotations

import math
import os
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from crazyarena.clock import Clock, VirtualClock
from crazyarena.crazyswarm_compat import commands as c
from crazyarena.crazyswarm_compat.backend import Backend
from crazyarena.crazyswarm_compat.config import FleetConfig
from crazyarena.crazyswarm_compat.guard import FlightEnded
from crazyarena.crazyswarm_compat.options import warn
from crazyarena.crazyswarm_compat.registry import SimOptions
from crazyarena.errors import BackendError, InputError
from crazyarena.levels import load_arena
from crazyarena.mocap.camera_model import CameraModel
from crazyarena.mocap.estimator import BodyEstimate, FrameResult, PoseEstimator
from crazyarena.mocap.pipeline import PosePipeline
from crazyarena.mocap.sim_source import SimSource
from crazyarena.runner.rig.flight_model import flight_model, gentlest, known
from crazyarena.runner.rig.safeguard import LANDING, TICK
from crazyarena.safety.estop import EmergencyStop, interrupt_policy
from crazyarena.safety.estop_socket import SocketSource
from crazyarena.safety.events import Action, SafetyEvent
from crazyarena.safety.fence import Fence
from crazyarena.safety.flight_model import PID
from crazyarena.safety.gate import CommandGate, Policy, Refused
from crazyarena.safety.limits import LIMIT_NAMES, Limits
from crazyarena.safety.watchdog import Watchdog
from crazyarena.sim_backend.vehicles import DEFAULT_VEHICLE, load_vehicle
from crazyarena.types import Pose, PoseFrame, Telemetry, VehicleState

_CAMERA_RATE = 100.0  # Hz, in simulation
_LEAD = 0.2  # s for which simulated cameras have looked before the script begins
_WATCH_PERIOD = 0.005  # s, between looks at the vehicles when there are no frames
_BELIEVED = 0.3  # s, age up to which an estimate is good for checking commands
_LOW = 0.15  # m; below, and slower than this (m/s), a vehicle stands
_STILL = 0.1
_QUIET = 1.0  # s until the same warning about a vehicle is worth repeating
_CONTROLLER = "stabilizer.controller"
_SWITCHES = ("allow_attitude", "tune_in_flight")


@dataclass(frozen=True, slots=True)
class GuardOptions:
    """What ``--guard`` says: ``ARENA[,KEY=VALUE...]``.

    arena: a level, or a file with an arena; seed: of the simulated cameras; limits: fields of
    :class:`~crazyarena.safety.limits.Limits` that differ from the defaults.
    """

    arena: str
    policy: Policy
    seed: int
    limits: Mapping[str, Any]

    @classmethod
    def parse(cls, text: str) -> GuardOptions:
        """Read the text; raises InputError naming the key."""
        arena, *items = [part.strip() for part in text.split(",")]
        policy, seed, limits = Policy.CLAMP, 0, dict[str, Any]()
        for item in items:
            key, _, value = item.partition("=")
            try:
                if key == "policy":
                    policy = Policy(value)
                elif key == "seed":
                    seed = int(value)
                elif key in _SWITCHES:
                    limits[key] = {"true": True, "false": False}[value]
                elif key in LIMIT_NAMES:
                    limits[key] = float(value)
                else:
                    raise InputError(
                        f"--guard: found {item!r}; expected policy=, seed= or a safety limit such "
                        "as setpoint_speed="
                    )
            except (KeyError, ValueError):
                wanted = {
                    "policy": "clamp or refuse",
                    "seed": "a whole number",
                    **dict.fromkeys(_SWITCHES, "true or false"),
                }.get(key, "a number")
                raise InputError(f"--guard: {key}: found {value!r}; expected {wanted}") from None
        return cls(arena, policy, seed, limits)


class _EarlyClock:
    """The session's clock, except that it can be made to stand before the session."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self.early: float | None = None

    def now(self) -> float:
        return self._clock.now() if self.early is None else self.early

    def sleep_until(self, deadline: float) -> float:
        return self._clock.sleep_until(deadline)


class GuardedFleet:
    """The link of a fleet behind gate and watchdog; see the module's text and
    :class:`~crazyarena.crazyswarm_compat.guard.FleetGuard`.

    Parameters
    ----------
    text: see :class:`GuardOptions`.
    link: open, and owned from now on.
    clock: session clock; a virtual one makes a simulation.
    flown: which vehicle flies, instead of those of the fleet.

    Raises
    ------
    InputError
        for a wrong text or arena, or vehicles that do not start inside the arena.
    """

    def __init__(
        self,
        text: str,
        fleet: FleetConfig,
        link: Backend,
        clock: Clock,
        flown: SimOptions | None = None,
    ) -> None:
        options = GuardOptions.parse(text)
        arena, level = load_arena(options.arena)
        self.fence = Fence.from_arena(arena, level)
        self.scene = {
            "title": options.arena,
            "arena": arena.model_dump(mode="json", exclude_none=True),
        }
        """What of it a viewer can show, as plain data."""
        self._names = {vehicle.id: vehicle.name for vehicle in fleet.vehicles}
        _check_starts(fleet, self.fence, options.arena)
        self._link = link
        self._clock = clock
        self._time = _EarlyClock(clock)
        self._estimate: Callable[[str], BodyEstimate] | None = None
        self._watchdog: Watchdog | None = None
        self._told: deque[SafetyEvent] = deque()
        self._warned: dict[tuple[str, int | None], float] = {}
        self._causes: dict[int, SafetyEvent] = {}
        self._reported: set[int] = set()
        self._masks: dict[int, int] = {}
        self._interrupted: str | None = None
        self._finished = False
        self.events: list[SafetyEvent] = []
        self.estop = EmergencyStop([link], clock)
        self.gate = CommandGate(
            link,
            self.fence,
            clock,
            self._limits(options.limits, fleet, flown or SimOptions()),
            options.policy,
            state=self._believed,
            on_event=self._note,
        )
        self._undo = ExitStack()
        with ExitStack() as undo:
            undo.callback(self.estop.close)
            undo.callback(SocketSource(self.estop).close)
            if threading.current_thread() is threading.main_thread():
                undo.enter_context(interrupt_policy(self._interrupt, self.estop.trigger))
            if isinstance(clock, VirtualClock):
                self._simulate(clock, options.seed, undo)
            self._undo = undo.pop_all()

    def _limits(self, given: Mapping[str, Any], fleet: FleetConfig, flown: SimOptions) -> Limits:
        """Those of the vehicle that stops latest, but for what somebody has set."""
        models = []
        for vehicle in fleet.vehicles:
            model = load_vehicle(
                flown.vehicle or vehicle.vehicle or DEFAULT_VEHICLE, flown.vehicle_set
            )
            controller = self._controller(vehicle.id)
            models.append(flight_model(model, controller, vehicle.firmware_params))
        return gentlest(models, replace(Limits(), **given), keep=given)

    def _controller(self, vehicle: int) -> int:
        """The controller that the vehicle has; the gentlest if nobody knows it."""
        with suppress(BackendError):
            return known(self._link.get_param(vehicle, _CONTROLLER))
        return PID

    # What watches

    def _start_watching(self, clock: Clock, estimate: Callable[[str], BodyEstimate]) -> Watchdog:
        self._estimate = estimate
        self._watchdog = Watchdog(
            self.gate,
            self.fence,
            clock,
            {name: vehicle for vehicle, name in self._names.items()},
            estimate,
            feed=getattr(self._link, "arm_watchdog", None),
            estop=self.estop,
            on_event=self._note,
        )
        return self._watchdog

    def watch(self, estimate: Callable[[str], BodyEstimate]) -> None:
        """See :meth:`FleetGuard.watch`."""
        watchdog = self._start_watching(self._clock, estimate)
        self._undo.callback(watchdog.close)
        watchdog.start()

    def on_frame(self, frame: PoseFrame, result: FrameResult) -> None:
        """See :meth:`FleetGuard.on_frame`."""
        if self._watchdog is not None:
            self._watchdog.on_frame(frame, result)

    def _simulate(self, clock: VirtualClock, seed: int, undo: ExitStack) -> None:
        """Cameras, estimator and watchdog that follow virtual time, and have so for a while."""
        start = clock.now()
        self._time.early = start - _LEAD
        cameras = SimSource(self._time, None, CameraModel(rate=_CAMERA_RATE), seed)
        pipeline = PosePipeline(
            cameras,
            PoseEstimator(tuple(self._names.values())),
            self._time,
            on_frame=[self.on_frame],
        )
        watchdog = self._start_watching(self._time, pipeline.estimate)
        stepped = -math.inf

        def advance(now: float) -> None:
            nonlocal stepped
            while cameras.next_exposure <= now:
                cameras.expose(cameras.next_exposure, self._truth())
            if pipeline.poll() or now - stepped >= _WATCH_PERIOD:
                stepped = now
                watchdog.step()

        # Up to and with the beginning: an exposure that is due already would not stop the clock.
        for left in range(round(_LEAD / _WATCH_PERIOD), -1, -1):
            self._time.early = start - left * _WATCH_PERIOD
            advance(self._time.early)
        self._time.early = None
        undo.callback(pipeline.close)
        undo.callback(clock.stop_at(lambda: cameras.next_event))
        # After the vehicles, which have registered before.
        undo.callback(clock.on_advance(advance))

    def _truth(self) -> dict[str, Pose]:
        """True poses: what a simulation tells of its vehicles."""
        truth = {}
        for vehicle, name in self._names.items():
            state = self._link.telemetry(vehicle).state
            if state is not None:
                truth[name] = Pose(state.position, state.quaternion)
        return truth

    def _believed(self, vehicle: int) -> VehicleState | None:
        if self._estimate is not None:
            estimate = self._estimate(self._names[vehicle])
            if estimate.age < _BELIEVED:
                return estimate.state
        own = self._link.telemetry(vehicle).state
        fresh = own is not None and self._clock.now() - own.timestamp < _BELIEVED
        return own if fresh else None

    # Backend, for the script

    @property
    def vehicles(self) -> Sequence[int]:
        return self._link.vehicles

    def send(self, command: c.Command, vehicle: int | None = None) -> None:
        """Through the command gate.

        Raises
        ------
        CommandError: no vehicle could execute it, or the gate refused it.
        FlightEnded: it is for a vehicle that the safety has taken.
        """
        self._pass_interrupt_on()
        targets = self._addressed(command, vehicle)
        try:
            # Whoever does not belong to the group must not keep the others from flying.
            everybody = vehicle is None and len(targets) == len(self.vehicles)
            for target in [None] if everybody else targets:
                self.gate.runner.send(command, target)
        except Refused:
            self._say()
            taken = [target for target in targets if self._is_taken(target)]
            if taken:
                raise self._ended(taken[0]) from None
            raise
        if isinstance(command, c.SetGroupMask):
            self._masks.update(dict.fromkeys(targets, int(command.group_mask)))
        self._say()

    def _addressed(self, command: c.Command, vehicle: int | None) -> list[int]:
        if vehicle is not None:
            return [vehicle]
        mask = 0 if isinstance(command, c.SetGroupMask) else getattr(command, "group_mask", 0)
        everybody = list(self.vehicles)
        if not isinstance(mask, int) or mask == 0:
            return everybody
        return [v for v in everybody if self._masks.get(v, mask) & mask]

    def send_external_poses(self, poses: Mapping[int, Pose]) -> None:
        self.gate.runner.send_external_poses(poses)

    def frozen(self) -> list[str]:
        return [self._names[vehicle] for vehicle in self.gate.frozen()]

    def telemetry(self, vehicle: int) -> Telemetry:
        return self._link.telemetry(vehicle)

    def get_param(self, vehicle: int, name: str) -> float:
        return self._link.get_param(vehicle, name)

    # What became of it

    def _note(self, event: SafetyEvent) -> None:
        # Any thread: the script's own tells people of it, see _say.
        self.events.append(event)
        self._told.append(event)

    def _say(self) -> None:
        while self._told:
            event = self._told.popleft()
            vehicle = event.vehicle
            if event.severity.takes_over and vehicle is not None:
                self._causes.setdefault(vehicle, event)
            last = self._warned.get((event.rule, vehicle), -math.inf)
            repeated = event.severity <= Action.WARN and event.time - last < _QUIET
            # What is refused is told by the error that the script gets.
            if repeated or event.rule == "gate_refused":
                continue
            self._warned[event.rule, vehicle] = event.time
            who = "all vehicles" if vehicle is None else self._names[vehicle]
            what = event.cause if event.severity is Action.NONE else _told(event)
            warn(f"safety at {event.time:.2f} s: {who}: {what}", stacklevel=6)

    def _is_taken(self, vehicle: int) -> bool:
        watchdog = self._watchdog
        known = watchdog is not None and vehicle in self._names
        return known and watchdog.action(vehicle).takes_over  # type: ignore[union-attr]

    def _ended(self, vehicle: int) -> FlightEnded:
        self._reported.add(vehicle)
        cause, stop = self._causes.get(vehicle), self.estop.stopped
        reason = "" if cause is None else f": {cause.cause} at {cause.time:.2f} s"
        if stop is not None:
            reason += f" ({stop.source}: {stop.reason})" if stop.reason else f" ({stop.source})"
        return FlightEnded(f"{self._names[vehicle]}: the watchdog has taken over{reason}")

    def check(self) -> None:
        """See :meth:`FleetGuard.check`."""
        self._pass_interrupt_on()
        self._say()
        for vehicle in self._causes:
            if vehicle not in self._reported:
                raise self._ended(vehicle)

    def _interrupt(self, name: str) -> None:
        # In a signal handler, which must not wait for a lock that it has interrupted.
        self._interrupted = name
        if name == "SIGTERM":
            raise SystemExit(128 + 15)
        raise KeyboardInterrupt

    def _pass_interrupt_on(self) -> None:
        name, self._interrupted = self._interrupted, None
        if name is not None and self._watchdog is not None:
            self._watchdog.request(Action.LAND, f"interrupted by {name}")

    # The end

    def _where(self, vehicle: int) -> str:
        state = self._believed(vehicle)
        if state is None:
            return "an unknown place"
        return "(" + ", ".join(f"{value:.2f}" for value in state.position) + ")"

    def _is_up(self, vehicle: int) -> bool:
        if self.gate.flying_since(vehicle) is None:
            return False
        state = self._believed(vehicle)
        if state is None:
            return True
        return bool(state.position[2] > _LOW or np.linalg.norm(state.velocity) > _STILL)

    def finish(self) -> None:
        """See :meth:`FleetGuard.finish`."""
        watchdog = self._watchdog
        if self._finished or watchdog is None:
            return
        self._finished = True
        self._pass_interrupt_on()
        left = [v for v in self.vehicles if not watchdog.over(v) and self._is_up(v)]
        for vehicle in left:
            if not watchdog.action(vehicle).takes_over:
                warn(f"the script ends while {self._names[vehicle]} flies: landing it")
            if watchdog.action(vehicle) < Action.LAND:
                watchdog.request(Action.LAND, "script_over", vehicle)
        end = self._clock.now() + LANDING
        while self._clock.now() < end and not all(map(watchdog.over, left)):
            self._clock.sleep_until(self._clock.now() + TICK)
        self._say()
        for vehicle in left:
            how = "cut" if watchdog.action(vehicle) is Action.CUT else "landed"
            warn(f"{self._names[vehicle]}: {how} at {self._where(vehicle)} m")

    def close(self) -> None:
        """Land what flies, and release everything; idempotent."""
        try:
            self.finish()
        finally:
            self._undo.close()
            self._link.close()


def _told(event: SafetyEvent) -> str:
    if event.rule == "gate_clamped":
        return f"changed a command: {event.detail}"
    return f"{event.severity.name}: {event.cause}"


def _check_starts(fleet: FleetConfig, fence: Fence, arena: str) -> None:
    for vehicle in fleet.vehicles:
        x, y, z = vehicle.initial_position
        room = fence.room(x, y, max(z, fence.floor))
        if room < 0.0:
            raise InputError(
                f"{fleet.source}: {vehicle.name} starts at {[x, y, z]}, {-room:.2f} m outside what "
                f"the arena of --guard {os.fspath(arena)} allows; move it, or choose another arena"
            )


def open_guard(
    arena: str,
    fleet: FleetConfig,
    link: Backend,
    clock: Clock,
    options: SimOptions | None = None,
) -> GuardedFleet:
    """Factory named in the registry of backends."""
    return GuardedFleet(arena, fleet, link, clock, options)
