"""What the command gate remembers of each vehicle, and how it says no."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from crazyarena.crazyswarm_compat.checks import verb
from crazyarena.crazyswarm_compat.commands import Command
from crazyarena.errors import CommandError
from crazyarena.safety.observation import Point
from crazyarena.types import Pose


class Refused(CommandError):
    """The command gate did not let a command pass."""


@dataclass(slots=True)
class VehicleMemory:
    """What the gate remembers of one vehicle."""

    vehicle: int
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
    boot: dict[str, float] = field(default_factory=dict)  # parameters before the runner's writes
    trajectories: dict[int, np.ndarray] = field(default_factory=dict)

    def refusal(self, command: Command, reason: str) -> Refused:
        """The error that says why ``command`` does not pass."""
        return Refused(f"cf{self.vehicle}: {verb(command)}: {reason}")
