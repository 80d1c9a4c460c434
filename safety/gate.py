"""The last stop of every command before a backend, simulated or real.

:class:`CommandGate` is a backend that refuses everybody: who may send gets a
:class:`GatePort`. The runner's port checks, clamps and counts; the safety port lets pass. When
a trial is over, or the watchdog has taken a vehicle, the runner's port accepts nothing but what
stops motors. An emergency stop passes every port at any time.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

import numpy as np

from crazyarena.clock import Clock
from crazyarena.crazyswarm_compat import commands as c
from crazyarena.crazyswarm_compat.backend import Backend
from crazyarena.crazyswarm_compat.checks import check, verb
from crazyarena.errors import CommandError, InputError
from crazyarena.safety.events import Action, SafetyEvent
from crazyarena.safety.fence import Fence
from crazyarena.safety.limits import Limits
from crazyarena.safety.link_loss import LinkLoss, largest_share
from crazyarena.safety.observation import Point, as_point
from crazyarena.types import Pose, Telemetry, VehicleState

_STOPPING = (c.Emergency, c.CutMotors, c.Stop)
_FLYING = (*c.STREAMED, c.Takeoff, c.GoTo, c.StartTrajectory)
# Peaks of the firmware's rest-to-rest polynomial of 7th order over distance and duration.
_PEAK_SPEED = 35.0 / 16.0
_PEAK_ACCELERATION = 7.5132
_SAMPLES_PER_PIECE = 24
# What may be written in flight: decoration, and the gains of controllers. Nothing that stops or
# blinds a vehicle (supervisor, estimator, motors, commander).
_PARAMETERS_IN_FLIGHT = (
    "ring.",
    "led.",
    "colAv.",
    "ctrlMel.",
    "posCtlPid.",
    "velCtlPid.",
    "pid_attitude.",
    "pid_rate.",
    "hlCommander.",
)
_NEVER_BY_RUNNER = ("motorPowerSet.", "system.", "health.", "powerDist.idleThrust")
_TELEMETRY_GOOD = 0.3  # s, up to which the vehicle's own estimate is carried on
_VELOCITY_HORIZON = 0.5  # s of a velocity setpoint that have to end inside the fence
_OUT_IF_LOST = "it would carry the vehicle out of the fence if the link were lost now"
_MEMORY = 0.5  # s after which the last setpoint no longer bounds the next

Listener = Callable[[c.Command, c.Command | None, str, int | None], None]


class Policy(StrEnum):
    """What happens to a setpoint outside of what is allowed."""

    CLAMP = "clamp"
    REFUSE = "refuse"


class Refused(CommandError):
    """The command gate did not let a command pass."""


@dataclass(slots=True)
class _Vehicle:
    """What the gate remembers of one vehicle."""

    taken: bool = False
    flying_since: float | None = None
    ending: bool = False
    forwarded: Pose | None = None
    setpoint: Point | None = None  # last streamed position
    velocity: Point = (0.0, 0.0, 0.0)
    setpoint_time: float = -math.inf
    streaming: bool = False
    is_reference: bool = False
    tokens: float = 0.0
    tokens_time: float = -math.inf


class CommandGate:
    """A backend behind checks; see the module's text.

    Parameters
    ----------
    backend: what commands go to in the end.
    policy: for setpoints outside the fence or beyond the limits. Commands that are wrong in
        type, shape or range are refused under either.
    state: latest believed state of a vehicle, or None; bounds setpoints to what is near.
    on_command: called with (asked, sent or None, reason or "", vehicle) for every command of
        the runner, in the calling thread: the recorder.
    on_event: called with a :class:`SafetyEvent` for what was changed or refused.
    """

    def __init__(
        self,
        backend: Backend,
        fence: Fence,
        clock: Clock,
        limits: Limits | None = None,
        policy: Policy = Policy.CLAMP,
        state: Callable[[int], VehicleState | None] | None = None,
        on_command: Listener | None = None,
        on_event: Callable[[SafetyEvent], None] | None = None,
    ) -> None:
        self._backend = backend
        self._fence = fence
        self._clock = clock
        self.limits = limits or Limits()
        self._link_loss = LinkLoss(fence, self.limits)
        self._policy = policy
        self._state = state or (lambda vehicle: None)
        self._on_command = on_command
        self._on_event = on_event
        self._lock = threading.Lock()
        self._vehicles = {vehicle: _Vehicle() for vehicle in backend.vehicles}
        self._trajectories: dict[tuple[int, int], np.ndarray] = {}
        self._closed_reason: str | None = None
        self.passed = self.changed = self.refused = self.poses_dropped = 0
        self.runner = GatePort(self, trusted=False)
        self.safety = GatePort(self, trusted=True)

    # Backend, for whoever is neither the runner nor safety

    @property
    def vehicles(self) -> Sequence[int]:
        return self._backend.vehicles

    def send(self, command: c.Command, vehicle: int | None = None) -> None:
        """Only an emergency stop passes; raises :class:`Refused` for the rest."""
        if isinstance(command, c.Emergency):
            self._backend.send(command, vehicle)
            return
        raise Refused(
            f"{_who(vehicle)}: {type(command).__name__} came past the runner; only the runner's "
            "port of the command gate may fly vehicles"
        )

    def send_external_poses(self, poses: Mapping[int, Pose]) -> None:
        """Forward what a vehicle may believe: its estimator fuses whatever it is given.

        Dropped, and counted in ``poses_dropped``: what is not finite, what repeats the last one
        to the bit (an old pose in a new frame), and, in flight, what is further from the
        vehicle's own estimate than it can have gone.
        """
        good = {}
        for vehicle, pose in poses.items():
            if self._believable(vehicle, pose):
                good[vehicle] = pose
            else:
                self.poses_dropped += 1
        if good:
            self._backend.send_external_poses(good)

    def _believable(self, vehicle: int, pose: Pose) -> bool:
        memory = self._vehicles.get(vehicle)
        if memory is None:
            return False
        last, memory.forwarded = memory.forwarded, pose
        if not np.isfinite(pose.position).all() or np.isinf(pose.quaternion).any():
            return False
        if (
            last is not None
            and np.array_equal(last.position, pose.position)
            and np.array_equal(last.quaternion, pose.quaternion, equal_nan=True)
        ):
            return False
        own = self._backend.telemetry(vehicle).state
        if memory.flying_since is None or own is None:
            return True
        age = self._clock.now() - own.timestamp
        if not 0.0 <= age <= _TELEMETRY_GOOD:
            return True
        expected = own.position + age * own.velocity
        gone = float(np.linalg.norm(pose.position - expected))
        return gone <= self.limits.disagreement + 0.5 * self.limits.setpoint_acceleration * age**2

    def telemetry(self, vehicle: int) -> Telemetry:
        return self._backend.telemetry(vehicle)

    def get_param(self, vehicle: int, name: str) -> float:
        return self._backend.get_param(vehicle, name)

    def close(self) -> None:
        self._backend.close()

    # What safety tells the gate

    def end_trial(self, reason: str) -> None:
        """From now on the runner's commands are refused, except those that stop motors."""
        self._closed_reason = reason

    def take(self, vehicle: int) -> None:
        """The watchdog has this vehicle; the runner's commands to it are refused."""
        self._vehicles[vehicle].taken = True

    def flying_since(self, vehicle: int) -> float | None:
        """When the runner first sent something that makes the vehicle fly, s; None before, and
        once it stands again after a landing."""
        return self._vehicles[vehicle].flying_since

    def stands(self, vehicle: int) -> None:
        """The vehicle has been seen standing for a while; if it was told to land, that was it."""
        memory = self._vehicles[vehicle]
        if memory.ending:
            memory.flying_since = None

    def reference(self, vehicle: int, now: float) -> Point | None:
        """Where a streamed full-state setpoint wants the vehicle to be now, m."""
        memory = self._vehicles[vehicle]
        if memory.setpoint is None or not (memory.streaming and memory.is_reference):
            return None
        age = min(max(now - memory.setpoint_time, 0.0), 0.1)
        (x, y, z), (vx, vy, vz) = memory.setpoint, memory.velocity
        return x + vx * age, y + vy * age, z + vz * age

    def stream_age(self, vehicle: int, now: float) -> float | None:
        """s since the last streamed setpoint while the vehicle depends on the next one."""
        memory = self._vehicles[vehicle]
        return now - memory.setpoint_time if memory.streaming else None

    # Passing

    def _pass_trusted(self, command: c.Command, vehicle: int | None) -> None:
        self._backend.send(command, vehicle)

    def _pass_checked(self, command: c.Command, vehicle: int | None) -> None:
        if isinstance(command, _STOPPING):
            # Never counted, never changed: what stops motors must not depend on anything.
            self._backend.send(command, vehicle)
            self._note_stop(command, vehicle)
            self._tell(command, command, "", vehicle)
            return
        targets = list(self._vehicles) if vehicle is None else [vehicle]
        try:
            check(command, _who(vehicle))
            with self._lock:
                self._admit(command, vehicle, targets)
                sent = {target: self._fit(command, target) for target in targets}
        except CommandError as error:
            self.refused += 1
            self._tell(command, None, str(error), vehicle)
            self._report("gate_refused", vehicle, str(error))
            raise
        if vehicle is None and all(one is command for one, _ in sent.values()):
            self._backend.send(command, None)
        else:
            for target, (one, _) in sent.items():
                self._backend.send(one, target)
        self.passed += 1
        for target, (one, reason) in sent.items():
            if reason:
                self.changed += 1
                self._report("gate_clamped", target, reason)
            self._tell(command, one, reason, target if reason else vehicle)
            if vehicle is None and not reason:
                break

    def _admit(self, command: c.Command, vehicle: int | None, targets: Sequence[int]) -> None:
        if self._closed_reason is not None:
            raise Refused(
                f"{_who(vehicle)}: {verb(command)}: the trial is over ({self._closed_reason})"
            )
        for target in targets:
            if target not in self._vehicles:
                raise Refused(
                    f"cf{target}: {verb(command)}: no such vehicle; there are "
                    f"{list(self._vehicles)}"
                )
            if self._vehicles[target].taken:
                raise Refused(f"cf{target}: {verb(command)}: the watchdog has taken over")
        now = self._clock.now()
        for target in targets:
            memory = self._vehicles[target]
            gained = (now - memory.tokens_time) * self.limits.command_rate
            memory.tokens = min(self.limits.command_burst, memory.tokens + gained)
            memory.tokens_time = now
            if memory.tokens < 1.0:
                raise Refused(
                    f"cf{target}: {verb(command)}: more than {self.limits.command_rate:g} commands "
                    "per second"
                )
            memory.tokens -= 1.0

    def _fit(self, command: c.Command, vehicle: int) -> tuple[c.Command, str]:
        """The command as it may be sent, and what had to be changed about it."""
        now = self._clock.now()
        memory = self._vehicles[vehicle]
        fitter = _FITTERS.get(type(command))
        fitted, reasons = (command, []) if fitter is None else fitter(self, command, vehicle, now)
        if reasons and self._policy is Policy.REFUSE:
            raise Refused(f"cf{vehicle}: {verb(command)}: {'; '.join(reasons)}")
        if isinstance(fitted, _FLYING):
            memory.ending = False
            if memory.flying_since is None:
                memory.flying_since = now
        elif isinstance(fitted, c.Land):
            memory.ending = True
        if isinstance(fitted, c.STREAMED):
            memory.streaming = True
            memory.setpoint_time = now
            memory.is_reference = isinstance(fitted, c.FullState)
            if isinstance(fitted, c.FullState | c.Position):
                memory.setpoint = as_point(fitted.position)
            else:
                memory.setpoint = None
            memory.velocity = (0.0, 0.0, 0.0)
            if isinstance(fitted, c.FullState):
                memory.velocity = as_point(fitted.velocity)
        elif isinstance(fitted, c.NotifySetpointsStop | c.Land | c.Takeoff | c.GoTo):
            memory.streaming = False
        return fitted, "; ".join(reasons)

    def _note_stop(self, command: c.Command, vehicle: int | None) -> None:
        for target in self._vehicles if vehicle is None else [vehicle]:
            memory = self._vehicles.get(target)
            if memory is not None:
                memory.streaming = False
                memory.ending = True
                memory.setpoint = None

    # What fits, by kind of command

    def _where(self, vehicle: int) -> Point | None:
        state = self._state(vehicle)
        return None if state is None else as_point(state.position)

    def _motion(self, vehicle: int) -> tuple[Point, Point] | None:
        """Place and velocity for the look at link losses; None if off, or nobody knows them."""
        state = self._state(vehicle) if self._link_loss.on else None
        return None if state is None else (as_point(state.position), as_point(state.velocity))

    def _inside(self, point: Point, vehicle: int, reasons: list[str], what: str) -> Point:
        margin = self._fence.soft_margin
        room = self._fence.room(*point)
        # The level's own start or goal may lie between soft and hard limit, so only what is
        # beyond the hard one is moved, and then to the soft one.
        if room >= 0.0:
            return point
        try:
            moved = self._fence.nearest(point, margin, self._where(vehicle))
        except InputError:
            raise Refused(
                f"cf{vehicle}: {what} {_text(point)} m is outside the fence, and nothing inside "
                "is near"
            ) from None
        reasons.append(
            f"{what} {_text(point)} m is {-room:.2f} m outside the fence, moved to {_text(moved)}"
        )
        return moved

    def _slowed(self, velocity: Point, reasons: list[str], what: str, limit: float) -> Point:
        size = math.hypot(*velocity)
        if size <= limit:
            return velocity
        reasons.append(f"{what} of {size:.2f} is above {limit:g}")
        share = limit / size
        return velocity[0] * share, velocity[1] * share, velocity[2] * share

    def _near_fence(self, place: Point, velocity: Point, reasons: list[str]) -> Point:
        """Slow a velocity setpoint that leads out of the fence, or would if it were the last."""
        if self._link_loss.on:
            allowed = self._link_loss.velocity(place, velocity)
            if allowed is not None:
                reasons.append(
                    f"velocity {_text(velocity)} m/s would lead out of the fence if the link were "
                    "lost now"
                )
                velocity = allowed
        if math.hypot(*velocity) < 1e-9:
            return velocity
        horizon = _VELOCITY_HORIZON

        def room_after(share: float) -> float:
            ahead = [p + share * horizon * v for p, v in zip(place, velocity, strict=True)]
            return self._fence.room(ahead[0], ahead[1], max(ahead[2], self._fence.floor))

        if room_after(1.0) >= 0.0 and room_after(0.5) >= 0.0:
            return velocity
        left = largest_share(lambda share: room_after(share) >= 0.0, 12)
        reasons.append(
            f"velocity {_text(velocity)} m/s leads out of the fence within {horizon:g} s"
        )
        return velocity[0] * left, velocity[1] * left, velocity[2] * left

    def _reachable(self, point: Point, vehicle: int, now: float, reasons: list[str]) -> Point:
        """Bound a streamed position by the one before it, and by where the vehicle is."""
        n = self.limits
        memory = self._vehicles[vehicle]
        age = now - memory.setpoint_time
        if memory.setpoint is not None and age <= _MEMORY:
            limit = n.setpoint_step + n.setpoint_speed * age
            point = _towards(memory.setpoint, point, limit, "last setpoint", reasons)
        where = self._where(vehicle)
        if where is not None:
            point = _towards(where, point, n.setpoint_lead, "vehicle", reasons)
        return point

    def _full_state(self, m: c.FullState, vehicle: int, now: float) -> tuple[c.Command, list[str]]:
        n = self.limits
        reasons: list[str] = []
        asked = as_point(m.position)
        place = self._inside(asked, vehicle, reasons, "position")
        place = self._reachable(place, vehicle, now, reasons)
        velocity = self._slowed(as_point(m.velocity), reasons, "speed", n.setpoint_speed)
        acceleration = self._slowed(
            as_point(m.acceleration), reasons, "acceleration", n.setpoint_acceleration
        )
        if place != asked:
            # A setpoint held back must not go on pushing outwards.
            velocity, acceleration = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
        motion = self._motion(vehicle)
        if motion is not None:
            slower = self._link_loss.feedforward(*motion, place, velocity, acceleration)
            if slower is not None:
                reasons.append(_OUT_IF_LOST)
                velocity = slower
        omega = self._slowed(as_point(m.omega), reasons, "body rate", 30.0)
        if not reasons:
            return m, reasons
        return c.FullState(place, velocity, acceleration, float(m.yaw), omega), reasons

    def _position(self, m: c.Position, vehicle: int, now: float) -> tuple[c.Command, list[str]]:
        reasons: list[str] = []
        place = self._inside(as_point(m.position), vehicle, reasons, "position")
        place = self._reachable(place, vehicle, now, reasons)
        motion = self._motion(vehicle)
        if motion is not None:
            nearer = self._link_loss.position(*motion, place)
            if nearer is not None:
                reasons.append(_OUT_IF_LOST)
                place = nearer
        return (replace(m, position=place) if reasons else m), reasons

    def _velocity(
        self, m: c.VelocityWorld, vehicle: int, now: float
    ) -> tuple[c.Command, list[str]]:
        reasons: list[str] = []
        velocity = self._slowed(as_point(m.velocity), reasons, "speed", self.limits.setpoint_speed)
        where = self._where(vehicle)
        if where is not None:
            velocity = self._near_fence(where, velocity, reasons)
        return (replace(m, velocity=velocity) if reasons else m), reasons

    def _hover(self, m: c.Hover, vehicle: int, now: float) -> tuple[c.Command, list[str]]:
        reasons: list[str] = []
        level = (float(m.vx), float(m.vy), 0.0)
        velocity = self._slowed(level, reasons, "speed", self.limits.setpoint_speed)
        height = float(m.height)
        state = self._state(vehicle)
        if state is not None:
            x, y, z = as_point(state.position)
            yaw = _yaw(state.quaternion)
            cos, sin = math.cos(yaw), math.sin(yaw)
            world = (cos * velocity[0] - sin * velocity[1], sin * velocity[0] + cos * velocity[1])
            wx, wy, _ = self._near_fence((x, y, z), (*world, 0.0), reasons)
            velocity = (cos * wx + sin * wy, cos * wy - sin * wx, 0.0)
            height = self._inside((x, y, height), vehicle, reasons, "height at")[2]
        else:
            low, high = self._fence.bounds
            height = min(max(height, low[2]), high[2] - self._fence.soft_margin)
            if height != m.height:
                reasons.append(f"height {m.height:g} m is outside the fence")
        if not reasons:
            return m, reasons
        return replace(m, vx=velocity[0], vy=velocity[1], height=height), reasons

    def _attitude(self, m: c.Attitude, vehicle: int, now: float) -> tuple[c.Command, list[str]]:
        if not self.limits.allow_attitude:
            raise Refused(
                f"cf{vehicle}: cmdVel: attitude setpoints cannot be held inside a fence; the "
                "safety limit allow_attitude lets them pass"
            )
        limit = self.limits.setpoint_tilt
        roll, pitch = (min(max(float(a), -limit), limit) for a in (m.roll, m.pitch))
        if (roll, pitch) == (float(m.roll), float(m.pitch)):
            return m, []
        reason = f"tilt of roll {m.roll:.2f}, pitch {m.pitch:.2f} rad is above {limit:g}"
        return replace(m, roll=roll, pitch=pitch), [reason]

    def _takeoff(self, m: c.Takeoff, vehicle: int, now: float) -> tuple[c.Command, list[str]]:
        reasons: list[str] = []
        x, y, z = self._where(vehicle) or (*_middle(self._fence), 0.0)
        height = self._inside((x, y, float(m.height)), vehicle, reasons, "height at")[2]
        duration = self._duration(abs(height - z), float(m.duration), reasons)
        return (replace(m, height=height, duration=duration) if reasons else m), reasons

    def _land(self, m: c.Land, vehicle: int, now: float) -> tuple[c.Command, list[str]]:
        reasons: list[str] = []
        where = self._where(vehicle)
        low, high = self._fence.bounds
        height = min(max(float(m.height), low[2] - 0.5), high[2] - self._fence.soft_margin)
        if height != m.height:
            reasons.append(f"height {m.height:g} m is outside the fence")
        drop = 0.0 if where is None else abs(where[2] - height)
        duration = self._duration(drop, float(m.duration), reasons)
        return (replace(m, height=height, duration=duration) if reasons else m), reasons

    def _go_to(self, m: c.GoTo, vehicle: int, now: float) -> tuple[c.Command, list[str]]:
        reasons: list[str] = []
        where = self._where(vehicle)
        goal = as_point(m.position)
        if m.relative:
            if where is None:
                raise Refused(
                    f"cf{vehicle}: goTo: relative, but nobody knows where the vehicle is; it "
                    "cannot be checked against the fence"
                )
            x, y, z = (a + b for a, b in zip(goal, where, strict=True))
            moved = self._inside((x, y, z), vehicle, reasons, "goal")
            goal = (goal[0] + moved[0] - x, goal[1] + moved[1] - y, goal[2] + moved[2] - z)
            distance = math.hypot(*goal)
        else:
            goal = self._inside(goal, vehicle, reasons, "goal")
            distance = 0.0 if where is None else math.dist(goal, where)
        duration = self._duration(distance, float(m.duration), reasons)
        motion = self._motion(vehicle)
        if motion is not None:
            (x, y, z), _ = motion
            end = (x + goal[0], y + goal[1], z + goal[2]) if m.relative else goal
            longer = self._link_loss.duration(*motion, end, duration)
            if longer > duration:
                reasons.append(
                    f"cut on the way it would leave the fence in less than {longer:.2f} s"
                )
                duration = longer
        return (replace(m, position=goal, duration=duration) if reasons else m), reasons

    def _duration(self, distance: float, duration: float, reasons: list[str]) -> float:
        """The duration, or the shortest that keeps the polynomial within the limits."""
        n = self.limits
        least = max(
            _PEAK_SPEED * distance / n.setpoint_speed,
            math.sqrt(_PEAK_ACCELERATION * distance / n.setpoint_acceleration),
        )
        if duration >= least:
            return duration
        reasons.append(f"{distance:.2f} m in {duration:g} s is too fast, {least:.2f} s are needed")
        return least

    def _upload(
        self, m: c.UploadTrajectory, vehicle: int, now: float
    ) -> tuple[c.Command, list[str]]:
        self._trajectories[vehicle, int(m.trajectory_id)] = np.array(m.pieces, dtype=np.float64)
        return m, []

    def _start(self, m: c.StartTrajectory, vehicle: int, now: float) -> tuple[c.Command, list[str]]:
        pieces = self._trajectories.get((vehicle, int(m.trajectory_id)))
        if pieces is None:
            raise Refused(
                f"cf{vehicle}: startTrajectory: trajectory {m.trajectory_id} was not uploaded "
                "through this gate, so it cannot be checked"
            )
        places, velocities, acceleration = _along(pieces, float(m.timescale))
        speed = float(np.linalg.norm(velocities, axis=1).max())
        if m.reverse:
            velocities = -velocities
        if m.relative:
            where = self._where(vehicle)
            if where is None:
                raise Refused(
                    f"cf{vehicle}: startTrajectory: relative, but nobody knows where the vehicle is"
                )
            places = places + (np.array(where) - places[-1 if m.reverse else 0])
        worst = min(self._fence.room(x, y, z) for x, y, z in places.tolist())
        for what, found, limit in (
            ("speed", speed, self.limits.setpoint_speed),
            ("acceleration", acceleration, self.limits.setpoint_acceleration),
        ):
            if found > limit:
                raise Refused(
                    f"cf{vehicle}: startTrajectory: {what} reaches {found:.2f}, above {limit:g}; "
                    "use a larger timescale"
                )
        if worst < 0.0:
            raise Refused(f"cf{vehicle}: startTrajectory: it leads {-worst:.2f} m out of the fence")
        if self._link_loss.on:
            lost = max(
                self._link_loss.ballistic_excess(as_point(place), as_point(velocity))
                for place, velocity in zip(places, velocities, strict=True)
            )
            if lost > self.limits.link_loss_margin:
                raise Refused(
                    f"cf{vehicle}: startTrajectory: cut on the way the vehicle would end "
                    f"{lost:.2f} m outside the fence; use a larger timescale or keep away from it"
                )
        self._vehicles[vehicle].streaming = False
        return m, []

    def _set_param(self, m: c.SetParam, vehicle: int, now: float) -> tuple[c.Command, list[str]]:
        name = m.name.replace("/", ".")
        if name.startswith(_NEVER_BY_RUNNER):
            raise Refused(f"cf{vehicle}: setParam: {name} is not for controllers")
        flying = self._vehicles[vehicle].flying_since is not None
        if flying and not name.startswith(_PARAMETERS_IN_FLIGHT):
            raise Refused(f"cf{vehicle}: setParam: {name} cannot be written in flight")
        return m, []

    # Telling

    def _tell(
        self, asked: c.Command, sent: c.Command | None, reason: str, vehicle: int | None
    ) -> None:
        if self._on_command is not None:
            self._on_command(asked, sent, reason, vehicle)

    def _report(self, rule: str, vehicle: int | None, detail: str) -> None:
        if self._on_event is not None:
            self._on_event(
                SafetyEvent(
                    rule,
                    Action.WARN,
                    math.nan,
                    math.nan,
                    Action.WARN,
                    self._clock.now(),
                    vehicle,
                    detail,
                )
            )


_FITTERS: dict[type, Callable[[CommandGate, Any, int, float], tuple[c.Command, list[str]]]] = {
    c.FullState: CommandGate._full_state,
    c.Position: CommandGate._position,
    c.VelocityWorld: CommandGate._velocity,
    c.Hover: CommandGate._hover,
    c.Attitude: CommandGate._attitude,
    c.Takeoff: CommandGate._takeoff,
    c.Land: CommandGate._land,
    c.GoTo: CommandGate._go_to,
    c.UploadTrajectory: CommandGate._upload,
    c.StartTrajectory: CommandGate._start,
    c.SetParam: CommandGate._set_param,
}


class GatePort:
    """One sender's way through a :class:`CommandGate`; a Backend itself."""

    def __init__(self, gate: CommandGate, trusted: bool) -> None:
        self._gate = gate
        self._pass = gate._pass_trusted if trusted else gate._pass_checked

    @property
    def vehicles(self) -> Sequence[int]:
        return self._gate.vehicles

    def send(self, command: c.Command, vehicle: int | None = None) -> None:
        """Send if allowed.

        Raises
        ------
        CommandError: no vehicle could execute it.
        Refused: the gate does not let it pass; nothing was sent.
        """
        self._pass(command, vehicle)

    def send_external_poses(self, poses: Mapping[int, Pose]) -> None:
        self._gate.send_external_poses(poses)

    def telemetry(self, vehicle: int) -> Telemetry:
        return self._gate.telemetry(vehicle)

    def get_param(self, vehicle: int, name: str) -> float:
        return self._gate.get_param(vehicle, name)

    def close(self) -> None:
        """Nothing: the link belongs to whoever made the gate."""


def _who(vehicle: int | None) -> str:
    return "all vehicles" if vehicle is None else f"cf{vehicle}"


def _towards(origin: Point, point: Point, limit: float, what: str, reasons: list[str]) -> Point:
    """``point``, or the one ``limit`` m from ``origin`` on the way to it."""
    distance = math.dist(origin, point)
    if distance <= limit:
        return point
    reasons.append(f"position is {distance:.2f} m from the {what}, at most {limit:.2f} m may be")
    share = limit / distance
    x, y, z = (a + share * (b - a) for a, b in zip(origin, point, strict=True))
    return x, y, z


def _text(point: Point) -> str:
    return "[" + ", ".join(f"{value:.2f}" for value in point) + "]"


def _yaw(q: Any) -> float:
    x, y, z, w = (float(value) for value in q)
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def _middle(fence: Fence) -> tuple[float, float]:
    low, high = fence.bounds
    return 0.5 * (low[0] + high[0]), 0.5 * (low[1] + high[1])


def _along(pieces: np.ndarray, timescale: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Places (k, 3) m and velocities (k, 3) m/s along a trajectory, largest acceleration m/s2."""
    places, velocities, accelerations = [], [], []
    powers = np.arange(8)
    for piece in pieces:
        t = np.linspace(0.0, piece[0], _SAMPLES_PER_PIECE)[:, None]
        axes = piece[1:25].reshape(3, 8)
        basis = t**powers
        first = powers[1:] * t ** powers[:-1]
        second = powers[2:] * powers[1:-1] * t ** powers[:-2]
        places.append(basis @ axes.T)
        velocities.append(first @ axes[:, 1:].T)
        accelerations.append(np.linalg.norm(second @ axes[:, 2:].T, axis=1).max())
    return (
        np.concatenate(places),
        np.concatenate(velocities) / timescale,
        float(max(accelerations)) / timescale**2,
    )
