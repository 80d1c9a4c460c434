"""How fast a swarm flies with firmware and native physics in one process, and in how much memory.

Run: python benchmarks/swarm_speed.py [--seconds 10] [--threads 2]. Every row is a process of its
own: vehicles in a grid take off and keep moving on small circles, while a perfect camera system
feeds every estimator at 100 Hz. Figures are multiples of real time, best of three, from one
machine; "of one core" divides by processor time instead, which other programs disturb less.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import resource
import subprocess
import sys
import time

import numpy as np

from crazyarena.crazyswarm_compat import commands as c
from crazyarena.sim_backend.arena import ArenaFleet

SPACING = 0.5  # m
FRAME = 10  # ticks of 1 ms between camera frames
REPEATS = 3
CASES = (
    # vehicles, spacing m, downwash, streamed, asked for
    (1, SPACING, False, False, ""),
    (10, SPACING, False, False, ""),
    (50, SPACING, False, False, "> 10"),
    (50, SPACING, False, True, ""),
    (50, SPACING, True, False, ""),
    (50, 0.25, False, False, ""),
    (100, SPACING, False, False, ""),
)


def waypoint(vehicle: int, at: np.ndarray, now: float) -> c.GoTo:
    """The next of eight points around ``at``, 3 cm away; each vehicle at its own phase."""
    angle = math.pi / 4 * (round(now) + vehicle)
    offset = 0.03 * np.array([math.cos(angle), math.sin(angle), 0.0])
    return c.GoTo(at + offset, 0.0, 1.0)


def circle(vehicle: int, at: np.ndarray, now: float) -> c.FullState:
    """A setpoint on a circle of 3 cm, once around in 2 s."""
    rate, radius = math.pi, 0.03
    angle = rate * now + vehicle
    arc = radius * np.array([math.cos(angle), math.sin(angle), 0.0])
    side = np.array([-arc[1], arc[0], 0.0])
    return c.FullState(at + arc, rate * side, -rate * rate * arc, 0.0, [0.0, 0.0, 0.0])


def fly(fleet: ArenaFleet, homes: np.ndarray, seconds: float, streamed: bool) -> None:
    """Waypoints once a second, or full-state setpoints at 20 Hz."""
    period, command = (5, circle) if streamed else (100, waypoint)
    for frame in range(round(seconds * 1000 / FRAME)):
        if frame % period == 0:
            for i in range(len(fleet)):
                fleet.send(command(i, homes[i], fleet.time), i)
        fleet.external_truth()
        fleet.advance(FRAME)


def measure(
    vehicles: int, spacing: float, downwash: bool, streamed: bool, seconds: float, threads: int
) -> dict[str, float]:
    """Multiples of real time by the wall clock and of one core's time, peak memory in MB."""
    side = math.ceil(math.sqrt(vehicles))
    grid = np.array([[spacing * (i % side), spacing * (i // side), 0.0] for i in range(vehicles)])
    fleet = ArenaFleet(grid, threads=threads, downwash=downwash)
    for i in range(vehicles):
        fleet.set_param(i, "stabilizer.controller", 2)
        fleet.set_param(i, "ctrlMel.mass", 0.0319)
    for _ in range(50):
        fleet.external_truth()
        fleet.advance(FRAME)
    for i in range(vehicles):
        fleet.send(c.Takeoff(1.0, 1.5), i)
    for _ in range(200):
        fleet.external_truth()
        fleet.advance(FRAME)
    homes = grid + [0.0, 0.0, 1.0]
    wall = cpu = math.inf
    for _ in range(REPEATS):
        begin, spent = time.perf_counter(), time.process_time()
        fly(fleet, homes, seconds, streamed)
        wall = min(wall, time.perf_counter() - begin)
        cpu = min(cpu, time.process_time() - spent)
    error = np.abs(fleet.bodies[:, :3] - homes).max()
    fleet.close()
    if error > 0.1 or fleet.contacts:
        raise RuntimeError(f"a vehicle is {error:.2f} m off its place: this is no flight")
    return {
        "wall": seconds / wall,
        "core": seconds / cpu,
        "memory": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=10.0, help="flown per repeat")
    parser.add_argument("--threads", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--case", type=int, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.case is not None:
        vehicles, spacing, downwash, streamed, _ = CASES[arguments.case]
        threads = max(1, min(arguments.threads, vehicles // 8))
        found = measure(vehicles, spacing, downwash, streamed, arguments.seconds, threads)
        print(json.dumps(found))
        return
    print("| swarm | x real time | x real time of one core | asked | peak memory, MB | asked |")
    print("|---|---|---|---|---|---|")
    passed = ["--seconds", str(arguments.seconds), "--threads", str(arguments.threads)]
    # The first run ever compiles, which takes memory of its own.
    subprocess.run(
        [sys.executable, __file__, "--case", "0", "--seconds", "0.1"],
        check=True,
        stdout=subprocess.DEVNULL,
    )
    for number, (vehicles, spacing, downwash, streamed, asked) in enumerate(CASES):
        done = subprocess.run(
            [sys.executable, __file__, "--case", str(number), *passed],
            check=True,
            stdout=subprocess.PIPE,
        )
        result = json.loads(done.stdout)
        name = f"{vehicles} at {spacing} m" if vehicles > 1 else "1"
        name += ", downwash" * downwash + ", each sent 20 setpoints/s" * streamed
        print(
            f"| {name} | {result['wall']:.0f} | {result['core']:.0f} | {asked} "
            f"| {result['memory']:.0f} | {'< 500' if asked else ''} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
