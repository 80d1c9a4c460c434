"""Lateness of the 30 Hz tick in the whole bench pipeline, beside two usual ways to keep a rate.

Our loop flies a virtual Crazyflie over cflib and UDP, sees it through zenoh, asks a sandboxed
contestant and has the watchdog on. At the same time two plain loops keep 30 Hz in processes of
their own: ``sleep(1/30 - elapsed)``, and one that remembers when it should have woken, as
``rospy.Rate`` does. All of them idle, and again with every CPU busy.

``late`` is tick k against t0 + k/30, in ms. Of ours, ``machine`` is how late the wake-up itself
was and ``ours`` the rest, up to the first line of Python; ticks that were skipped are ours unless
the processor we ran on is known to have stood still. ``standstill`` is how long after a tick no
processor at all was awake, which no program can make up for. The plain loops are alone in their
processes, so that theirs is the machine's. The naive loop drifts, which is most of its
lateness; ``period`` compares every tick with the one before it instead. Run
``python benchmarks/scheduler.py [--minutes 10] [--only idle|loaded]``.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import tempfile
import time
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from crazyarena.levels.schema import Level
from crazyarena.mocap.opening import SourceSpec
from crazyarena.runner.fly import Fly
from crazyarena.runner.judging.result import percentiles_ms
from crazyarena.runner.rig.flight_process.client import connected
from crazyarena.runner.rig.rig import Rig
from crazyarena.runner.rig.virtual_arena import VirtualArena
from crazyarena.safety.limits import Limits
from crazyarena.viewer_process import View

RATE = 30.0
WORK = 0.002  # s that the plain loops compute in every period

HOVER = """
import math
from competition_utils import Command

class Controller:
    def __init__(self, initial_obs, initial_info, use_firmware=False, verbose=False):
        self.x, self.y = initial_obs[0], initial_obs[2]

    def cmdFirmware(self, time, obs, reward=None, done=None, info=None):
        rise = min(time / 3.0, 1.0)
        height = 1.0 * rise * rise * (3.0 - 2.0 * rise)
        place = [self.x + 0.3 * rise * math.sin(0.5 * time), self.y, max(height, 0.05)]
        return Command.FULLSTATE, [place, [0] * 3, [0] * 3, 0.0, [0] * 3]
"""


def burn(seconds: float) -> None:
    end = time.perf_counter() + seconds
    while time.perf_counter() < end:
        pass


def naive(seconds: float, out: Connection) -> None:
    """``sleep(1/30 - elapsed)``."""
    ticks = [time.monotonic()]
    for _ in range(1, int(seconds * RATE)):
        begun = time.monotonic()
        burn(WORK)
        elapsed = time.monotonic() - begun
        time.sleep(max(0.0, 1.0 / RATE - elapsed))
        ticks.append(time.monotonic())
    out.send(ticks)


def remembering(seconds: float, out: Connection) -> None:
    """As rospy.Rate: sleeps to the next multiple, forgets the past when it is far behind."""
    last = time.monotonic()
    ticks = [last]
    period = 1.0 / RATE
    for _ in range(1, int(seconds * RATE)):
        burn(WORK)
        time.sleep(max(0.0, last + period - time.monotonic()))
        last += period
        if time.monotonic() - last > 2.0 * period:
            last = time.monotonic()
        ticks.append(time.monotonic())
    out.send(ticks)


def spin(stop: Any) -> None:
    while not stop.is_set():
        burn(0.05)


def plain(ticks: list[float]) -> dict[str, dict[str, float]]:
    """Percentiles of the lateness and of the error of the period, ms."""
    times = np.array(ticks)
    late = times - (times[0] + np.arange(len(times)) / RATE)
    return {
        "late": shown(percentiles_ms(late[1:])),
        "period": shown(percentiles_ms(np.diff(times) - 1.0 / RATE)),
    }


def shown(percentiles: dict[str, float]) -> dict[str, float]:
    return {k: round(v, 3) for k, v in percentiles.items() if k not in ("p90", "mean")}


def fly(seconds: float, folder: Path, view: View | None = None) -> dict[str, Any]:
    """Hover through the bench pipeline, shown in ``view``; the result of the episode."""
    submission = folder / "hover.py"
    submission.write_text(HOVER)
    arenas: list[VirtualArena] = []

    def open_rig(level: Level, limits: Limits) -> Rig:
        # A usual battery is empty before the time is up.
        arena = VirtualArena(level, level.seed, folder, battery=10.0)
        arenas.append(arena)
        rig = connected(
            level,
            arena.uri,
            SourceSpec("zenoh", {"connect": [arena.endpoint]}),
            limits=limits,
        )
        rig.closers.insert(0, arena.close)
        return rig

    overrides = [
        "track.gates=[]",
        "track.obstacles=[]",
        f"episode_length={seconds}",
        "goal.position=[2.5, 2.5, 1.5]",
        "start.position=[0, 0, 0.03]",
    ]
    Fly(
        submission,
        "sim2real",
        overrides,
        out=folder / "out",
        open_rig=open_rig,
        yes=True,
        figure=False,
        console=Console(quiet=True),
        view=view,
    ).run()
    document = json.loads((folder / "out" / "result.json").read_text())
    episode: dict[str, Any] = document["episodes"][0]
    episode["real_time"] = document["provenance"].get("real_time")
    episode["arena"] = arenas[0].report
    return episode


def measure(seconds: float, loaded: bool) -> dict[str, Any]:
    """All three loops at the same time."""
    context = multiprocessing.get_context("spawn")
    stop = context.Event()
    spinners = [
        context.Process(target=spin, args=(stop,), daemon=True)
        for _ in range((os.cpu_count() or 1) if loaded else 0)
    ]
    others = {}
    for spinner in spinners:
        spinner.start()
    for loop in (naive, remembering):
        ours, theirs = context.Pipe(duplex=False)
        process = context.Process(target=loop, args=(seconds, theirs), daemon=True)
        process.start()
        others[loop.__name__] = (process, ours)
    with tempfile.TemporaryDirectory(prefix="crazyarena-scheduler-") as folder:
        episode = fly(seconds, Path(folder))
    result: dict[str, Any] = {
        "loaded": loaded,
        "load_average": os.getloadavg()[0],
        "crazyarena": {
            "late": shown(episode["late_ms"]),
            "machine": shown(episode["late_machine_ms"]),
            "ours": shown(episode["late_own_ms"]),
            "standstill": shown(episode["standstill_ms"]),
        },
        "ticks": episode["steps"],
        "skipped": episode["skipped_steps"],
        "skipped_by_us": episode["skipped_own_steps"],
        "missed_by_contestant": episode["missed_ticks"],
        "answer_ms": episode["answer_ms"],
        "termination": episode["termination"],
        "error": episode["error"],
        "real_time": episode["real_time"],
        "arena": episode["arena"],
    }
    for name, (process, ours) in others.items():
        result[name] = plain(ours.recv())
        process.join()
    stop.set()
    for spinner in spinners:
        spinner.join()
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--only", choices=("idle", "loaded"))
    arguments = parser.parse_args()
    for name in ("idle", "loaded") if arguments.only is None else (arguments.only,):
        print(json.dumps(measure(60.0 * arguments.minutes, name == "loaded"), indent=2))


if __name__ == "__main__":
    main()
