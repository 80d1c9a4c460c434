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
from contextlib import suppress
from enum import StrEnum

import numpy as np

from crazyarena.clock import Clock
from crazyarena.crazyswarm_compat import commands as c
from crazyarena.crazyswarm_compat.backend import Backend
from crazyarena.crazyswarm_compat.checks import check, verb
from crazyarena.errors import BackendError, CommandError
from crazyarena.safety.admission.fitters import FITTERS
from crazyarena.safety.admission.memory import FLYING, GROUP_MASK, Refused, VehicleMemory
from crazyarena.safety.admission.room import Room
from crazyarena.safety.events import Action, SafetyEvent
from crazyarena.safety.fence import Fence
from crazyarena.safety.limits import Limits
from crazyarena.safety.observation import Point
from crazyarena.safety.old_poses import repeats
from crazyarena.safety.planner import Flown
from crazyarena.types import Pose, Telemetry, VehicleState

_STOPPING = (c.Emergency, c.CutMotors, c.Stop)
_TELEMETRY_GOOD = 0.3  # s, up to which the vehicle's own estimate is carried on

_KEPT = "kept until a plan follows it"
_FROZEN = 20  # poses that repeat, after which they are called frozen

Listener = Callable[[c.Command, c.Command | None, str, int | None], None]


class Policy(StrEnum):
    """What happens to a setpoint outside of what is allowed."""

    CLAMP = "clamp"
    REFUSE = "refuse"


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
        self._clock = clock
        self.limits = limits or Limits()
        self._policy = policy
        self.low: Callable[[int], bool] = lambda vehicle: False
        """Whether a vehicle is so low that its motors may stop."""
        self._room = Room(
            fence,
            self.limits,
            state or (lambda vehicle: None),
            backend.get_param,
            lambda vehicle: self.low(vehicle),
        )
        self._on_command = on_command
        self._on_event = on_event
        self._lock = threading.Lock()
        self._vehicles = {vehicle: VehicleMemory(vehicle) for vehicle in backend.vehicles}
        self._closed_reason: str | None = None
        self.passed = self.changed = self.refused = self.poses_dropped = 0
        self.grounded: Callable[[], str | None] | None = None
        """Why nothing may take off now, in words, or None; asked at every take-off."""
        self.nudged: Callable[[int, Pose], Pose] = lambda vehicle, pose: pose
        """What a vehicle is told in place of a pose (safety/nudge.py)."""
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
        (an old pose in a new frame; in flight also with a jitter of micrometres), and, in
        flight, what is further from the vehicle's own estimate than it can have gone.
        """
        good = {}
        for vehicle, pose in poses.items():
            if self._believable(vehicle, pose):
                good[vehicle] = self.nudged(vehicle, pose)
            else:
                self.poses_dropped += 1
        if good:
            self._backend.send_external_poses(good)

    def _believable(self, vehicle: int, pose: Pose) -> bool:
        memory = self._vehicles.get(vehicle)
        if memory is None:
            return False
        if not np.isfinite(pose.position).all() or np.isinf(pose.quaternion).any():
            return False
        last = memory.forwarded
        if last is not None and repeats(last, pose, memory.flying_since is not None):
            memory.repeated += 1
            return False
        memory.repeated = 0
        memory.forwarded = pose
        own = self._backend.telemetry(vehicle).state
        if memory.flying_since is None or own is None:
            return True
        age = self._clock.now() - own.timestamp
        if not 0.0 <= age <= _TELEMETRY_GOOD:
            return True
        expected = own.position + age * own.velocity
        gone = float(np.linalg.norm(pose.position - expected))
        return gone <= self.limits.disagreement + 0.5 * self.limits.setpoint_acceleration * age**2

    def frozen(self) -> list[int]:
        """Vehicles whose last poses were the same again and again."""
        return [vehicle for vehicle, m in self._vehicles.items() if m.repeated >= _FROZEN]

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

    def renew(self) -> None:
        """Begin anew, with vehicles that were switched off and on: nothing is remembered."""
        with self._lock:
            self._closed_reason = None
            self._vehicles = {vehicle: VehicleMemory(vehicle) for vehicle in self.vehicles}

    def take(self, vehicle: int) -> None:
        """The watchdog has this vehicle; the runner's commands to it are refused, and nothing on
        board moves the setpoints of the watchdog: a box that ends above the ground keeps a vehicle
        from landing, and throws it about when it is sent below."""
        memory = self._vehicles[vehicle]
        memory.taken = True
        if memory.avoiding:
            self._backend.send(c.CollisionAvoidance(False), vehicle)

    def flying_since(self, vehicle: int) -> float | None:
        """When the runner first sent something that makes the vehicle fly, s; None before, and
        once it stands again after a landing."""
        return self._vehicles[vehicle].flying_since

    def stands(self, vehicle: int) -> None:
        """The vehicle has been seen standing for a while; if it was told to land, that was it."""
        memory = self._vehicles[vehicle]
        if memory.ending:
            memory.flying_since = None

    def reference(self, vehicle: int, now: float) -> tuple[Point | None, Point]:
        """Where a streamed full state wants the vehicle to be now, m, and how fast, m/s."""
        memory = self._vehicles[vehicle]
        if memory.setpoint is None or not (memory.streaming and memory.is_reference):
            return None, (0.0, 0.0, 0.0)
        age = min(max(now - memory.setpoint_time, 0.0), 0.1)
        (x, y, z), (vx, vy, vz) = memory.setpoint, memory.velocity
        return (x + vx * age, y + vy * age, z + vz * age), memory.velocity

    def streamed(self, vehicle: int) -> Point | None:
        """Place, m, of the setpoint that is streamed now; None if it has none, or none is."""
        memory = self._vehicles[vehicle]
        return memory.setpoint if memory.streaming else None

    def pushed(self, vehicle: int) -> Point | None:
        """Acceleration, m/s2, that the attitude asks for which is streamed now; None if none is."""
        memory = self._vehicles[vehicle]
        return memory.pushed if memory.streaming else None

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
                words = {t: self._word_before(sent[t][0], t) for t in targets}
                for target, (one, _) in sent.items():
                    self._vehicles[target].sent(one, self._clock.now())
                kept = {t for t in targets if self._vehicles[t].over is sent[t][0]}
        except CommandError as error:
            self.refused += 1
            self._tell(command, None, str(error), vehicle)
            self._report("gate_refused", vehicle, str(error))
            raise
        for target, word in words.items():
            if word is not None:
                self._backend.send(word, target)
        if vehicle is None and not kept and all(one is command for one, _ in sent.values()):
            self._backend.send(command, None)
        else:
            for target, (one, _) in sent.items():
                if target not in kept:
                    self._backend.send(one, target)
        self.passed += 1
        for target in kept:
            self._tell(command, None, _KEPT, target)
        for target, (one, reason) in sent.items():
            if target in kept:
                continue
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
        if isinstance(command, FLYING) and self.grounded is not None:
            standing = [t for t in targets if self._vehicles[t].flying_since is None]
            reason = self.grounded() if standing else None
            if reason is not None:
                raise Refused(f"cf{standing[0]}: {verb(command)}: {reason}")
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
        memory.then = None
        if memory.flying_since is None and isinstance(command, FLYING):
            where = self._room.where(vehicle)
            memory.stood = None if where is None else where[2]
        group: int = getattr(command, "group_mask", 0)
        if memory.group_mask is None and group != 0:
            with suppress(BackendError):
                memory.group_mask = int(self._room.parameter(vehicle, GROUP_MASK))
        fitter = FITTERS.get(type(command))
        fitted, reasons = command, list[str]()
        if fitter is not None:
            fitted, reasons = fitter(self._room, command, memory, now)
        if reasons and self._policy is Policy.REFUSE:
            raise Refused(f"cf{vehicle}: {verb(command)}: {'; '.join(reasons)}")
        return fitted, "; ".join(reasons)

    def _word_before(self, command: c.Command, vehicle: int) -> c.NotifySetpointsStop | None:
        """What ends the stream of a vehicle that would not fly this plan, but keep its last
        setpoint; None if nothing needs to."""
        memory = self._vehicles[vehicle]
        if memory.planner.flown is not Flown.STREAM:
            return None
        # A take-off is for those that stand, or were told that their stream is over.
        flown = isinstance(command, c.Land | c.GoTo | c.StartTrajectory) or (
            isinstance(command, c.Takeoff) and memory.over is not None
        )
        group = int(getattr(command, "group_mask", 0))
        if flown and memory.addressed(group):
            return memory.over or c.NotifySetpointsStop()
        return None

    def _note_stop(self, command: c.Command, vehicle: int | None) -> None:
        for target in self._vehicles if vehicle is None else [vehicle]:
            memory = self._vehicles.get(target)
            group = command.group_mask if isinstance(command, c.Stop) else 0
            if memory is not None and memory.addressed(group):
                memory.stopped()

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


__all__ = ["CommandGate", "GatePort", "Policy", "Refused"]
