"""What a trial comes to: plain records that go into ``result.json`` as they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from crazyarena.runner.judging.referee import TASK_COMPLETION, Event

FINISHED = "FINISHED"
CONTROLLER_ERROR = "CONTROLLER ERROR"
CONTROLLER_TIMEOUT = "CONTROLLER TIMEOUT"
INTERRUPTED = "INTERRUPTED"
SAFETY = "SAFETY"
ABORTED = "ABORTED"

FORMAT = 1


@dataclass
class EpisodeResult:
    """Summary of one episode, with the competition's fields first. Times in s.

    flight_time is that of the last control step's start, as the competition counts it.
    collisions and violations count control steps; compute_ms are percentiles of the wall time
    of ``cmdFirmware``; late_ms of the start of control steps, of which late_machine_ms is what
    the machine caused by waking the loop late, and late_own_ms the rest, and standstill_ms
    how long after it no processor of the machine was awake (wall time only);
    skipped_own_steps: skipped steps that the machine is not known to have caused;
    answer_ms from question to answer.
    missed_ticks: control steps in which no command of the contestant was applied;
    late_commands: commands applied at a later tick than their own; phases: s by name.
    reveals: when which gate's exact pose was told. why: the termination with what the referee
    knows of it, in one line. doubt: what the recording does not bear out of the result.
    """

    index: int
    termination: str
    flight_time: float
    gates_passed: int
    gates: int
    completed: bool
    collisions: int
    violations: int
    reward: float
    interstep_learning_time: float
    interstep_learning_average: float
    interepisode_learning_time: float
    steps: int
    gate_times: list[float]
    compute_ms: dict[str, float]
    over_period: int
    late_ms: dict[str, float]
    skipped_steps: int
    skipped_own_steps: int = 0
    late_machine_ms: dict[str, float] = field(default_factory=dict)
    late_own_ms: dict[str, float] = field(default_factory=dict)
    standstill_ms: dict[str, float] = field(default_factory=dict)
    missed_ticks: int = 0
    late_commands: int = 0
    answer_ms: dict[str, float] = field(default_factory=dict)
    error: str | None = None
    events: Sequence[Event] = field(default_factory=list)
    files: dict[str, str] = field(default_factory=dict)
    phases: dict[str, float] = field(default_factory=dict)
    reveals: list[dict[str, Any]] = field(default_factory=list)
    why: str = ""
    doubt: str = ""

    @property
    def clean(self) -> bool:
        """Completed, never touched anything, never broke a constraint, and nobody doubts it."""
        return self.completed and self.collisions == 0 and self.violations == 0 and not self.doubt

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        data = asdict(self)
        data["clean"] = self.clean
        data["events"] = [
            {"event": e.name, "tick": e.tick, "time": e.time, "detail": e.detail}
            for e in self.events
        ]
        return data


@dataclass
class TrialResult:
    """All episodes of a trial.

    isolated: the contestant was behind walls. Otherwise it could read what the judge knows and
    write what the judge says: good for one's own work, not for comparing with others.
    cut_short: what ended it that was no part of the flight, such as a full disk.
    """

    episodes: list[EpisodeResult]
    requested: int
    isolated: bool = False
    cut_short: str | None = None

    @property
    def clean(self) -> bool:
        """Every requested episode was flown, and cleanly."""
        return len(self.episodes) == self.requested and all(e.clean for e in self.episodes)

    @property
    def error(self) -> str | None:
        """Traceback or message of the controller's failure, if it failed."""
        return next((e.error for e in self.episodes if e.error is not None), None)

    def score(self) -> dict[str, Any]:
        """The competition's two measures; None where the last episode does not qualify.

        A: flight time of the last episode. B: flight time of all episodes plus learning time, which
        is the judge's measure of a contestant that is isolated.
        """
        if not self.episodes:
            return {"qualified": False, "A_flight_time": None, "B_total_time": None}
        last = self.episodes[-1]
        qualified = last.clean and len(self.episodes) == self.requested
        total = sum(
            e.flight_time + e.interstep_learning_time + e.interepisode_learning_time
            for e in self.episodes
        )
        return {
            "qualified": qualified,
            "A_flight_time": last.flight_time if qualified else None,
            "B_total_time": total if qualified else None,
        }


def percentiles_ms(seconds: np.ndarray) -> dict[str, float]:
    """p50, p90, p99, p99.9, max and mean in ms; empty when there is nothing to tell."""
    if len(seconds) == 0:
        return {}
    p50, p90, p99, p999 = np.percentile(seconds, [50, 90, 99, 99.9]) * 1e3
    return {
        "p50": float(p50),
        "p90": float(p90),
        "p99": float(p99),
        "p99.9": float(p999),
        "max": float(seconds.max()) * 1e3,
        "mean": float(seconds.mean()) * 1e3,
    }


__all__ = [
    "ABORTED",
    "CONTROLLER_ERROR",
    "CONTROLLER_TIMEOUT",
    "FINISHED",
    "FORMAT",
    "INTERRUPTED",
    "SAFETY",
    "TASK_COMPLETION",
    "EpisodeResult",
    "TrialResult",
    "percentiles_ms",
]
