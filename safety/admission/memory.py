"""What the command gate remembers of each vehicle, and how it says no."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

from crazyarena.crazyswarm_compat import commands as c
from crazyarena.crazyswarm_compat.checks import verb
from crazyarena.errors import CommandError
from crazyarena.safety.admission.trajectory_memory import TrajectoryMemory
from crazyarena.safety.observation import Point, as_point
from crazyarena.safety.planner import Flown, Plan, Planner
from crazyarena.types import Pose


class Refused(CommandError):
    """The command gate did not let a command pass."""


@dataclass(slots=True)
class VehicleMemory:
    """What the gate remembers of one vehicle.

    Attributes
    ----------
    streaming: the vehicle depends on the next streamed setpoint, or on a plan instead of it.
    over: the runner's word that its stream is over, kept until a plan follows it: a vehicle that
        is released and has nothing to follow stops its motors.
    stood: m, height at which it was before it began to fly; None if nobody knew.
    avoiding: collision avoidance on board is on.
    group_mask: of the vehicle; None until the runner has set it.
    boot: parameters as they were before the runner's first write.
    pushed: acceleration, m/s2, that the last setpoint asks for, where that is an attitude.
    heading: of the last setpoint with one, rad, and when it was, s.
    then: what becomes true once the command that was looked at last is sent.
    """

    vehicle: int
    taken: bool = False
    flying_since: float | None = None
    ending: bool = False
    forwarded: Pose | None = None
    repeated: int = 0
    setpoint: Point | None = None  # last streamed position
    velocity: Point = (0.0, 0.0, 0.0)
    setpoint_time: float = -math.inf
    streaming: bool = False
    over: c.NotifySetpointsStop | None = None
    stood: float | None = None
    is_reference: bool = False
    tokens: float = 0.0
    tokens_time: float = -math.inf
    avoiding: bool = False
    group_mask: int | None = None
    boot: dict[str, float] = field(default_factory=dict)
    trajectories: TrajectoryMemory = field(default_factory=TrajectoryMemory)
    planner: Planner = field(default_factory=Planner)
    pushed: Point | None = None
    heading: tuple[float, float] = (0.0, -math.inf)
    then: Callable[[], None] | None = None

    def refusal(self, command: c.Command, reason: str) -> Refused:
        """The error that says why ``command`` does not pass."""
        return Refused(f"cf{self.vehicle}: {verb(command)}: {reason}")

    def addressed(self, group: int) -> bool:
        """Whether a command for this group is for the vehicle; so it is if nobody knows."""
        return group == 0 or self.group_mask is None or bool(int(group) & self.group_mask)

    def follows(
        self,
        plan: Plan | None,
        now: float,
        group: int,
        landing: bool = False,
        slots: range = range(0),
    ) -> None:
        """A plan was sent; None if nobody knows where it begins."""
        if self.addressed(group):
            self.streaming, self.over = False, None
            self.planner.follow(plan, now, landing, slots)

    def takes_off(self, plan: Plan, now: float, group: int) -> None:
        """A take-off was sent; only an idle planner makes anything of it."""
        if self.planner.flown is Flown.NOTHING or self.over is not None:
            self.follows(plan, now, group)

    def sent(self, command: c.Command, now: float) -> None:
        """Note a command that has passed, as it was sent."""
        if isinstance(command, FLYING):
            self.ending = False
            if self.flying_since is None:
                self.flying_since = now
        elif isinstance(command, c.Land):
            self.ending = True
        elif isinstance(command, c.CollisionAvoidance):
            self.avoiding = command.enable
        elif isinstance(command, c.SetGroupMask):
            self.group_mask = int(command.group_mask)
        elif isinstance(command, c.SetParam) and is_group_mask(command.name):
            self.group_mask = int(command.value)
        if isinstance(command, c.STREAMED):
            self._streamed(command, now)
        if self.then is not None:
            self.then()

    def _streamed(self, command: c.Command, now: float) -> None:
        self.streaming, self.over = True, None
        self.setpoint_time = now
        self.planner.stream()
        self.is_reference = isinstance(command, c.FullState)
        self.setpoint = self.pushed = None
        self.velocity = (0.0, 0.0, 0.0)
        if isinstance(command, c.FullState | c.Position):
            self.setpoint = as_point(command.position)
            self.heading = float(command.yaw), now
        if isinstance(command, c.FullState):
            self.velocity = as_point(command.velocity)

    def releases(self, word: c.NotifySetpointsStop) -> None:
        """The runner says that its stream is over: kept in the air."""
        self.over = word

    def stopped(self) -> None:
        """Note that motors were told to stop, or do so because nothing is left to follow."""
        self.streaming, self.over = False, None
        self.ending = True
        self.setpoint = self.pushed = None
        self.planner.stop()


def is_group_mask(name: str) -> bool:
    """Whether this parameter is the vehicle's group mask."""
    return name.replace("/", ".") == GROUP_MASK


GROUP_MASK = "hlCommander.groupmask"
FLYING = (*c.STREAMED, c.Takeoff, c.GoTo, c.StartTrajectory)
