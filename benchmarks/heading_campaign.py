"""Rigid bodies whose nose is not the vehicle's: when are they found, and how far has it got?

    python benchmarks/heading_campaign.py

Every angle is tipped by hand under ``crazyarena preflight --tip`` (over UDP), flown in simulation
(straight up for a metre in 1.5 to 3 s, and through circuits, with the guard; straight up and aside
without), and flown over UDP by ``examples/crazyswarm/hover.py`` as it is, with the guard and
without. One command, some ten minutes; ``--part`` does a part of it. Prints tables for
docs/safety.md.

Exit code 1 if preflight is more than 5 degrees off; if 45 degrees and more are not cut within
0.3 m of height and of way; if 20 degrees are not told within 3 s of motion; or if 10 degrees and
less are told or cut.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import re
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from crazyarena.runner.campaign.turned import (  # noqa: E402
    TurnedFlight,
    fly_turned,
    fly_unguarded,
    turn,
)

_ANGLES = (0, 10, -10, 20, -20, 45, -45, 90, -90, 135, 180)
_CLIMBS = (1.5, 2.0, 3.0)  # s
_CUT, _WARN = 45, 20  # deg
_REACH, _SOON, _NAMED = 0.3, 3.0, 5.0  # m, s, deg
_MOVED = 0.02  # m: motion begins
_NOSE = re.compile(r"turned by (\S+) deg against the vehicle \(to within (\S+) deg\)")


@dataclass(slots=True)
class Row:
    """Of one angle and one kind of flight."""

    degrees: int
    kind: str
    flights: list[TurnedFlight]

    @property
    def bad(self) -> int:
        return sum(not _is_good(self.degrees, flight) for flight in self.flights)

    def __str__(self) -> str:
        cut = [flight for flight in self.flights if math.isfinite(flight.cut)]
        heard = [min(f.warned, f.cut) for f in self.flights]
        told = [found for found in (_NOSE.search(f.told) for f in self.flights) if found]
        off = [(abs(math.remainder(float(t[1]) - self.degrees, 360.0)), float(t[2])) for t in told]
        rms = f"{np.sqrt(np.mean([a * a for a, _ in off])):.0f}" if off else ""
        within = f"{sum(a <= b for a, b in off)} of {len(off)}" if off else ""
        cells = [
            f"{self.degrees:+d}", self.kind, len(self.flights), len(cut),
            sum(map(math.isfinite, heard)), _most(heard), _most(f.height for f in cut),
            _most(f.way for f in cut), rms, _most((a for a, _ in off), 0), within,
        ]  # fmt: skip
        return "| " + " | ".join(map(str, cells)) + " |"


_HEAD = (
    "| deg | flight | flights | cut | cut or told | after at most, s | height m | way m "
    "| angle off, rms deg | most | within what was said |\n|" + "---|" * 11
)


def _is_good(degrees: int, flight: TurnedFlight) -> bool:
    if abs(degrees) >= _CUT:
        return flight.height <= _REACH and flight.way <= _REACH and math.isfinite(flight.cut)
    if abs(degrees) >= _WARN:
        return min(flight.warned, flight.cut) <= _SOON
    return not flight.taken and not flight.told


def _most(values: Iterable[float], digits: int = 2) -> str:
    known = [v for v in values if math.isfinite(v)]
    return f"{max(known):.{digits}f}" if known else ""


# In simulation


def simulate(angles: Iterable[int], seeds: range) -> list[Row]:
    """Flights in virtual time."""
    kinds: list[tuple[str, Callable[[float, int], TurnedFlight]]] = [
        ("guarded, circuit", fly_turned),
        *((f"guarded, {s:g} s", lambda a, k, s=s: fly_turned(a, k, climb=s)) for s in _CLIMBS),
        *((f"unguarded, {s:g} s", lambda a, k, s=s: fly_unguarded(a, k, climb=s)) for s in _CLIMBS),
    ]
    print(f"\nIn simulation:\n\n{_HEAD}", flush=True)
    rows = []
    for degrees in angles:
        for kind, fly in kinds:
            flights = [fly(math.radians(degrees), seed) for seed in seeds]
            rows.append(Row(degrees, f"simulation, {kind}", flights))
            print(rows[-1], flush=True)
    return rows


# Over UDP


class Arena:
    """One virtual vehicle over UDP, seen by noisy cameras that take its nose for elsewhere."""

    def __init__(self, angle: float, seed: int) -> None:
        from crazyarena.sim_backend.crtp.host import Options, build

        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
        self._host = build(
            Options(port=0, mocap_endpoint=self.endpoint, camera_noise=True, seed=seed)
        )
        swarm = self._host.server.swarm
        truth = swarm.truth
        swarm.truth = lambda: {name: turn(pose, angle) for name, pose in truth().items()}  # type: ignore[method-assign]
        self.uri = self._host.server.uris[0]
        self._fleet = swarm.fleet
        self._over = threading.Event()
        # Host time, height and way, while the motors turn.
        self.track: list[tuple[float, float, float]] = []
        self._look = threading.Thread(target=self._watch)

    def _watch(self) -> None:
        while not self._over.wait(0.002):
            x, y, z = self._fleet.true_pose(0).position
            if self._fleet.rows(0).motors.any():
                self.track.append((time.monotonic(), float(z), math.hypot(x, y)))

    def __enter__(self) -> Arena:
        self._host.server.start()
        self._look.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._over.set()
        self._look.join()
        self._host.close()


def hover(degrees: int, seed: int, guard: str | None) -> TurnedFlight:
    """``examples/crazyswarm/hover.py`` over UDP; cut is when the motors were off."""
    with tempfile.TemporaryDirectory() as name, Arena(math.radians(degrees), seed) as arena:
        script = shutil.copy(ROOT / "examples/crazyswarm/hover.py", name)
        listed = Path(name, "crazyflies.yaml")
        listed.write_text("crazyflies:\n- {id: 1, channel: 100, initialPosition: [0, 0, 0]}\n")
        flags = ["--backend", "radio", "--uri", arena.uri, "--mocap", f"zenoh:{arena.endpoint}"]
        program = subprocess.Popen(
            [sys.executable, script, *flags, *(("--guard", guard) if guard else ())],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert program.stderr is not None
        lines = [(time.monotonic(), line) for line in program.stderr]
        code = program.wait()
        track = np.array(arena.track).reshape(-1, 3)
    moved = np.flatnonzero(np.hypot(track[:, 1], track[:, 2]) > _MOVED)
    if not moved.size:
        raise SystemExit(f"{degrees} deg: never flew, exit code {code}\n{lines}")
    begun, (ended, height, way) = track[moved[0], 0], track[-1]
    about = [(at, line) for at, line in lines if _NOSE.search(line)]
    cut = code != 0 and any("motors" in line or "body_turned_far" in line for _, line in lines)
    return TurnedFlight(
        about[0][0] - begun if about else math.inf,
        about[-1][1] if about else "",
        ended - begun if cut else math.inf,
        float(height) if cut else math.nan,
        float(way) if cut else math.nan,
        math.nan,
        () if code == 0 else (f"exit code {code}", *(line for _, line in lines)),
    )


def udp(angles: Iterable[int], seeds: range) -> list[Row]:
    """Flights in real time."""
    print(f"\nhover.py over UDP:\n\n{_HEAD}", flush=True)
    rows = []
    for degrees in angles:
        for kind, guard in (("guarded", "level0"), ("unguarded", None)):
            flights = [hover(degrees, seed, guard) for seed in seeds]
            rows.append(Row(degrees, f"UDP, {kind}", flights))
            print(rows[-1], flush=True)
            for flight in flights:
                if not _is_good(degrees, flight):
                    print(flight, file=sys.stderr)
    return rows


def summary(rows: list[Row]) -> None:
    """Of both signs and all kinds of flights together."""
    print(f"\nIn short:\n\n{_HEAD}")
    groups: dict[tuple[int, str], list[TurnedFlight]] = {}
    for row in rows:
        where = ",".join(row.kind.split(",")[:2])
        # Angles are told relative to that of the body, so that signs may be mixed.
        groups.setdefault((abs(row.degrees), where), []).extend(
            replace(flight, told=_mirrored(flight.told) if row.degrees < 0 else flight.told)
            for flight in row.flights
        )
    for (degrees, where), flights in sorted(groups.items()):
        print(Row(degrees, where, flights))


def _mirrored(told: str) -> str:
    return _NOSE.sub(lambda m: m[0].replace(m[1], f"{-float(m[1]):+.0f}", 1), told)


def tip(angles: Iterable[int], seeds: range) -> int:
    """``crazyarena preflight --tip``, with somebody's hand; how often it was too far off."""
    from tests.runner.stage import Stage

    print(
        "\ncrazyarena preflight --tip:\n\n| deg | named, deg | heading |\n|---|---|---|", flush=True
    )
    bad = 0
    for degrees in angles:
        named: list[float] = []
        states = set()
        for seed in seeds:
            with tempfile.TemporaryDirectory() as name:
                noses = {"cf1": math.radians(degrees)}
                with Stage(places=[(-0.9, -2.9)], noses=noses, seed=seed) as stage:
                    found, ok = _tipped(stage, Path(name))
            named.append(found)
            states.add("green" if ok else "red")
        off = [abs(math.remainder(found - degrees, 360.0)) for found in named]
        bad += sum(one > _NAMED for one in off)
        told = ", ".join(f"{found:+.0f}" for found in named)
        print(f"| {degrees:+d} | {told} | {', '.join(sorted(states))} |", flush=True)
    return bad


def _tipped(stage: object, folder: Path) -> tuple[float, bool]:
    """What preflight says of the nose, deg, and whether that is green."""
    report = folder / "preflight.json"
    program = subprocess.Popen(
        [sys.executable, "-m", "crazyarena", "preflight", "--mocap", "zenoh",
         "--mocap-host", stage.endpoint, "--report", str(report),
         "--uri", f"cf1={stage.uris[0]}", "--tip", "--wait", "2"],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL, text=True,
        env={**os.environ, "CRAZYARENA_RUNTIME_DIR": str(folder)},
    )  # fmt: skip
    assert program.stdout is not None
    said = []
    for line in program.stdout:
        said.append(line)
        if "Tip cf1 by hand" in line:
            stage.tip(0, 0.5)
        elif "was tipped, its nose" in line:
            stage.put_down()
    program.wait()
    if not report.exists():
        raise SystemExit("".join(said))
    lines = {line["name"]: line for line in json.loads(report.read_text())["lines"]}
    found = re.search(r"nose is (\S+) deg", lines["cf1 heading"]["found"])
    if found is None:
        raise SystemExit("".join(said))
    return float(found[1]), bool(lines["cf1 heading"]["ok"])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--part", choices=("tip", "simulation", "udp"), help="default: all")
    parser.add_argument("--seeds", type=int, default=10, help="flights of a kind in simulation")
    parser.add_argument("--real", type=int, default=1, help="the same in real time")
    parser.add_argument("--seed", type=int, default=0, help="of the first flight")
    parser.add_argument("--angles", type=int, nargs="*", default=_ANGLES, help="deg")
    args = parser.parse_args()
    seeds = range(args.seed, args.seed + args.seeds)
    real = range(args.seed, args.seed + args.real)
    bad, rows = 0, list[Row]()
    if args.part in (None, "tip"):
        bad += tip(args.angles, real)
    if args.part in (None, "simulation"):
        rows += simulate(args.angles, seeds)
    if args.part in (None, "udp"):
        rows += udp(args.angles, real)
    if rows:
        summary(rows)
    bad += sum(row.bad for row in rows)
    print(f"\n{bad} were not as they should be")
    return int(bad > 0)


if __name__ == "__main__":
    raise SystemExit(main())
