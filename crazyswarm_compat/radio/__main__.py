"""``python -m crazyarena.crazyswarm_compat.radio URI ...``: is this link good enough to fly?"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence

from crazyarena.clock import WallClock
from crazyarena.crazyswarm_compat.config import FleetConfig, VehicleConfig
from crazyarena.crazyswarm_compat.radio.backend import RadioBackend
from crazyarena.crazyswarm_compat.radio.options import RadioOptions
from crazyarena.crazyswarm_compat.radio.quality import LinkStatistics
from crazyarena.errors import CrazyarenaError
from crazyarena.types import Telemetry

# Worse than this flies badly: the levels at which Crazyswarm2 warns.
_LATENCY = 0.010
_LOSS = 0.1
_BATTERY = 3.8


def _number(value: float | None, layout: str) -> str:
    return "?" if value is None else format(value, layout)


def describe(uri: str, protocol: int, t: Telemetry, s: LinkStatistics) -> tuple[str, list[str]]:
    """One line on a link, and what is wrong with it."""
    loss = s.round_trip_loss
    milliseconds = [
        "?" if value is None else f"{1e3 * value:.1f}" for value in (s.latency_p50, s.latency_p95)
    ]
    line = (
        f"{uri}: protocol {protocol}, battery {_number(t.battery, '.2f')} V, "
        f"RSSI {_number(t.rssi, '.0f')} dBm, link quality {_number(t.link_quality, '.0%')}, "
        f"round trip {milliseconds[0]} ms (95 %: {milliseconds[1]} ms), "
        f"lost echoes {_number(loss, '.0%')}, lost log packets {_number(s.downlink_loss, '.0%')}"
    )
    complaints = []
    if t.battery is not None and t.battery < _BATTERY:
        complaints.append(f"battery below {_BATTERY} V: charge it")
    if s.latency_p50 is not None and s.latency_p50 > _LATENCY:
        complaints.append("slow: fewer vehicles per radio, or another channel")
    if (loss is not None and loss > _LOSS) or (s.downlink_loss or 0.0) > _LOSS:
        complaints.append("lossy: another channel, move the radio closer and off the floor")
    return line, complaints


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; 0 if every link is good, 1 if one is not, 2 for wrong input."""
    parser = argparse.ArgumentParser(
        prog="python -m crazyarena.crazyswarm_compat.radio",
        description="Connect to vehicles and measure their links. Nothing moves.",
    )
    parser.add_argument("uri", nargs="+", help="e.g. radio://0/80/2M/E7E7E7E701")
    parser.add_argument("--seconds", type=float, default=5.0, help="how long to measure")
    given = parser.parse_args(arguments)
    vehicles = tuple(
        VehicleConfig(number, f"vehicle {number}", (0.0, 0.0, 0.0), uri=uri)
        for number, uri in enumerate(given.uri, 1)
    )
    clock = WallClock()
    try:
        if not (math.isfinite(given.seconds) and given.seconds > 0):
            raise CrazyarenaError(f"--seconds: found {given.seconds}; need a time above 0")
        backend = RadioBackend(FleetConfig(vehicles, "command line"), clock, RadioOptions())
    except CrazyarenaError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    try:
        clock.sleep_until(clock.now() + given.seconds)
        good = True
        for vehicle in vehicles:
            line, complaints = describe(
                str(vehicle.uri),
                backend.protocol(vehicle.id),
                backend.telemetry(vehicle.id),
                backend.statistics(vehicle.id),
            )
            print(line)
            for complaint in complaints:
                print(f"  {complaint}")
            good = good and not complaints
    finally:
        backend.close()
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
