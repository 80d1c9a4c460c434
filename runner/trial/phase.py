"""The phases of a trial by name, and what they hand to each other."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from crazyarena.errors import CrazyarenaError
from crazyarena.safety.estop import Hold

Array = NDArray[np.float64]


class Phase(StrEnum):
    """Phases of a trial, in order; COMPLETE or FAIL end the run."""

    CONNECT = "connect"
    PREFLIGHT = "pre-flight"
    SURVEY = "survey"
    ARM = "arm"
    COUNTDOWN = "countdown"
    RUN = "run"
    COMPLETE = "complete"
    FAIL = "fail"
    RETURN = "return-and-land"
    DISARM = "disarm"
    REPORT = "report"


class Aborted(CrazyarenaError):
    """A phase failed; ``phase`` says which. The vehicle is down, or was told to go down."""

    def __init__(self, phase: Phase, reason: str) -> None:
        super().__init__(f"{phase.value}: {reason}")
        self.phase = phase


@dataclass(frozen=True, slots=True)
class Timeouts:
    """Longest duration of each phase, s on the trial's clock."""

    connect: float = 20.0
    preflight: float = 30.0
    survey: float = 15.0
    grip: float = 30.0
    arm: float = 5.0
    countdown: float = 3.0
    land: float = 30.0
    disarm: float = 5.0


@dataclass(frozen=True, slots=True)
class MeasuredTrack:
    """gates (n, 7) and obstacles (m, 6) as the referee takes them, and where that is from."""

    gates: Array
    obstacles: Array
    source: str


@dataclass(frozen=True, slots=True)
class Grip:
    """What the operator has to hold from arming until the vehicle is down.

    ``what`` in words; ``limit`` s: the longest silence that still counts as holding.
    """

    hold: Hold
    what: str
    limit: float

    @property
    def held(self) -> bool:
        return self.hold.age() <= self.limit


Confirm = Callable[[str], bool]
OnPhase = Callable[[Phase, str], None]
