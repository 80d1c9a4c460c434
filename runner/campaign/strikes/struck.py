"""What a fault sees of the flight it befalls, wherever that is flown."""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Protocol

import numpy as np

from crazyarena.clock import Clock
from crazyarena.crazyswarm_compat import commands as c
from crazyarena.safety.fence import Fence
from crazyarena.sim_backend.arena import ArenaFleet
from crazyarena.types import PoseFrame


class Eyes(Protocol):
    """Cameras that can be made to err: ``spoil`` changes or swallows a frame, ``delay`` s."""

    spoil: Callable[[PoseFrame], PoseFrame | None] | None
    delay: float


class Radio(Protocol):
    """A link that can be made to lose: ``loss`` probability a packet; ``cut`` everything."""

    loss: float
    cut: bool


class Struck(Protocol):
    """A flight that a fault changes.

    Attributes
    ----------
    rng: what the fault draws from; seed: of the whole flight.
    onset: s on the clock, when the fault sets in.
    body, other: names in the camera system of the vehicle and of something else.
    each: called with the time since the onset (s), again and again.
    contestant: replaces the contestant's own flight; called with the time (s).
    silence_is_an_answer: a contestant that asks for nothing counts as alive.
    stall: s that the control loop does nothing; gust: (3,) N.
    """

    rng: random.Random
    seed: int
    onset: float
    body: str
    other: str
    fence: Fence
    each: Callable[[float], None] | None
    contestant: Callable[[float], c.Command | None] | None
    silence_is_an_answer: bool
    stall: float
    gust: np.ndarray
    ground_station_alive: bool

    @property
    def cameras(self) -> Eyes: ...

    @property
    def link(self) -> Radio: ...

    @property
    def fleet(self) -> ArenaFleet: ...

    @property
    def clock(self) -> Clock: ...

    @property
    def setpoint(self) -> c.FullState:
        """What the contestant's own flight wants now."""
        ...

    def position(self) -> np.ndarray:
        """(3,) m, where the vehicle is."""
        ...
