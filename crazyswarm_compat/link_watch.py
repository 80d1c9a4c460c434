"""Warnings of links and poses that are worse than ``server.yaml`` of Crazyswarm2 lets pass."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from crazyarena.clock import Clock
from crazyarena.crazyswarm_compat.options import warn
from crazyarena.crazyswarm_compat.server_files import LinkLimits

_LEAST_PACKETS = 20  # of which a share says something
_AGAIN = 10.0  # s, until the same trouble of a vehicle is worth repeating


class LinkWatch:
    """Looks at every vehicle once a period; :meth:`check` is called while a script sleeps.

    Parameters
    ----------
    backend: with ``statistics(id)`` and ``telemetry(id)``.
    names: of vehicles by id.
    poses: statistics of what is forwarded to each vehicle by its id; None if nothing is.
    """

    def __init__(
        self, limits: LinkLimits, backend: Any, names: Mapping[int, str], clock: Clock, poses: Any
    ) -> None:
        self._limits = limits
        self._backend = backend
        self._names = dict(names)
        self._clock = clock
        self._poses = poses
        self._next = clock.now() + limits.period
        self._told: dict[tuple[int, str], float] = {}
        self._uplink = dict.fromkeys(names, (0, 0))
        self._posed: dict[int, tuple[float, int]] = {}

    def check(self) -> None:
        """Warn of what is beyond the limits now."""
        now = self._clock.now()
        if now < self._next:
            return
        self._next = now + self._limits.period
        sent = {} if self._poses is None else self._poses()
        for vehicle, name in self._names.items():
            for kind, text in self._troubles(vehicle, sent.get(vehicle)):
                if now - self._told.get((vehicle, kind), -math.inf) >= _AGAIN:
                    self._told[vehicle, kind] = now
                    warn(f"{name}: {text}", stacklevel=5)

    def _troubles(self, vehicle: int, poses: Any) -> list[tuple[str, str]]:
        limits = self._limits
        statistics = self._backend.statistics(vehicle)
        found = []
        latency = statistics.latency_p50
        if limits.latency is not None and latency is not None and latency > limits.latency:
            text = f"round trip of {1e3 * latency:.0f} ms (server.yaml: {1e3 * limits.latency:g})"
            found.append(("latency", text))
        quality = self._backend.telemetry(vehicle).link_quality
        if limits.ack_rate is not None and quality is not None and quality < limits.ack_rate:
            text = f"{100 * quality:.0f} % of the packets acknowledged (server.yaml: "
            found.append(("acknowledged", f"{text}{100 * limits.ack_rate:g})"))
        arrived, least = self._arrived(vehicle, statistics), limits.receive_rate
        if least is not None and arrived is not None and arrived < least:
            text = f"{100 * arrived:.0f} % of the packets arrive (server.yaml: {100 * least:g})"
            found.append(("arrived", text))
        rate = None if poses is None else self._rate(vehicle, poses.sent)
        if limits.pose_rate is not None and rate is not None:
            low, high = limits.pose_rate
            if not low <= rate <= high:
                text = f"{rate:.0f} poses a second (server.yaml: {low:g} to {high:g})"
                found.append(("poses", text))
        return found

    def _rate(self, vehicle: int, sent: int) -> float | None:
        """Poses a second since the last look; None at the first."""
        now = self._clock.now()
        time, before = self._posed.get(vehicle, (math.nan, 0))
        self._posed[vehicle] = now, sent
        return None if math.isnan(time) else (sent - before) / (now - time)

    def _arrived(self, vehicle: int, statistics: Any) -> float | None:
        """Share of the packets since the last look that arrived; None while it says nothing."""
        sent, arrived = statistics.uplink_sent, statistics.uplink_arrived
        sent_before, arrived_before = self._uplink[vehicle]
        if sent - sent_before < _LEAST_PACKETS:
            return None
        self._uplink[vehicle] = sent, arrived
        return (arrived - arrived_before) / (sent - sent_before)
