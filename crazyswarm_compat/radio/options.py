"""Settings of the radio backend."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from crazyarena.crazyswarm_compat.radio.outbox import OutboxOptions
from crazyarena.errors import InputError


def default_cache() -> Path:
    """Folder for tables of contents, kept between sessions."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "crazyarena" / "toc"


@dataclass(frozen=True, slots=True)
class RadioOptions:
    """How vehicles are connected and what they tell; times in s, rates in Hz.

    cache: folder of the tables of contents, None to download them every time; connect_timeout:
    for all vehicles together; link_timeout: silence after which a link counts as lost;
    reconnect: try again by itself, every reconnect_interval; packets_per_second: what one
    Crazyradio carries for all its vehicles (USB and UDP links have no such limit);
    state_rate, health_rate: of the onboard estimate, and of battery, supervisor, RSSI and body
    rates, 0 for none; plant_rate: of motors, accelerometer and voltage, 0 for none; ping_rate: of the echoes that show loss and latency; poses: ``single``
    sends full resolution, ``packed`` millimetres, two vehicles in a packet; param_timeout,
    upload_timeout: for the vehicle's answer; outbox: limits of the traffic classes.
    """

    cache: Path | None = field(default_factory=default_cache)
    connect_timeout: float = 30.0
    link_timeout: float = 1.0
    reconnect: bool = False
    reconnect_interval: float = 2.0
    packets_per_second: float = 500.0
    state_rate: float = 20.0
    health_rate: float = 10.0
    plant_rate: float = 0.0
    ping_rate: float = 10.0
    poses: Literal["single", "packed"] = "single"
    param_timeout: float = 2.0
    upload_timeout: float = 15.0
    outbox: OutboxOptions = field(default_factory=OutboxOptions)

    def __post_init__(self) -> None:
        for name in (
            "connect_timeout",
            "link_timeout",
            "reconnect_interval",
            "packets_per_second",
            "param_timeout",
            "upload_timeout",
            "ping_rate",
        ):
            value = getattr(self, name)
            if not value > 0:
                raise InputError(f"radio options: {name} is {value!r}; it must be > 0")
        for name in ("state_rate", "health_rate", "plant_rate"):
            value = getattr(self, name)
            if value != 0 and not 0.4 <= value <= 100:
                raise InputError(
                    f"radio options: {name} is {value!r} Hz; log blocks run at 0.4..100 Hz, 0 is "
                    "none"
                )
        if self.poses not in ("single", "packed"):
            raise InputError(f"radio options: poses is {self.poses!r}; choose single or packed")
        if math.isnan(self.outbox.stream_timeout) or self.outbox.stream_timeout <= 0:
            raise InputError("radio options: outbox.stream_timeout must be > 0 s")
