"""Rigid bodies whose nose is not the vehicle's: when are they found, and how far has it got?

    python benchmarks/heading_campaign.py --seeds 10

Every angle is flown straight up for a metre, in 1.5 to 3 s, and through a circuit. Exit code 1 if
45 degrees and more are not cut within 0.3 m of height (0.45 m in the fastest climb) and of way,
20 degrees are not told within 3 s of motion, or 10 degrees and less are told or cut.
"""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Iterable

import numpy as np

from crazyarena.runner.campaign.turned import TurnedFlight, fly_turned

_ANGLES = (0, 10, -10, 20, -20, 45, -45, 90, -90, 135, 180)
_CLIMBS = (None, 1.5, 2.0, 3.0)  # s; None is the circuit
_CUT, _WARN = 45, 20  # deg
_REACH, _SOON = 0.3, 3.0  # m, s
_HURRIED, _HURRIED_REACH = 1.5, 0.45  # s for a metre, m: what climbs fast is higher when it is seen


def _told(flight: TurnedFlight) -> float | None:
    found = re.search(r"turned by (\S+) deg", flight.told)
    return None if found is None else float(found.group(1))


def _is_good(degrees: int, flight: TurnedFlight, climb: float | None) -> bool:
    if abs(degrees) >= _CUT:
        reach = _HURRIED_REACH if climb == _HURRIED else _REACH
        return flight.height <= reach and flight.way <= _REACH and math.isfinite(flight.cut)
    if abs(degrees) >= _WARN:
        return min(flight.warned, flight.cut) <= _SOON
    return not flight.taken and not flight.told


def _range(values: Iterable[float]) -> str:
    known = [v for v in values if math.isfinite(v)]
    return f"{max(known):.2f}" if known else "-"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0, help="of the first flight")
    parser.add_argument("--angles", type=int, nargs="*", default=_ANGLES, help="deg")
    args = parser.parse_args()
    bad = 0
    print("angle  flight      flights  cut  told  s to tell  s to cut  height m  way m  error deg")
    for degrees in args.angles:
        for climb in _CLIMBS:
            flights = [
                fly_turned(math.radians(degrees), args.seed + k, climb=climb)
                for k in range(args.seeds)
            ]
            bad += sum(not _is_good(degrees, flight, climb) for flight in flights)
            cut = [flight for flight in flights if math.isfinite(flight.cut)]
            told = [a for a in map(_told, flights) if a is not None]
            errors = [abs(math.remainder(a - degrees, 360.0)) for a in told]
            kind = "circuit" if climb is None else f"up in {climb:.1f}"
            warned = sum(math.isfinite(f.warned) or math.isfinite(f.cut) for f in flights)
            typical = f"{np.sqrt(np.mean(np.square(errors))):.1f} rms" if errors else "-"
            print(
                f"{degrees:+5d}  {kind:10}  {len(flights):7d}  {len(cut):3d}  {warned:4d}  "
                f"{_range(min(f.warned, f.cut) for f in flights):>9}  "
                f"{_range(f.cut for f in cut):>8}  {_range(f.height for f in cut):>8}  "
                f"{_range(f.way for f in cut):>5}  {_range(errors):>5}, {typical}",
                flush=True,
            )
    print(f"{bad} flights were not as they should be")
    return int(bad > 0)


if __name__ == "__main__":
    raise SystemExit(main())
