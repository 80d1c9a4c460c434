"""What happened in a flight, as a picture or a report marks it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from crazyarena.plain_text import shown_line

# Of the course of a flight; everything else is of its safety, or went wrong.
_COURSE = frozenset(
    (
        "gate passed",
        "gate told",
        "goal reached",
        "goal left",
        "task completed",
        "time limit",
        "contact ended",
        "constraint satisfied again",
        "phase",
        "gate seen again",
        "gate name corrected",
        "gate seen",
        "obstacle seen",
        "gates passed",
        "collision",  # the contact is told
    )
)
_VIOLATIONS = frozenset(("constraint violated", "out of bounds", "safety limits", "floor"))
_LATE = frozenset(("deadline missed", "late command"))
_BRIEF = 0.05  # s; a rotor beyond its limits for less, as at every start, breaks no rule
_GROUPED = 0.5  # s; the same thing again within this time is one mark


@dataclass(slots=True)
class Mark:
    """Something worth marking, at ``time`` s; ``count`` times until ``until`` s.

    kind: ``contact``, ``violation``, ``late`` or ``safety``.
    """

    time: float
    until: float
    kind: str
    name: str
    count: int = 1

    @property
    def text(self) -> str:
        """In one short line."""
        times = f" (×{self.count})" if self.count > 1 else ""
        return f"{self.name}{times}"


def marks(events: Iterable[Any]) -> list[Mark]:
    """Marks of events (with ``name``, ``time`` and ``detail``, or dictionaries), by time."""
    found: list[Mark] = []
    told_of = [_parts(event) for event in events]
    for name, time, detail in told_of:
        if name in _COURSE:
            continue
        if name == "constraint violated" and detail.startswith("rotor"):
            ends = [t for n, t, _ in told_of if n == "constraint satisfied again" and t >= time]
            if ends and min(ends) - time < _BRIEF:
                continue
        kind = _kind(name)
        told = name if kind == "late" or not detail else f"{name}: {detail}"
        told = shown_line(told, 60)
        before = next((mark for mark in reversed(found) if mark.name == told), None)
        if before is not None and time - before.until <= _GROUPED:
            before.until, before.count = time, before.count + 1
        else:
            found.append(Mark(time, time, kind, told))
    return sorted(found, key=lambda mark: mark.time)


def _parts(event: Any) -> tuple[str, float, str]:
    if isinstance(event, dict):
        return str(event["event"]), float(event["time"]), str(event.get("detail", ""))
    return event.name, event.time, event.detail


def _kind(name: str) -> str:
    if name == "contact":
        return "contact"
    if name in _VIOLATIONS:
        return "violation"
    return "late" if name in _LATE else "safety"
