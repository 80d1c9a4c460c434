"""What became of the flights of a fault campaign."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

from crazyarena.runner.campaign.faults import ALL_FAULTS
from crazyarena.safety.events import SafetyEvent


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


def summarise(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """One row per fault: counts, worst excursion (m) and time to safe state (s)."""
    rows = []
    for name in dict.fromkeys(outcome.fault for outcome in outcomes):
        mine = [outcome for outcome in outcomes if outcome.fault == name]
        times = sorted(outcome.safe_after for outcome in mine)
        rows.append(
            {
                "fault": name,
                "kind": ALL_FAULTS[name].kind,
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
        if not outcome.safe or outcome.excursion > _allowed(outcome.fault, margin, allowed)
    ]


def _allowed(fault: str, margin: float, allowed: float) -> float:
    kind = ALL_FAULTS[fault]
    return (margin if kind.physical else allowed) + kind.beyond
