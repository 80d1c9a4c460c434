"""Does anything get out? Random hostile flights under a guard, in simulation.

Every call of both Crazyswarm APIs with hostile arguments, parameters, uploads and timings, in a
box, a room with a notch and one with zones for people, with the Mellinger and the PID
controller, under both policies of the command gate.

    python benchmarks/gate_fuzz.py --flights 2000

Reports the worst excursion, the worst distance into zones for people, the seeds of the worst ten,
and the fewest calls of a flight that got out. Exit code 1 if one did.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

from crazyarena.runner.campaign.gate_fuzz import Outcome, draw_script, fly, shrink

_ALLOWED = 0.10  # m


def _flight(seed: int) -> Outcome:
    return fly(draw_script(seed))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--flights", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0, help="of the first flight")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--shrink", type=int, default=1, help="at most so many bad flights")
    parser.add_argument("--out", type=Path, help="a line of JSON for every flight")
    parser.add_argument("--figure", type=Path, help="draw the flights of --out files, fly nothing")
    parser.add_argument("files", type=Path, nargs="*", help="of --out, for --figure")
    args = parser.parse_args()
    if args.figure is not None:
        _draw([json.loads(line) for file in args.files for line in file.open()], args.figure)
        return 0
    seeds = range(args.seed, args.seed + args.flights)
    begun = time.monotonic()
    outcomes = []
    with contextlib.ExitStack() as stack:
        flown = map(_flight, seeds)
        if args.workers > 1:
            pool = stack.enter_context(ProcessPoolExecutor(args.workers))
            flown = pool.map(_flight, seeds)
        file = None if args.out is None else stack.enter_context(args.out.open("w"))
        for outcome in flown:
            outcomes.append(outcome)
            if file is not None:
                file.write(json.dumps(_row(outcome)) + "\n")
                file.flush()
    took = time.monotonic() - begun
    _table(outcomes, took)
    bad = [outcome for outcome in outcomes if outcome.is_bad(_ALLOWED)]
    for outcome in sorted(bad, key=lambda o: -o.badness)[: args.shrink]:
        small = shrink(outcome.script, lambda o: o.is_bad(_ALLOWED))
        print(f"\nseed {outcome.script.seed}, with the fewest calls:")
        for call in small.calls:
            print(f"    {call}")
    return 1 if bad else 0


def _row(outcome: Outcome) -> dict[str, object]:
    script = outcome.script
    return {
        "seed": script.seed,
        "arena": script.arena,
        "policy": script.policy,
        "controller": script.controller,
        "excursion": outcome.excursion,
        "into_people": outcome.into_people,
        "into_margin": outcome.into_margin,
        "ended": outcome.ended,
        "passed": outcome.passed,
        "refused": outcome.refused,
    }


def _table(outcomes: list[Outcome], took: float) -> None:
    print(f"{len(outcomes)} flights in {took:.0f} s")
    groups: dict[tuple[str, str, str], list[Outcome]] = {}
    for o in outcomes:
        name = "Mellinger" if o.script.controller == 2 else "PID"
        groups.setdefault((o.script.arena, name, o.script.policy), []).append(o)
    print(
        f"{'arena':8}{'controller':12}{'policy':8}{'flights':>8}{'worst':>9}{'people':>9}{'taken':>7}"
    )
    for key, group in sorted(groups.items()):
        worst = max(o.excursion for o in group)
        people = max(o.into_people for o in group)
        taken = sum(bool(o.ended) for o in group)
        print(f"{key[0]:8}{key[1]:12}{key[2]:8}{len(group):8}{worst:+9.3f}{people:+9.3f}{taken:7}")
    print(f"worst excursion {max(o.excursion for o in outcomes):+.3f} m beyond the hard fence")
    print(f"worst way into a zone for people {max(o.into_people for o in outcomes):+.3f} m")
    print(f"into their margins: {sum(o.into_margin > 0.0 for o in outcomes)} flights")
    calls = Counter(o.passed > 0 for o in outcomes)
    assert calls[True], "no call passed anywhere"
    print("the worst ten:")
    for o in sorted(outcomes, key=lambda o: -o.badness)[:10]:
        s = o.script
        print(
            f"    seed {s.seed}: {o.excursion:+.3f} m, people {o.into_people:+.3f} m, {s.arena}, "
            f"controller {s.controller}, {s.policy}{s.options}: {o.ended[:90] or 'not taken'}"
        )


def _draw(rows: list[dict[str, Any]], file: Path) -> None:
    """How far out flights came, sorted, by arena and policy; and a table of the worst."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 4), layout="constrained")
    axis = figure.add_subplot()
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault((row["arena"], row["policy"]), []).append(row)
    print("| arena | policy | flights | worst beyond the fence, m | nearest to a people zone, m |")
    print("|---|---|---|---|---|")
    for (arena, policy), group in sorted(groups.items()):
        values = sorted((float(row["excursion"]) for row in group), reverse=True)
        shares = [100.0 * (k + 1) / len(values) for k in range(len(values))]
        style = "-" if policy == "clamp" else "--"
        axis.plot(values, shares, style, lw=1.2, label=f"{arena}, {policy} ({len(group)})")
        people = max(float(row["into_people"]) for row in group)
        near = f"{-people:.2f}" if math.isfinite(people) else ""
        print(f"| {arena} | {policy} | {len(group)} | {values[0]:+.3f} | {near} |")
    axis.axvline(0.0, color="black", lw=0.8)
    axis.axvline(_ALLOWED, color="tab:red", lw=0.8)
    axis.set(xlim=(-0.6, 0.15), yscale="log", xlabel="furthest beyond the hard fence [m]")
    axis.set_ylabel("share of flights [%]")
    axis.legend(fontsize=8)
    axis.grid(alpha=0.3)
    figure.savefig(file, dpi=110)


if __name__ == "__main__":
    raise SystemExit(main())
