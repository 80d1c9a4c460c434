"""The fault campaign: everything that can go wrong, flown in simulation with the safety on.

Each flight is the arena's own composition in virtual time: simulated cameras, estimator,
forwarding, watchdog, command gate, a radio that delays and loses, and today's firmware on the
far side. A contestant flies a circuit; at a random moment of it one fault sets in.
"""

from __future__ import annotations

import contextlib
import math
import random
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from crazyarena.clock import Clock, VirtualClock
from crazyarena.crazyswarm_compat import commands as c
from crazyarena.errors import CommandError, InputError
from crazyarena.levels import Level, load_level
from crazyarena.mocap.camera_model import CameraModel
from crazyarena.mocap.estimator import PoseEstimator
from crazyarena.mocap.forwarder import PoseForwarder
from crazyarena.mocap.pipeline import PosePipeline
from crazyarena.mocap.sim_source import SimSource
from crazyarena.mocap.source import SourceState, SourceStatus
from crazyarena.runner.excursion import Excursion
from crazyarena.safety.events import Action, SafetyEvent
from crazyarena.safety.fence import Fence
from crazyarena.safety.gate import CommandGate
from crazyarena.safety.limits import PID_BRAKING, Limits
from crazyarena.safety.monitors import CRASHED, LOCKED
from crazyarena.safety.watchdog import Watchdog
from crazyarena.sim_backend.arena import ArenaFleet, SensorNoise
from crazyarena.sim_backend.physics.arena_plant import (
    AB_CHARGE,
    AP_CAPACITY,
    AP_RESISTANCE,
    AP_STRENGTH,
    default_plant,
)
from crazyarena.sim_backend.physics.competition_step import B_VEL, P_MASS
from crazyarena.types import Pose, PoseFrame, Telemetry

VEHICLE = 1
BODY = "cf1"
OTHER = "cf9"  # stands about; somebody to be mixed up with

_QUANTUM = 0.002  # s, of virtual time between looks at everything
_RATE = 30.0  # control steps per second
_BOOT = 1.0  # s on the ground, for the estimators
_CLIMB = 1.6  # s; the slower controller takes twice as long
_ONSET = (3.6, 5.6)  # s, when the fault sets in
_MISSION = 8.0  # s, then the contestant lands
_LAND_TIME = 2.5  # s
_PATIENCE = 12.0  # s after the mission: nothing may take longer to end
_TELEMETRY_PERIOD = 0.02  # s
_RETRY = 0.03  # s, until an unanswered command is sent again
_ANSWERED = (c.Takeoff, c.Land, c.GoTo, c.Stop, c.NotifySetpointsStop, c.SetParam, c.Arm)


class FleetLink:
    """The simulated vehicle behind a simulated radio; a Backend in virtual time.

    Attributes
    ----------
    loss: probability that a packet is lost; cut: nothing passes while True.
    """

    def __init__(
        self, fleet: ArenaFleet, clock: VirtualClock, rng: random.Random, latency: float = 0.006
    ) -> None:
        self._fleet = fleet
        self._clock = clock
        self._rng = rng
        self._latency = latency
        self.loss = 0.0
        self.cut = False
        self._up: deque[tuple[float, Callable[[], object]]] = deque()
        self._down: deque[tuple[float, Telemetry]] = deque()
        self._told = -math.inf
        self._sent = self._lost = 0
        self._quality = 1.0
        self._telemetry = Telemetry(-math.inf)

    @property
    def vehicles(self) -> Sequence[int]:
        return (VEHICLE,)

    def send(self, command: c.Command, vehicle: int | None = None) -> None:
        self._carry(lambda: self._fleet.send(command, 0), again=isinstance(command, _ANSWERED))

    def send_external_poses(self, poses: Mapping[int, Pose]) -> None:
        pose = poses.get(VEHICLE)
        if pose is not None:
            self._carry(lambda: self._fleet.external_pose(0, pose))

    def feed(self, vehicle: int) -> None:
        """Feed the emergency-stop watchdog."""
        self._carry(lambda: self._fleet.emergency_watchdog(0))

    def telemetry(self, vehicle: int) -> Telemetry:
        return self._telemetry

    def get_param(self, vehicle: int, name: str) -> float:
        return self._fleet.get_param(0, name)

    def close(self) -> None:
        """Nothing to release."""

    def _passes(self) -> bool:
        passes = not self.cut and self._rng.random() >= self.loss
        # Share of what got through lately, as a radio's statistics tell it.
        self._quality += 0.01 * (float(passes) - self._quality)
        return passes

    def _carry(self, delivery: Callable[[], object], again: bool = False) -> None:
        delay = self._latency * self._rng.uniform(0.7, 1.6)
        passes = self._passes()
        while again and not passes and not self.cut:
            # What the vehicle answers is repeated until the answer is there.
            delay += _RETRY
            passes = self._passes()
        if passes:
            arrival = self._clock.now() + delay
            if self._up:
                arrival = max(arrival, self._up[-1][0])
            self._up.append((arrival, delivery))

    def deliver(self) -> None:
        """Let arrive what is due, in both directions."""
        now = self._clock.now()
        while self._up and self._up[0][0] <= now:
            self._up.popleft()[1]()
        if now - self._told >= _TELEMETRY_PERIOD - 1e-9:
            self._told = now
            if self._passes():
                told = replace(self._fleet.telemetry(0), timestamp=now)
                self._down.append((now + self._latency * self._rng.uniform(0.7, 1.6), told))
        while self._down and self._down[0][0] <= now:
            told = self._down.popleft()[1]
            # The estimate keeps the time it was made at; the rest was heard now.
            self._telemetry = replace(told, timestamp=now, link_quality=self._quality)


class FaultyCameras:
    """A pose source whose frames pass through whatever fault is set.

    ``spoil(frame, now)`` returns the frame as it is delivered, or None; ``delay`` s is added to
    the way of every frame.
    """

    def __init__(self, source: SimSource, clock: Clock) -> None:
        self._source = source
        self._clock = clock
        self.spoil: Callable[[PoseFrame], PoseFrame | None] | None = None
        self.delay = 0.0
        self._held: deque[tuple[float, PoseFrame]] = deque()

    def frames(self, timeout: float = 0.0) -> list[PoseFrame]:
        for frame in self._source.frames():
            spoiled = frame if self.spoil is None else self.spoil(frame)
            if spoiled is not None:
                due = frame.received + self.delay
                if self._held:
                    due = max(due, self._held[-1][0])
                self._held.append((due, replace(spoiled, received=due)))
        now = self._clock.now()
        ready = []
        while self._held and self._held[0][0] <= now:
            ready.append(self._held.popleft()[1])
        return ready

    @property
    def status(self) -> SourceStatus:
        return SourceStatus(SourceState.LIVE)

    def close(self) -> None:
        self._source.close()


class Circuit:
    """A contestant's flight: off the ground, on a closed curve at up to ``speed`` m/s."""

    def __init__(
        self, start: np.ndarray, rng: random.Random, speed: float, climb: float = _CLIMB
    ) -> None:
        self._start = start
        self._climb = climb
        self._height = rng.uniform(0.7, 1.3)
        self._size = np.array([rng.uniform(1.0, 2.0), rng.uniform(1.0, 2.0), 0.25])
        self._phase = np.array([rng.choice((0.0, math.pi)) for _ in range(3)])
        ratio = np.array([1.0, rng.choice((0.5, 1.0, 2.0)), rng.choice((1.0, 2.0))])
        self._rate = ratio * speed / float(np.linalg.norm(self._size * ratio))
        times = np.arange(0.0, _MISSION, 0.05)
        fastest = max(float(np.linalg.norm(self._derivative(t, 1)[:2])) for t in times)
        self._size *= min(1.0, speed / fastest)

    def at(self, t: float) -> c.FullState:
        """Setpoint ``t`` s after the take-off."""
        place, velocity, acceleration = (self._derivative(t, order) for order in range(3))
        return c.FullState(place, velocity, acceleration, 0.0, np.zeros(3))

    def _place(self, t: float) -> np.ndarray:
        climb = _smooth(t / self._climb)
        grown = _smooth((t - 0.6 * self._climb) / 1.5)
        place = self._start + grown * self._size * np.sin(self._rate * t + self._phase)
        place[2] += climb * (self._height - self._start[2])
        return place

    def _derivative(self, t: float, order: int) -> np.ndarray:
        h = 1e-3
        if order == 0:
            return self._place(t)
        if order == 1:
            return (self._place(t + h) - self._place(t - h)) / (2.0 * h)
        return (self._place(t + h) - 2.0 * self._place(t) + self._place(t - h)) / h**2


def _smooth(x: float) -> float:
    x = min(max(x, 0.0), 1.0)
    return x**3 * (10.0 - x * (15.0 - 6.0 * x))


@dataclass(slots=True)
class Outcome:
    """What became of one flight.

    Attributes
    ----------
    excursion: m, furthest beyond the hard fence that the vehicle truly was (negative: inside).
    safe_after: s from the fault until the motors were off for good; inf if that never came.
    end: ``landed``, ``cut`` (by the watchdog or by the firmware itself) or ``flying``.
    action: where the ladder ended; rule: what took the vehicle from the contestant.
    speed: m/s, when the fault set in.
    """

    fault: str
    seed: int
    excursion: float
    safe_after: float
    end: str
    action: int
    rule: str
    speed: float
    onset: float
    events: list[SafetyEvent] = field(default_factory=list)

    @property
    def safe(self) -> bool:
        return self.end in ("landed", "cut")


class Flight:
    """One flight of the campaign; public members are what faults change.

    Parameters
    ----------
    fault: name in :data:`FAULTS`.
    seed: of everything random in it.
    level: its arena is flown in.
    """

    def __init__(self, fault: str, seed: int, level: Level, limits: Limits | None = None) -> None:
        if fault not in FAULTS:
            raise InputError(f"fault {fault!r}: choose from {', '.join(FAULTS)}")
        self.fault = fault
        self.seed = seed
        self.rng = random.Random(f"{fault}/{seed}")
        self.fence = Fence.from_arena(level.arena)
        self.clock = VirtualClock()
        start = np.array([self.rng.uniform(-0.5, 0.5), self.rng.uniform(-0.5, 0.5), 0.03])
        self.plant = default_plant()
        self.plant[P_MASS] *= self.rng.uniform(0.95, 1.1)
        self.plant[AP_STRENGTH : AP_STRENGTH + 4] = [self.rng.uniform(0.95, 1.05) for _ in range(4)]
        self.fleet = ArenaFleet(
            [start],
            plant=self.plant,
            noise=SensorNoise(gyro=0.1, accelerometer=0.005, force=0.0),
            rng=np.random.default_rng([seed, 1]),
        )
        # One flight in four with the firmware's other controller, which is slower.
        self.mellinger = seed % 4 != 3
        self.fleet.set_param(0, "stabilizer.controller", 2 if self.mellinger else 1)
        self.link = FleetLink(self.fleet, self.clock, random.Random(seed))
        source = SimSource(
            self.clock, self._truth, CameraModel(rate=100.0), np.random.default_rng([seed, 2])
        )
        self.cameras = FaultyCameras(source, self.clock)
        self.gate = CommandGate(
            self.link,
            self.fence,
            self.clock,
            self._limits(limits or FAULTS[fault].limits),
            state=self._believed,
        )
        forwarder = PoseForwarder({BODY: VEHICLE}, self.gate.send_external_poses, self.clock)
        self.watchdog: Watchdog
        self.pipeline = PosePipeline(
            self.cameras,
            PoseEstimator([BODY, OTHER]),
            self.clock,
            forwarder=forwarder,
            on_frame=[lambda frame, result: self.watchdog.on_frame(frame, result)],
        )
        self.watchdog = Watchdog(
            self.gate,
            self.fence,
            self.clock,
            {BODY: VEHICLE},
            self.pipeline.estimate,
            feed=self.link.feed,
            props=(OTHER,),
            grounds={VEHICLE: float(start[2])},
        )
        speed = self.rng.uniform(0.8, 2.0) if self.mellinger else self.rng.uniform(0.3, 0.5)
        climb = _CLIMB if self.mellinger else 2.0 * _CLIMB
        self.circuit = Circuit(start, self.rng, speed, climb)
        self.onset = self.rng.uniform(*_ONSET) + climb - _CLIMB
        self.ground_station_alive = True
        self.contestant: Callable[[float], c.Command | None] | None = None
        self.silence_is_an_answer = False
        self.stall = 0.0
        self.gust = np.zeros(3)
        self.each: Callable[[float], None] | None = None
        self._excursion = Excursion(self.fence)

    def _limits(self, limits: Limits) -> Limits:
        return limits if self.mellinger else replace(limits, braking=PID_BRAKING)

    # What faults use

    @property
    def setpoint(self) -> c.FullState:
        """What the contestant's own flight wants now."""
        return self.circuit.at(self.clock.now() - _BOOT)

    def position(self) -> np.ndarray:
        """True position, m."""
        return self.fleet.true_state(0).position

    # The flight

    def run(self) -> Outcome:
        """Fly until the motors are off for good, or patience ends."""
        struck = False
        next_step = _BOOT
        landing = False
        speed = 0.0
        off_since: float | None = None
        flown = False
        end = _MISSION + _LAND_TIME + _PATIENCE
        now = 0.0
        while now < end:
            self.clock.sleep_until(now)
            if not struck and now >= self.onset:
                struck = True
                speed = float(np.linalg.norm(self.fleet.true_state(0).velocity))
                FAULTS[self.fault].strike(self)
            if struck and self.each is not None:
                self.each(now - self.onset)
            self.link.deliver()
            if self.ground_station_alive:
                frames = self.pipeline.poll()
                if frames or now - self._watched_at() >= 0.005:
                    self.watchdog.step()
                    self._stepped = now
                if now >= next_step:
                    if self.stall > 0.0:
                        next_step = now + self.stall
                        self.stall = 0.0
                    else:
                        self.watchdog.step_late(max(0.0, now - next_step))
                        landing = self._control(now, landing)
                        next_step = max(next_step + 1.0 / _RATE, now - 1.0 / _RATE)
            self.fleet.advance(round(_QUANTUM * 1000))
            if self.gust.any():
                mass = self.fleet.plants[0, P_MASS]
                self.fleet.bodies[0, B_VEL : B_VEL + 3] += self.gust / mass * _QUANTUM
            state = self.fleet.true_state(0)
            flown = flown or state.position[2] > 0.3
            off = flown and not self.fleet.rows(0).motors.any()
            self._excursion.see(state, off)
            off_since = (now if off_since is None else off_since) if off else None
            if struck and self._excursion.lies and off_since is not None and now - off_since > 0.5:
                break
            now += _QUANTUM
        return self._outcome(off_since, speed)

    _stepped = -math.inf

    def _watched_at(self) -> float:
        return self._stepped

    def _control(self, now: float, landing: bool) -> bool:
        if self.watchdog.action(VEHICLE).takes_over:
            return True
        if now >= _BOOT + _MISSION and not landing:
            self.watchdog.controller_done(VEHICLE)
            self._try(c.Land(0.0, _LAND_TIME))
            self._try(c.NotifySetpointsStop())
            return True
        if landing:
            return True
        if self.contestant is None:
            self._try(self.setpoint)
            self.watchdog.controller_answered(VEHICLE)
        else:
            command = self.contestant(now)
            if command is not None:
                self._try(command)
            if command is not None or self.silence_is_an_answer:
                self.watchdog.controller_answered(VEHICLE)
        return False

    def _try(self, command: c.Command) -> None:
        with contextlib.suppress(CommandError):  # counted by the gate
            self.gate.runner.send(command, VEHICLE)

    def _truth(self, time: float) -> dict[str, Pose]:
        other = Pose(np.array([2.6, 2.6, 0.03]))
        return {BODY: self.fleet.true_pose(0), OTHER: other}

    def _believed(self, vehicle: int) -> Any:
        estimate = self.pipeline.estimate(BODY)
        return estimate.state if estimate.age < 0.3 else self.link.telemetry(vehicle).state

    def _outcome(self, off_since: float | None, speed: float) -> Outcome:
        events = self.watchdog.events
        action = self.watchdog.action(VEHICLE)
        taken = [e.rule for e in events if e.action.takes_over]
        end = "flying"
        if off_since is not None:
            # The firmware alone knows whether it was locked in the air.
            locked = bool(self.fleet.supervisor_info(0) & (LOCKED | CRASHED))
            end = "cut" if action is Action.CUT or locked else "landed"
        return Outcome(
            self.fault,
            self.seed,
            self._excursion.worst,
            math.inf if off_since is None else max(0.0, off_since - self.onset),
            end,
            int(action),
            taken[0] if taken else "",
            speed,
            self.onset,
            list(events),
        )


# The faults


@dataclass(frozen=True, slots=True)
class Fault:
    """One kind of trouble; ``strike`` sets it in motion.

    ``physical`` faults (a motor, the wind) throw the vehicle out of what any software controls and
    are not held to the fence as the rest is; ``link`` faults leave it to its own firmware.
    """

    strike: Callable[[Flight], None]
    physical: bool = False
    link: bool = False
    limits: Limits = field(default_factory=Limits)

    @property
    def kind(self) -> str:
        """``physical``, ``link`` or ``software``."""
        return "physical" if self.physical else "link" if self.link else "software"


def _dropout(f: Flight) -> None:
    duration = f.rng.choice((0.05, 0.2, 0.6, 60.0))

    def spoil(frame: PoseFrame) -> PoseFrame | None:
        gone = frame.timestamp - f.onset < duration
        bodies = {k: v for k, v in frame.bodies.items() if k != BODY}
        return replace(frame, bodies=bodies) if gone else frame

    def silent(frame: PoseFrame) -> PoseFrame | None:
        return None if frame.timestamp - f.onset < duration else frame

    f.cameras.spoil = f.rng.choice((spoil, silent))


def _freeze(f: Flight) -> None:
    frozen: dict[str, Pose] = {}

    def spoil(frame: PoseFrame) -> PoseFrame:
        if not frozen:
            frozen.update(frame.bodies)
        return replace(frame, bodies=frozen)

    f.cameras.spoil = spoil


def _hiccup(f: Flight) -> None:
    """Again and again the cameras tell of one place, with noise and fresh stamps, and catch up."""
    duration, gap = f.rng.uniform(0.06, 0.2), f.rng.uniform(0.2, 1.0)
    noise = np.random.default_rng(f.seed)
    old: Pose | None = None

    def spoil(frame: PoseFrame) -> PoseFrame:
        nonlocal old
        pose = frame.bodies.get(BODY)
        since = (frame.timestamp - f.onset) % (duration + gap)
        if pose is None or since > duration:
            old = None
            return frame
        old = old or pose
        stuck = Pose(old.position + noise.normal(0.0, 3e-4, 3), pose.quaternion)
        return replace(frame, bodies={**frame.bodies, BODY: stuck})

    f.cameras.spoil = spoil


def _jump(f: Flight) -> None:
    duration = f.rng.choice((0.01, 0.05, 0.3, 60.0))
    angle = f.rng.uniform(0.0, 2.0 * math.pi)
    size = f.rng.uniform(0.3, 3.0)
    offset = np.array([size * math.cos(angle), size * math.sin(angle), f.rng.uniform(-0.3, 0.3)])

    def spoil(frame: PoseFrame) -> PoseFrame:
        pose = frame.bodies.get(BODY)
        if pose is None or frame.timestamp - f.onset > duration:
            return frame
        moved = Pose(pose.position + offset, pose.quaternion)
        return replace(frame, bodies={**frame.bodies, BODY: moved})

    f.cameras.spoil = spoil


def _swap(f: Flight) -> None:
    duration = f.rng.choice((0.03, 0.5, 60.0))

    def spoil(frame: PoseFrame) -> PoseFrame:
        if frame.timestamp - f.onset > duration:
            return frame
        names = {BODY: OTHER, OTHER: BODY}
        return replace(frame, bodies={names.get(k, k): v for k, v in frame.bodies.items()})

    f.cameras.spoil = spoil


def _latency(f: Flight) -> None:
    rate, most = f.rng.uniform(0.05, 0.5), f.rng.uniform(0.05, 0.5)

    def grow(since: float) -> None:
        f.cameras.delay = min(rate * since, most)

    f.each = grow


def _loss(f: Flight) -> None:
    f.link.loss = f.rng.uniform(0.2, 0.7)


def _burst(f: Flight) -> None:
    duration = f.rng.uniform(0.1, 0.9)
    pause = f.rng.uniform(0.3, 2.0)

    def burst(since: float) -> None:
        f.link.cut = since % (duration + pause) < duration

    f.each = burst


def _cut(f: Flight) -> None:
    f.link.cut = True


def _outwards(f: Flight) -> np.ndarray:
    angle = f.rng.choice((0.0, 0.5, 1.0, 1.5)) * math.pi + f.rng.uniform(-0.3, 0.3)
    return np.array([math.cos(angle), math.sin(angle), 0.0])


def _outside(f: Flight) -> None:
    target = f.position() + 5.0 * _outwards(f)
    f.contestant = lambda now: c.FullState(target, np.zeros(3), np.zeros(3), 0.0, np.zeros(3))


def _ramp(f: Flight, direction: np.ndarray, speed: float) -> None:
    """Accelerate from the present setpoint to ``speed`` along ``direction``, and never stop."""
    start = f.setpoint
    place = np.array(start.position, dtype=float)
    velocity = np.array(start.velocity, dtype=float)
    last = f.clock.now()

    def fly(now: float) -> c.Command:
        nonlocal last
        dt, last = now - last, now
        change = speed * direction - velocity
        size = float(np.linalg.norm(change))
        push = change * min(1.0, 4.0 * dt / size) if size > 1e-9 and dt > 0 else np.zeros(3)
        velocity[:] += push
        place[:] += velocity * dt
        acceleration = push / dt if dt > 0 else np.zeros(3)
        return c.FullState(place.copy(), velocity.copy(), acceleration, 0.0, np.zeros(3))

    f.contestant = fly


def _up(f: Flight) -> None:
    _ramp(f, np.array([0.0, 0.0, 1.0]), f.rng.uniform(0.5, 2.0))


def _wall(f: Flight) -> None:
    _ramp(f, _outwards(f), 2.0)


def _wall_velocity(f: Flight) -> None:
    velocity = 2.0 * _outwards(f)
    f.contestant = lambda now: c.VelocityWorld(velocity)


def _position_step(f: Flight) -> None:
    target = f.position() + 5.0 * _outwards(f)
    f.contestant = lambda now: c.Position(target)


def _go_to_wall(f: Flight) -> None:
    """A plan of the vehicle's own, to the fence at up to 2 m/s."""
    place = f.position()
    out = _outwards(f)
    away = 0.1
    while f.fence.clearance(*(place + (away + 0.05) * out).tolist()) > 0.0:
        away += 0.05
    plan = c.GoTo(place + away * out, 0.0, max(0.5, 35.0 / 16.0 * away / 2.0))
    orders = iter((c.NotifySetpointsStop(), plan))
    f.silence_is_an_answer = True
    f.contestant = lambda now: next(orders, None)


def _tilt(f: Flight) -> None:
    roll, pitch = f.rng.choice(((0.4, 0.0), (-0.4, 0.0), (0.0, 0.4), (0.0, -0.4)))
    f.contestant = lambda now: c.Attitude(roll, pitch, 0.0, 42000)


def _nan(f: Flight) -> None:
    broken = np.array([math.nan, 0.0, 1.0])
    f.contestant = lambda now: c.FullState(broken, np.zeros(3), np.zeros(3), 0.0, np.zeros(3))


def _silent(f: Flight) -> None:
    f.contestant = lambda now: None


def _stuck(f: Flight) -> None:
    last = f.setpoint
    f.contestant = lambda now: last


def _oscillating(f: Flight) -> None:
    middle = np.array(f.setpoint.position, dtype=float)
    step = f.rng.uniform(0.3, 1.5) * _outwards(f)
    period = f.rng.uniform(0.1, 0.6)

    def swing(now: float) -> c.Command:
        side = 1.0 if (now // period) % 2 else -1.0
        return c.FullState(middle + side * step, np.zeros(3), np.zeros(3), 0.0, np.zeros(3))

    f.contestant = swing


def _battery(f: Flight) -> None:
    if f.rng.random() < 0.5:
        f.fleet.plants[0, AP_RESISTANCE] *= f.rng.uniform(1.5, 2.5)
    else:
        drawn = f.rng.uniform(0.93, 0.99)
        f.fleet.bodies[0, AB_CHARGE] = drawn * f.fleet.plants[0, AP_CAPACITY]


def _motor(f: Flight) -> None:
    f.fleet.plants[0, AP_STRENGTH + f.rng.randrange(4)] *= f.rng.choice((0.0, 0.3, 0.6))


def _gust(f: Flight) -> None:
    # Up to what a wind of some 10 m/s does to a vehicle of this size, a third of its weight.
    direction = _outwards(f)
    force, duration = f.rng.uniform(0.03, 0.1), f.rng.uniform(0.2, 1.5)

    def blow(since: float) -> None:
        f.gust = force * direction if since < duration else np.zeros(3)

    f.each = blow


def _late(f: Flight) -> None:
    stall = f.rng.uniform(0.05, 1.0)
    gap = f.rng.uniform(0.2, 1.0)
    due = 0.0

    def stumble(since: float) -> None:
        nonlocal due
        if since >= due:
            f.stall = stall
            due = since + stall + gap

    f.each = stumble


def _cut_at_wall(f: Flight) -> None:
    """Lose the radio anywhere on the way to a wall, by whatever means the vehicle heads for it."""
    kind = f.rng.choice((_wall, _wall, _wall_velocity, _position_step, _go_to_wall, _up))
    kind(f)
    after = f.rng.uniform(0.1, 1.6)

    def listen(since: float) -> None:
        f.link.cut = since >= after

    f.each = listen


def _killed(f: Flight) -> None:
    f.ground_station_alive = False


FAULTS: dict[str, Fault] = {
    "mocap_dropout": Fault(_dropout),
    "mocap_freeze": Fault(_freeze),
    "mocap_hiccup": Fault(_hiccup),
    "mocap_jump": Fault(_jump),
    "identity_swap": Fault(_swap),
    "latency_growth": Fault(_latency),
    "radio_loss": Fault(_loss),
    "radio_burst": Fault(_burst, link=True),
    "radio_cut": Fault(_cut, link=True),
    "radio_cut_at_wall": Fault(_cut_at_wall, link=True),
    "outside": Fault(_outside),
    "straight_up": Fault(_up),
    "wall": Fault(_wall),
    "wall_velocity": Fault(_wall_velocity),
    "position_step": Fault(_position_step),
    "tilt": Fault(_tilt, limits=Limits(allow_attitude=True, max_speed=2.3, setpoint_speed=2.0)),
    "nan": Fault(_nan),
    "silent": Fault(_silent),
    "stuck": Fault(_stuck),
    "oscillating": Fault(_oscillating),
    "battery_sag": Fault(_battery),
    "motor_failure": Fault(_motor, physical=True),
    "wind_gust": Fault(_gust, physical=True),
    "late_scheduler": Fault(_late),
    "killed_process": Fault(_killed, link=True),
}


def fly(fault: str, seed: int, level: str = "level0") -> Outcome:
    """One flight of the campaign."""
    return Flight(fault, seed, load_level(level)).run()


def _fly_job(job: tuple[str, int, str]) -> Outcome:
    return fly(*job)


def run_campaign(
    faults: Iterable[str],
    seeds: int,
    level: str = "level0",
    workers: int = 1,
    on_flight: Callable[[Outcome], None] | None = None,
) -> list[Outcome]:
    """Every fault with every seed.

    Raises
    ------
    InputError: an unknown fault.
    """
    names = list(faults)
    for name in names:
        if name not in FAULTS:
            raise InputError(f"fault {name!r}: choose from {', '.join(FAULTS)}")
    jobs = [(name, seed, level) for name in names for seed in range(seeds)]
    outcomes = []
    if workers <= 1:
        for job in jobs:
            outcomes.append(_fly_job(job))
            if on_flight is not None:
                on_flight(outcomes[-1])
        return outcomes
    with ProcessPoolExecutor(workers) as pool:
        for outcome in pool.map(_fly_job, jobs, chunksize=4):
            outcomes.append(outcome)
            if on_flight is not None:
                on_flight(outcome)
    return outcomes


def summarise(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """One row per fault: counts, worst excursion (m) and time to safe state (s)."""
    rows = []
    for name in dict.fromkeys(outcome.fault for outcome in outcomes):
        mine = [outcome for outcome in outcomes if outcome.fault == name]
        times = sorted(outcome.safe_after for outcome in mine)
        rows.append(
            {
                "fault": name,
                "kind": FAULTS[name].kind,
                "flights": len(mine),
                "safe": sum(outcome.safe for outcome in mine),
                "landed": sum(outcome.end == "landed" for outcome in mine),
                "cut": sum(outcome.end == "cut" for outcome in mine),
                "taken over": sum(bool(outcome.rule) for outcome in mine),
                "worst excursion": max(outcome.excursion for outcome in mine),
                "median time": times[len(times) // 2],
                "worst time": times[-1],
            }
        )
    return rows


def failures(outcomes: Iterable[Outcome], margin: float, allowed: float = 0.1) -> list[Outcome]:
    """Flights that did not end safely, or left the hard fence by more than ``allowed`` m; by
    more than ``margin`` m where motors fail or wind blows."""
    return [
        outcome
        for outcome in outcomes
        if not outcome.safe
        or outcome.excursion > (margin if FAULTS[outcome.fault].physical else allowed)
    ]
