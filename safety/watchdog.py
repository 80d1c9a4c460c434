"""Watches every vehicle on every pose frame, in a thread of its own.

It builds an :class:`Observation` per vehicle from the estimator, the vehicle's telemetry and
what the runner says of itself, gives it to the vehicle's :class:`Guard`, and sends what comes
back through the safety port of the command gate. It also owns the keepalive of the emergency-
stop watchdogs on board: they are fed only while this loop is well, so that a ground station
that hangs or dies stops the vehicles.
"""

from __future__ import annotations

import math
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

from crazyarena.clock import Clock
from crazyarena.errors import InputError
from crazyarena.mocap.estimator import BodyEstimate, FrameResult, Freshness
from crazyarena.mocap.events import EventKind
from crazyarena.safety.camera_clock import CameraClock
from crazyarena.safety.estop import EmergencyStop, Hold
from crazyarena.safety.events import Action, SafetyEvent
from crazyarena.safety.fence import Fence
from crazyarena.safety.frame_rate import FrameRate
from crazyarena.safety.gate import CommandGate
from crazyarena.safety.guard import Guard
from crazyarena.safety.lasting import Lasting
from crazyarena.safety.limits import Limits
from crazyarena.safety.monitors import Finding
from crazyarena.safety.neighbours import in_the_way_down, nearest
from crazyarena.safety.observation import Observation, Point, as_point
from crazyarena.safety.old_poses import repeats
from crazyarena.safety.own_estimate import not_watched
from crazyarena.safety.priority import raise_priority
from crazyarena.safety.take_off import TakeOffCheck
from crazyarena.types import Pose, PoseFrame, Telemetry

_TICK = 0.005  # s, without a frame
_FEED_PERIOD = 0.1  # s
_TELEMETRY_GOOD = 0.3  # s, for the vehicle's own estimate
_OFF_GROUND = 0.08  # m
_SKIMS = 0.7  # m/s
_DOWN_TIME = 1.0  # s, low and still, until a vehicle counts as standing
_SWITCH_INTERVAL = 0.0005  # s, for which another Python thread may keep this one waiting

Estimates = Callable[[str], BodyEstimate]


@dataclass(slots=True)
class _Watched:
    """What is remembered of one vehicle between frames."""

    vehicle: int
    body: str
    guard: Guard
    ground: float
    heading: TakeOffCheck
    airborne: bool = False
    still: Lasting = field(default_factory=Lasting)
    low: bool = False
    accepted_once: bool = False
    doubted_since: float | None = None
    swapped: bool = False
    answered: float | None = None
    fed: float = -math.inf
    failed: str | None = None
    requests: deque[Finding] = field(default_factory=deque)
    last_pose: Pose | None = None
    changed: float = math.inf
    latest: Observation | None = None

    def changes(self, pose: Pose, captured: float) -> None:
        """Note a measured pose; ``changed`` is when it last was another than the one before.

        Cameras never measure the same numbers twice: a pose that repeats to the last bit is an
        old one. In flight nothing stands still to some micrometres either, whatever is added to it.
        """
        last = self.last_pose
        if last is None or not repeats(last, pose, self.airborne):
            self.changed = captured
            self.last_pose = pose


class Watchdog:
    """Guards of all vehicles, and the thread that runs them.

    Either call :meth:`step` from the loop that owns virtual time, or :meth:`start` the thread.
    :meth:`on_frame` is for :class:`~crazyarena.mocap.pipeline.PosePipeline` to call.

    Parameters
    ----------
    gate: its safety port is used, and the runner is locked out through it.
    fence: of the arena.
    clock: session clock.
    bodies: vehicle id by the name of its body.
    estimate: full estimate of a body now (``PosePipeline.estimate``).
    feed: feeds the emergency-stop watchdog of one vehicle, which the first feeding arms
        (``RadioBackend.arm_watchdog``); None for vehicles that have none.
    estop: its latch is looked at in every step.
    dead_man: if given, letting go lands the vehicles; may be given later, as an attribute.
    people: names (or beginnings of names) of bodies worn by people.
    props: the same for gates, obstacles and whatever else may be seen.
    grounds: m, height of the standing vehicle's centre by id; 0.03 by default.
    flies: False to watch only, without ever taking over.
    independent: False if the poses are what the vehicles estimate of themselves: then nothing can
        contradict them, which an event per vehicle says in the beginning.
    on_event: called with every event, in the thread that runs the step.
    """

    def __init__(
        self,
        gate: CommandGate,
        fence: Fence,
        clock: Clock,
        bodies: Mapping[str, int],
        estimate: Estimates,
        *,
        limits: Limits | None = None,
        feed: Callable[[int], None] | None = None,
        estop: EmergencyStop | None = None,
        dead_man: Hold | None = None,
        people: Iterable[str] = ("person",),
        props: Iterable[str] = ("gate", "obstacle"),
        grounds: Mapping[int, float] | None = None,
        flies: bool = True,
        independent: bool = True,
        on_event: Callable[[SafetyEvent], None] | None = None,
    ) -> None:
        unknown = set(bodies.values()) - set(gate.vehicles)
        if unknown or len(set(bodies.values())) != len(bodies):
            raise InputError(
                f"watchdog: bodies {dict(bodies)} must name each vehicle of {list(gate.vehicles)} "
                "at most once"
            )
        self.limits = limits or gate.limits
        self._gate = gate
        self._fence = fence
        self._clock = clock
        self._estimate = estimate
        self._feed = feed
        self._estop = estop
        self.dead_man = dead_man
        self._people = tuple(people)
        self._props = tuple(props)
        self._on_event = on_event
        self._flies = flies
        self._independent = independent
        self._bodies = dict(bodies)
        self._grounds = {v: (grounds or {}).get(v, 0.03) for v in bodies.values()}
        self._lock = threading.Lock()
        self.renew()
        gate.grounded = self._grounded
        gate.nudged = self._nudged
        gate.low = self._is_low
        self._wake = threading.Condition(threading.Lock())
        self._pending = False
        self._closed = False
        self._thread: threading.Thread | None = None
        self.events: list[SafetyEvent] = []
        self.priority = "normal"
        self.steps = 0

    def renew(self) -> None:
        """Begin anew, with vehicles that were put down somewhere and switched on: ladders are at
        their foot again. ``events`` are kept."""
        with self._lock:
            self._watched = {
                body: _Watched(
                    vehicle,
                    body,
                    Guard(self._fence, self.limits, vehicle, self._grounds[vehicle], self._flies),
                    self._grounds[vehicle],
                    TakeOffCheck(self.limits.nudge),
                )
                for body, vehicle in self._bodies.items()
            }
            self._by_vehicle = {w.vehicle: w for w in self._watched.values()}
            self._cameras = CameraClock()
            self._frames = FrameRate()
            self._persons: dict[str, Point] = {}
            self._strangers = 0
            self._lateness: float | None = None
            self._last_step: float | None = None
            self._limits_told = False

    # Told from outside

    def on_frame(self, frame: PoseFrame, result: FrameResult) -> None:
        """A pose frame has been through the estimator."""
        with self._lock:
            self._cameras.update(frame.timestamp, frame.received)
            self._frames.note(frame.timestamp)
            persons: dict[str, Point] = {}
            strangers = 0
            believed: list[tuple[_Watched, Pose]] = []
            for name, pose in frame.bodies.items():
                watched = self._watched.get(name)
                if watched is not None:
                    if self._independent:
                        watched.changes(pose, frame.timestamp)
                    else:  # digital, so that it may well repeat to the bit
                        watched.changed = frame.timestamp
                    if name in result.accepted:
                        watched.accepted_once = True
                        watched.doubted_since = None
                        if self._independent:
                            believed.append((watched, pose))
                    elif watched.accepted_once and watched.doubted_since is None:
                        watched.doubted_since = frame.received
                elif name.startswith(self._people):
                    x, y, z = pose.position.tolist()
                    persons[name] = (x, y, z)
                elif not name.startswith(self._props):
                    strangers += 1
            self._persons = persons
            self._strangers = strangers
            for event in result.events:
                if event.kind is EventKind.SWAP_CORRECTED and event.body in self._watched:
                    self._watched[event.body].swapped = True
        with self._wake:
            self._pending = True
            self._wake.notify()
        # Last, for it takes longest, and nothing depends on it at once.
        for watched, pose in believed:
            self._compare_heading(watched, pose, frame.timestamp)

    def _compare_heading(self, watched: _Watched, pose: Pose, captured: float) -> None:
        """What a believed pose and the gyroscope say of each other, while the vehicle flies."""
        told = self._gate.telemetry(watched.vehicle)
        if self._gate.flying_since(watched.vehicle) is None or told.state is None:
            watched.heading.stands()
        else:
            watched.heading.flies(captured, pose, pose.position[2] - watched.ground, told)

    def _nudged(self, vehicle: int, pose: Pose) -> Pose:
        watched = self._by_vehicle.get(vehicle)
        if watched is None or not self._independent:
            return pose
        allowed = not watched.guard.action.takes_over
        return watched.heading.nudged(pose, self._clock.now(), allowed)

    def _is_low(self, vehicle: int) -> bool:
        watched = self._by_vehicle.get(vehicle)
        return watched is not None and (watched.low or not watched.airborne)

    def _grounded(self) -> str | None:
        """What keeps vehicles from taking off, in words."""
        rate, least = self._frames.rate, self.limits.camera_rate
        if rate is None or rate >= least:
            return None
        return (
            f"the cameras deliver {rate:.0f} frames a second, at least {least:g} are needed; raise "
            "their rate, or lower the safety limit camera_rate"
        )

    def controller_answered(self, vehicle: int) -> None:
        """The contestant has answered a control step; once called, answers are expected."""
        self._by_vehicle[vehicle].answered = self._clock.now()

    def controller_done(self, vehicle: int) -> None:
        """No more answers are to be expected of the contestant."""
        self._by_vehicle[vehicle].answered = None

    def step_late(self, lateness: float) -> None:
        """How late the last control step began, s."""
        self._lateness = lateness

    def request(self, action: Action, rule: str, vehicle: int | None = None) -> None:
        """Ask for an action on behalf of the operator or the runner; any thread."""
        for watched in self._watched.values():
            if vehicle is None or watched.vehicle == vehicle:
                watched.requests.append(Finding(rule, action, math.nan, math.nan))
        with self._wake:
            self._pending = True
            self._wake.notify()

    def action(self, vehicle: int) -> Action:
        """Where the ladder of a vehicle stands."""
        return self._by_vehicle[vehicle].guard.action

    def airborne(self, vehicle: int) -> bool:
        """Whether this vehicle flies, as far as anybody knows."""
        return self._by_vehicle[vehicle].airborne

    def settling(self, vehicle: int) -> bool:
        """Whether it is low, but has not stood still for long enough to count as down."""
        watched = self._by_vehicle[vehicle]
        return watched.airborne and watched.low

    def over(self, vehicle: int) -> bool:
        """The watchdog has brought this vehicle to a safe end."""
        return self._by_vehicle[vehicle].guard.ladder.over

    @property
    def healthy(self) -> bool:
        """No step of any vehicle's guard has failed."""
        return all(watched.failed is None for watched in self._watched.values())

    # The loop

    def step(self) -> None:
        """Look at every vehicle once, now."""
        now = self._clock.now()
        gap = 0.0 if self._last_step is None else now - self._last_step
        self._last_step = now
        stopped = self._estop.stopped if self._estop is not None else None
        if not self._independent and not self._limits_told:
            self._limits_told = True
            for watched in self._watched.values():
                self._tell(not_watched(now, watched.vehicle))
        for watched in self._watched.values():
            try:
                self._look(watched, now, gap, stopped is not None)
            except Exception as error:
                # One vehicle's trouble must not blind the others; this one is no longer fed.
                self._fail(watched, now, error)
        self.steps += 1

    def _look(self, watched: _Watched, now: float, gap: float, stopped: bool) -> None:
        obs = self._observe(watched, now, gap)
        requests = [watched.requests.popleft() for _ in range(len(watched.requests))]
        if stopped:
            requests.append(Finding("emergency_stop", Action.CUT, math.nan, math.nan))
        before = watched.guard.action
        commands, events = watched.guard.update(obs, requests)
        if self._flies and watched.guard.action.takes_over and not before.takes_over:
            self._gate.take(watched.vehicle)
        for command in commands:
            self._gate.safety.send(command, watched.vehicle)
        for event in events:
            self._tell(event)
        cut = watched.guard.action is Action.CUT and self._flies
        if (
            self._feed is not None
            # Once armed it must be fed to the end, standing or not.
            and (obs.active or watched.fed > -math.inf)
            and not cut
            and watched.failed is None
            and now - watched.fed >= _FEED_PERIOD - 1e-9
        ):
            watched.fed = now
            self._feed(watched.vehicle)

    def _fail(self, watched: _Watched, now: float, error: Exception) -> None:
        text = f"{type(error).__name__}: {error}"
        if watched.failed is None:
            where = watched.guard.action, now, watched.vehicle, text
            self._tell(SafetyEvent("watchdog_failed", Action.CUT, math.nan, math.nan, *where))
        watched.failed = text

    def _tell(self, event: SafetyEvent) -> None:
        self.events.append(event)
        if self._on_event is not None:
            self._on_event(event)

    def _observe(self, watched: _Watched, now: float, gap: float) -> Observation:
        vehicle = watched.vehicle
        estimate = self._estimate(watched.body)
        telemetry = self._gate.telemetry(vehicle)
        flying_since = self._gate.flying_since(vehicle)
        obs = Observation(time=now, active=flying_since is not None)
        with self._lock:
            obs.pose_age = max(estimate.age, now - watched.changed)
            if watched.doubted_since is not None:
                obs.doubted = max(now - watched.doubted_since, 1e-6)
            obs.swapped = watched.swapped
            obs.turned = watched.heading.turned if self._independent else None
            watched.swapped = False
            obs.clock_error = self._cameras.error
            obs.camera_rate = self._frames.rate
            obs.strangers = self._strangers
            persons = tuple(self._persons.values())
        believed = estimate.freshness in (Freshness.FRESH, Freshness.BRIDGED)
        believed = believed and obs.pose_age <= self.limits.pose_hold
        self._locate(obs, estimate if believed else None, telemetry, now)
        if not self._independent:
            obs.onboard = None
        if telemetry.timestamp > -math.inf and (
            telemetry.battery is not None or telemetry.supervisor is not None
        ):
            obs.link_age = now - telemetry.timestamp
            obs.link_quality = telemetry.link_quality
            obs.battery = telemetry.battery
            obs.supervisor = telemetry.supervisor
        watched.airborne = obs.airborne = self._is_airborne(watched, obs)
        obs.setpoint, obs.setpoint_velocity = self._gate.reference(vehicle, now)
        obs.streamed = obs.setpoint or self._gate.streamed(vehicle)
        if not watched.guard.action.takes_over:
            obs.pushed = self._gate.pushed(vehicle)
        obs.controller_age = _largest(
            self._gate.stream_age(vehicle, now),
            None if watched.answered is None else now - watched.answered,
        )
        # A loop that was asleep itself has seen nothing of what happened meanwhile.
        obs.lateness = _largest(self._lateness, gap)
        if self.dead_man is not None:
            obs.dead_man_age = self.dead_man.age()
        if persons:
            self._look_for_people(obs, persons)
        watched.latest = obs
        others = [w.latest for w in self._watched.values() if w is not watched and w.latest]
        obs.below = in_the_way_down(obs, others)
        near = nearest(obs, others, self.limits)
        if near is not None:
            obs.neighbour, obs.neighbour_predicted = near
        return obs

    @staticmethod
    def _locate(
        obs: Observation, estimate: BodyEstimate | None, telemetry: Telemetry, now: float
    ) -> None:
        """Position from the cameras, or, when they are blind, from the vehicle."""
        own = telemetry.state
        if own is not None and now - own.timestamp > _TELEMETRY_GOOD:
            own = None
        if own is not None:
            obs.onboard = as_point(own.position)
        if estimate is not None:
            state = estimate.state
        elif own is not None:
            state = own
            obs.onboard = None
        else:
            return
        obs.position = as_point(state.position)
        obs.velocity = as_point(state.velocity)
        x, y, z, w = state.quaternion.tolist()
        obs.quaternion, obs.rates = (x, y, z, w), as_point(state.angular_velocity)

    def _is_airborne(self, watched: _Watched, obs: Observation) -> bool:
        if not obs.active:
            # Whatever moves it now is somebody's hand: it must not begin to fly there.
            return False
        if obs.position is None:
            return True  # blind: it may be
        moving = math.hypot(*obs.velocity)
        low = watched.low = obs.position[2] <= watched.ground + _OFF_GROUND
        held = watched.still.update(low and moving <= 0.2, obs.time)
        if held is None:
            # Skimming along the floor is flying, too.
            return watched.airborne or not low or moving > _SKIMS
        if held < _DOWN_TIME:
            return watched.airborne
        self._gate.stands(watched.vehicle)
        return False

    def _look_for_people(self, obs: Observation, persons: Iterable[Point]) -> None:
        _low, high = self._fence.bounds
        depths = []
        for x, y, z in persons:
            # A marker on a head may be above the fence; the person below it is not.
            height = min(max(z, self._fence.floor), high[2] - self._fence.soft_margin)
            depths.append(self._fence.clearance(x, y, height))
            if obs.position is not None:
                distance = math.hypot(x - obs.position[0], y - obs.position[1])
                nearest = obs.person_distance
                obs.person_distance = distance if nearest is None else min(nearest, distance)
        obs.person_depth = max(depths)

    # The thread

    def start(self) -> None:
        """Run in a thread until :meth:`close`, on every frame and at least every 5 ms.

        Asks for real-time scheduling (``priority`` says what was granted) and makes other
        Python threads give way sooner.
        """
        sys.setswitchinterval(min(sys.getswitchinterval(), _SWITCH_INTERVAL))
        self._thread = threading.Thread(target=self._run, name="watchdog", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        self.priority = raise_priority()
        while True:
            with self._wake:
                if not self._pending and not self._closed:
                    self._wake.wait(_TICK)
                if self._closed:
                    return
                self._pending = False
            self.step()

    def close(self) -> None:
        """Stop the thread, and with it the feeding: vehicles in flight stop within a second."""
        with self._wake:
            self._closed = True
            self._wake.notify()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(timeout=1.0)


def _largest(*values: float | None) -> float | None:
    return max((value for value in values if value is not None), default=None)
