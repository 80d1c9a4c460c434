"""Settings of the radio backend."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from crazyarena.crazyswarm_compat.radio.lanes import OutboxOptions
from crazyarena.errors import InputError


def default_cache() -> Path:
    """Folder for tables of contents, kept between sessions."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "crazyarena" / "toc"


@dataclass(frozen=True, slots=True)
class RadioOptions:
    """How vehicles are connected and what they tell; times in s, rates in Hz.

    cache: folder of the tables of contents, None to download them every time; connect_timeout:
    without progress, for all vehicles together; parameters: ``needed`` reads the values of a few
    parameters when connecting and the others when they are asked for, ``all`` reads all; in_flight:
    requests under way at once while connecting; link_timeout: silence after which a link counts as
    lost; reconnect: try again by itself, every reconnect_interval; gone_after: how long a vehicle
    in the air may be out of reach before its flight counts as over for a script; driver: of radio
    links, ``scheduled`` sends what is most urgent on a dongle, ``cflib`` gives its vehicles turns,
    as cflib's own driver does; packets_per_second: what one Crazyradio carries for all its vehicles
    under ``cflib`` (nothing else needs such a limit); state_rate, health_rate: of the onboard
    estimate and body rates, and of battery, supervisor and RSSI, 0 for none; plant_rate: of motors,
    accelerometer and voltage, 0 for none; certainty_rate: of how sure the onboard filter is, 0 for
    none; ping_rate: of the echoes that show loss and latency;
    poses: ``single`` sends full resolution, ``packed`` millimetres, ``auto`` broadcasts them packed
    where three vehicles or more share a channel; param_timeout, upload_timeout: for the vehicle's
    answer; outbox: limits of the traffic classes.
    """

    cache: Path | None = field(default_factory=default_cache)
    connect_timeout: float = 30.0
    parameters: Literal["needed", "all"] = "needed"
    in_flight: int = 6
    link_timeout: float = 1.0
    reconnect: bool = False
    gone_after: float = 4.0
    reconnect_interval: float = 2.0
    driver: Literal["scheduled", "cflib"] = "scheduled"
    packets_per_second: float = 500.0
    state_rate: float = 20.0
    health_rate: float = 10.0
    plant_rate: float = 0.0
    certainty_rate: float = 0.0
    ping_rate: float = 10.0
    poses: Literal["auto", "single", "packed"] = "auto"
    param_timeout: float = 2.0
    upload_timeout: float = 15.0
    outbox: OutboxOptions = field(default_factory=OutboxOptions)

    def __post_init__(self) -> None:
        for name in (
            "connect_timeout",
            "link_timeout",
            "reconnect_interval",
            "gone_after",
            "packets_per_second",
            "param_timeout",
            "upload_timeout",
            "ping_rate",
        ):
            value = getattr(self, name)
            if not value > 0:
                raise InputError(f"radio options: {name} is {value!r}; it must be > 0")
        if self.parameters not in ("needed", "all"):
            raise InputError(
                f"radio options: parameters is {self.parameters!r}; choose needed or all"
            )
        if not 1 <= self.in_flight <= 12:
            raise InputError(
                f"radio options: in_flight is {self.in_flight!r}; it must be 1 to 12 (a vehicle "
                "queues some sixteen requests)"
            )
        for name in ("state_rate", "health_rate", "plant_rate", "certainty_rate"):
            value = getattr(self, name)
            if value != 0 and not 0.4 <= value <= 100:
                raise InputError(
                    f"radio options: {name} is {value!r} Hz; log blocks run at 0.4..100 Hz, 0 is "
                    "none"
                )
        if self.driver not in ("scheduled", "cflib"):
            raise InputError(f"radio options: driver is {self.driver!r}; choose scheduled or cflib")
        if self.poses not in ("auto", "single", "packed"):
            raise InputError(
                f"radio options: poses is {self.poses!r}; choose auto, single or packed"
            )
        if math.isnan(self.outbox.stream_timeout) or self.outbox.stream_timeout <= 0:
            raise InputError("radio options: outbox.stream_timeout must be > 0 s")
