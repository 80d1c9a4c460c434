"""Does anything get out by attitude? Hostile roll, pitch, yaw and thrust under a guard, simulated.

Every flight takes off by attitude and then has one bad idea after the other, from the floor on or
in the air: full tilt and thrust towards walls, corners and the ceiling, swings at every frequency,
falls that are caught late, noise, spins.

    python benchmarks/attitude_fuzz.py --flights 500

Reports the worst excursion and the seeds of the worst ten. Exit code 1 if one got out by more than
0.10 m or did not end.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter

from crazyarena.runner.campaign.outcome import Outcome
from crazyarena.runner.campaign.run import fly

_ALLOWED = 0.10  # m


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--flights", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0, help="of the first flight")
    args = parser.parse_args()
    begun = time.monotonic()
    outcomes: list[Outcome] = []
    for seed in range(args.seed, args.seed + args.flights):
        outcomes.append(fly("attitude_hostile", seed))
        if len(outcomes) % 50 == 0:
            worst = max(o.excursion for o in outcomes)
            print(f"{len(outcomes)} flights, worst {worst:+.3f} m", flush=True)
    bad = [o for o in outcomes if o.excursion > _ALLOWED or not o.safe]
    print(f"{len(outcomes)} flights in {time.monotonic() - begun:.0f} s")
    print("ended:", dict(Counter(o.end for o in outcomes)))
    print("taken by:", dict(Counter(o.rule or "nobody" for o in outcomes)))
    for o in sorted(outcomes, key=lambda o: -o.excursion)[:10]:
        print(f"seed {o.seed}: {o.excursion:+.3f} m beyond the fence, {o.end}, {o.rule}")
    print(f"{len(bad)} got out by more than {_ALLOWED:.2f} m, or did not end")
    return 1 if bad else 0


if __name__ == "__main__":
    raise SystemExit(main())
