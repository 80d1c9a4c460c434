"""The radio of a campaign flight in virtual time."""

from __future__ import annotations

import math
import random
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from crazyarena.clock import VirtualClock
from crazyarena.crazyswarm_compat import commands as c
from crazyarena.runner.campaign.setting import VEHICLE
from crazyarena.sim_backend.arena import ArenaFleet
from crazyarena.types import Pose, Telemetry

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
