"""The ladder: findings in, one action out, upwards only."""

from __future__ import annotations

import math
from collections.abc import Iterable

from crazyarena.safety.events import Action, SafetyEvent
from crazyarena.safety.limits import Limits
from crazyarena.safety.monitors import Finding

_CLEAR_TIME = 1.0  # s without a warning's cause until it is worth telling again


class Ladder:
    """Pure function of (time, findings, landed) and its own past.

    The action never falls within a trial. HOLD becomes LAND after ``limits.hold_time``; LAND
    ends by ``landed``, or after ``limits.land_time`` in CUT. Equal inputs give equal events.
    """

    def __init__(self, limits: Limits, vehicle: int | None = None) -> None:
        self._limits = limits
        self._vehicle = vehicle
        self.action = Action.NONE
        self.since = -math.inf
        self.landed = False
        self._warned: dict[str, float] = {}
        self._told: set[tuple[str, Action]] = set()

    @property
    def over(self) -> bool:
        """Nothing is left to be done: landed, or motors cut."""
        return self.landed or self.action is Action.CUT

    def update(
        self, time: float, findings: Iterable[Finding], landed: bool = False
    ) -> list[SafetyEvent]:
        """Take what was found at ``time`` (s); returns what is worth recording.

        ``landed``: the vehicle stands on the ground with its motors off, after a takeover.
        """
        events: list[SafetyEvent] = []
        for finding in findings:
            self._take(time, finding, events)
        if landed and self.action.takes_over and not self.landed:
            self.landed = True
            events.append(self._event(Finding("landed", Action.NONE, math.nan, math.nan), time))
        held = time - self.since
        if self.landed:
            return events
        if self.action is Action.HOLD and held >= self._limits.hold_time:
            over = Finding("hold_over", Action.LAND, held, self._limits.hold_time)
            self._climb(time, over, events)
        elif self.action is Action.LAND and held >= self._limits.land_time:
            over = Finding("landing_over", Action.CUT, held, self._limits.land_time)
            self._climb(time, over, events)
        return events

    def _take(self, time: float, finding: Finding, events: list[SafetyEvent]) -> None:
        if finding.action > self.action:
            self._climb(time, finding, events)
            return
        if finding.action is Action.WARN:
            last = self._warned.get(finding.rule, -math.inf)
            self._warned[finding.rule] = time
            if time - last < _CLEAR_TIME:
                return
        elif (finding.rule, finding.action) in self._told:
            return
        self._told.add((finding.rule, finding.action))
        events.append(self._event(finding, time))

    def _climb(self, time: float, finding: Finding, events: list[SafetyEvent]) -> None:
        self.action = finding.action
        self.since = time
        self._warned[finding.rule] = time
        self._told.add((finding.rule, finding.action))
        events.append(self._event(finding, time))

    def _event(self, finding: Finding, time: float) -> SafetyEvent:
        return SafetyEvent(
            finding.rule,
            finding.action,
            finding.measured,
            finding.limit,
            self.action,
            time,
            self._vehicle,
            finding.detail,
        )
