"""A tournament on this machine: how close to its processors, in what memory, and who harms whom.

    python benchmarks/tournament.py [--seeds N] [--levels LEVEL,...] [--workers N] [--out DIR]

Twelve submissions, half of them honest and half hostile, on every level and draw. Measured against
the same episodes flown one at a time with nothing beside them (each with a sandbox of its own), and
against the times of the blocks themselves; honest teams must fly what they fly alone, to the bit.
The exit code says whether all of that holds.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import tempfile
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import psutil
from rich.console import Console

from crazyarena.runner.dry_run import example_racer
from crazyarena.runner.tournament.archive import unpack
from crazyarena.runner.tournament.engine import Engine
from crazyarena.runner.tournament.flight import fly
from crazyarena.runner.tournament.plan import SUBMISSIONS
from crazyarena.runner.tournament.run import Tournament, open_tournament

MOST = 1.5  # times the single episodes' sum over the processors
HEAD = """
import ctypes, os, sys, time as clock
import numpy as np
from competition_utils import Command

class Controller:
    def __init__(self, initial_obs, initial_info, use_firmware=False, verbose=False):
        {init}

    def cmdFirmware(self, time, obs, reward=None, done=None, info=None):
        if time > {after}:
            {harm}
        return (Command.TAKEOFF, [1.0, 1.0]) if time == 0.0 else (Command.NONE, [])
"""
HOSTILE = {
    "raises": "raise RuntimeError('told you')",
    "exits": "os._exit(3)",
    "crashes": "ctypes.string_at(0)",
    "hangs": "while True: pass",
    "writes garbage": "os.write(int(sys.argv[1]), b'garbage')",
    "fills the disk": "[open(f'{k}', 'wb').write(b'x' * (10 << 20)) for k in range(500)]",
}
SPEEDS = {"racer": None, "cautious": 0.8, "careful": 0.9, "keen": 1.05}


def make_submissions(folder: Path) -> set[str]:
    """Write twelve submissions; returns the names of the honest ones."""
    racer = example_racer()
    for name, factor in SPEEDS.items():
        shutil.copytree(racer, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
        if factor is not None:
            file = folder / name / "edit_this.py"
            text = file.read_text()
            changed = text.replace(
                "limits = Limits()", f"limits = Limits(speed=Limits().speed * {factor})"
            )
            assert changed != text
            file.write_text(changed)
    shutil.copytree(racer.parent / "template", folder / "template")
    honest = {*SPEEDS, "template", "hovers"}
    (folder / "hovers.py").write_text(HEAD.format(init="pass", after="1e9", harm="pass"))
    for name, harm in HOSTILE.items():
        (folder / f"{name}.py").write_text(HEAD.format(init="pass", after="0.5", harm=harm))
    return honest


class Memory(threading.Thread):
    """Resident memory of this process and of the workers, GiB, at each look."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.rows: list[tuple[float, float, float]] = []
        self.done = threading.Event()

    def run(self) -> None:
        me = psutil.Process()
        while not self.done.wait(1.0):
            workers = 0.0
            for child in me.children(recursive=True):
                try:
                    if "spawn_main" in " ".join(child.cmdline()):
                        workers = max(workers, child.memory_info().rss)
                except psutil.Error:
                    continue
            self.rows.append((time.monotonic(), me.memory_info().rss / 2**30, workers / 2**30))

    def during(self, share: float) -> tuple[float, float]:
        """Most until a share of the time."""
        rows = self.rows[: max(1, round(share * len(self.rows)))] or [(0.0, 0.0, 0.0)]
        return max(r[1] for r in rows), max(r[2] for r in rows)


def singly(tournament: Tournament, folder: Path) -> dict[tuple[str, str], dict[str, Any]]:
    """The first draw of every team and level, flown alone; lines by (team, level)."""
    found = {}
    for order in tournament.plan.orders():
        if 0 not in order.draws:
            continue
        root = unpack(tournament.out / SUBMISSIONS / f"{order.archive}.tar", order.archive, folder)
        level = tournament.plan.level(order.level)
        one = replace(level, blocks=((0,),))
        alone = replace(order, draws=(0,), draw_file=tournament.plan.draw_text(one, 0), record=True)
        line = fly(alone, root / order.place).episodes[0]
        found[order.team, order.level] = line
        print(
            f"  {order.team} on {order.level}: {line['wall']:.2f} s, {line['outcome']}", flush=True
        )
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--levels", default="level0,level1,level2,level3")
    parser.add_argument("--workers", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="tournament-") as name:
        folder = Path(name)
        (folder / "submissions").mkdir()
        honest = make_submissions(folder / "submissions")
        sys.exit(0 if run(folder, arguments, honest) else 1)


def run(folder: Path, arguments: argparse.Namespace, honest: set[str]) -> bool:
    """Fly it all; whether it is as it should be."""
    out = arguments.out or folder / "out"
    tournament = open_tournament(
        out,
        folder / "submissions",
        arguments.levels.split(","),
        {"seeds": arguments.seeds, "patience": 2.0},
    )
    tournament.warm_up(Console())
    print("Each (team, level) alone:")
    alone = singly(tournament, folder / "unpacked")
    total = arguments.seeds * sum(line["wall"] for line in alone.values())
    memory = Memory()
    memory.start()
    began = time.monotonic()
    failed = tournament.fly(lambda: Engine(None, arguments.workers))
    took = time.monotonic() - began
    memory.done.set()
    memory.join()
    lines = tournament.journal.episodes
    blocks = sum(line["wall"] for line in lines.values())
    strange = [
        f"{team} on {level}"
        for (team, level), line in alone.items()
        if team in {name.replace(" ", "-") for name in honest}
        for other in [lines[f"{team}/{level}/0"]]
        if any(line[k] != other[k] for k in ("outcome", "flight_time", "gate_times", "path"))
    ]
    harmed = [
        line["key"]
        for line in lines.values()
        if line["team"] in ("racer", "careful", "cautious") and not line["path"]
    ]
    cores = arguments.workers
    print(f"{len(lines)} episodes in {took:.1f} s on {cores} processes")
    print(f"single episodes / processes: {total / cores:.1f} s; ratio {took * cores / total:.2f}")
    print(f"blocks / processes: {blocks / cores:.1f} s; ratio {took * cores / blocks:.2f}")
    for share in (0.25, 1.0):
        mine, theirs = memory.during(share)
        print(
            f"memory in the first {share:.0%} of the time: organiser {mine:.2f} GiB, "
            f"largest worker {theirs:.2f} GiB"
        )
    print(f"honest flights unlike those alone: {', '.join(strange) or 'none'}")
    print(f"honest episodes not flown: {', '.join(harmed) or 'none'}; blocks lost: {len(failed)}")
    tournament.close()
    return took * cores / total <= MOST and not strange and not harmed and not failed


if __name__ == "__main__":
    main()
