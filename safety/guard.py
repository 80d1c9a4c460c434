"""Monitors, ladder and pilot of one vehicle, as one pure function of its observations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from crazyarena.crazyswarm_compat.commands import Command
from crazyarena.safety.events import Action, SafetyEvent
from crazyarena.safety.fence import Fence
from crazyarena.safety.ladder import Ladder
from crazyarena.safety.limits import Limits
from crazyarena.safety.monitors import RULES, Finding, Monitor
from crazyarena.safety.observation import Observation
from crazyarena.safety.pilot import SafePilot


class Guard:
    """Watches one vehicle through one trial.

    Parameters
    ----------
    ground: m, height of the vehicle's centre when it stands.
    flies: False only observes: events are made, commands are not (dry monitoring).
    """

    def __init__(
        self,
        fence: Fence,
        limits: Limits | None = None,
        vehicle: int | None = None,
        ground: float = 0.03,
        flies: bool = True,
    ) -> None:
        self.limits = limits or Limits()
        self.ladder = Ladder(self.limits, vehicle)
        self.pilot = SafePilot(fence, self.limits, ground)
        self._monitors = tuple(Monitor(rule, fence, self.limits) for rule in RULES)
        self._flies = flies

    @property
    def action(self) -> Action:
        """Where the ladder stands."""
        return self.ladder.action

    def update(
        self, obs: Observation, requests: Sequence[Finding] = ()
    ) -> tuple[list[Command], list[SafetyEvent]]:
        """Commands to send now, strongest wish first, and events to record.

        ``requests`` are what people and other parts ask for, e.g. an emergency stop.
        """
        overriding = self.ladder.action.takes_over
        if overriding and self._flies:
            # From the takeover on the vehicle should be where the pilot wants it.
            obs = replace(obs, setpoint=self.pilot.reference)
        self.pilot.see(obs)
        findings = list(requests)
        for monitor in self._monitors:
            finding = monitor.update(obs, overriding)
            if finding is not None:
                findings.append(finding)
        events = self.ladder.update(obs.time, findings, self.pilot.landed)
        if not self._flies or not self.ladder.action.takes_over:
            return [], events
        commands = self.pilot.update(self.ladder.action, obs)
        if self.pilot.landed:
            events += self.ladder.update(obs.time, (), True)
        return commands, events
