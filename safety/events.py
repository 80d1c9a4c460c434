"""What safety may do, in order, and the record of what it did."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum


class Action(IntEnum):
    """Reactions, each stronger than the one before; within a trial they only ever rise."""

    NONE = 0
    WARN = 1
    """Tell people; the contestant flies on."""
    HOLD = 2
    """Take over: brake, and stay at a place inside the fence."""
    LAND = 3
    """Return inside the fence if need be, and land there."""
    CUT = 4
    """Firmware emergency stop: motors off and locked until reboot."""

    @property
    def takes_over(self) -> bool:
        """Whether the contestant has lost the vehicle."""
        return self >= Action.HOLD


@dataclass(frozen=True, slots=True)
class SafetyEvent:
    """One step of a ladder, or one command changed or refused.

    Attributes
    ----------
    rule: name of the monitor, gate check or operator's input that asked for it.
    severity: what that rule asked for.
    measured, limit: in the unit of the rule (SI), NaN where there is no number.
    action: what the ladder was at after the event.
    time: s, on the session clock.
    vehicle: id, or None for all.
    detail: for people.
    """

    rule: str
    severity: Action
    measured: float
    limit: float
    action: Action
    time: float
    vehicle: int | None = None
    detail: str = ""

    @property
    def cause(self) -> str:
        """Rule, numbers and detail, for people."""
        numbers = f" ({self.measured:.3g}, limit {self.limit:.3g})"
        text = self.rule + ("" if math.isnan(self.measured) else numbers)
        return f"{text} {self.detail}".rstrip()
