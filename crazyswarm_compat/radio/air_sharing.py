"""A fleet's dongles: whose poses are broadcast, and who tells when the air runs out."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any

from crazyarena.crazyswarm_compat.config import FleetConfig
from crazyarena.crazyswarm_compat.radio.air_queue import Share
from crazyarena.crazyswarm_compat.radio.air_watch import AirWatch
from crazyarena.crazyswarm_compat.radio.events import AirShort, EventLog
from crazyarena.crazyswarm_compat.radio.link import VehicleLink
from crazyarena.crazyswarm_compat.radio.options import RadioOptions
from crazyarena.crazyswarm_compat.radio.outbox import Lane
from crazyarena.crazyswarm_compat.radio.pose_cast import Channel, Member, PoseCast
from crazyarena.crazyswarm_compat.radio.radio_driver import (
    ScheduledRadioDriver,
    dongle,
    tuning_of,
)
from crazyarena.types import Pose


class AirSharing:
    """What the vehicles of each dongle have in common; nothing for links of other kinds.

    Parameters
    ----------
    fleet, links: the vehicles, by id.
    """

    def __init__(
        self, fleet: FleetConfig, options: RadioOptions, links: Mapping[int, VehicleLink]
    ) -> None:
        self._links = links
        self._by_dongle: dict[int, list[VehicleLink]] = {}
        channels: dict[tuple[int, int, int], Channel] = {}
        if options.driver == "scheduled":
            for config in fleet.vehicles:
                uri = str(config.uri)
                if not uri.startswith("radio://"):
                    continue
                number, tuning = _tuning(uri)
                if tuning is None:
                    continue
                self._by_dongle.setdefault(number, []).append(links[config.id])
                key = (number, tuning.channel, tuning.rate)
                if key not in channels:
                    channels[key] = Channel(dongle(number), tuning.channel, tuning.rate)
                channels[key].members.append(Member(config.id, tuning.address[-1]))
        chosen = list(channels.values()) if options.poses != "single" else []
        self._cast = PoseCast(chosen, options.outbox.extpose_rate)
        self._watches = {
            number: AirWatch(dongle(number).statistics, functools.partial(_replaced, group))
            for number, group in self._by_dongle.items()
        }

    def broadcast(self, poses: Mapping[int, Pose], now: float) -> set[int]:
        """Send poses to everybody where that spares air; returns the vehicles that were served."""
        served = self._cast.send(poses, now)
        for vehicle in served:
            counters = self._links[vehicle].outbox.counters[Lane.EXTPOSE]
            counters.offered += 1
            counters.sent += 1
        return served

    def look(self, now: float, events: EventLog) -> None:
        """Let log data give way where a dongle is full, and tell of it."""
        for number, watch in self._watches.items():
            for verdict in watch.look(now):
                for link in self._by_dongle[number]:
                    events.emit(
                        AirShort(now, link.id, verdict.what, verdict.divisor, verdict.fallen)
                    )
            for link in self._by_dongle[number]:
                if link.connected:
                    link.telemetry.slow_down(watch.divisor)


def _tuning(uri: str) -> tuple[int, Any]:
    try:
        return tuning_of(uri)
    except Exception:
        return -1, None  # the connection itself will say what is wrong with it


def _replaced(group: list[VehicleLink]) -> int:
    total = 0
    for link in group:
        driver = None if link.client is None else link.client.link
        if isinstance(driver, ScheduledRadioDriver):
            total += driver.replaced(Share.POSE)
    return total
