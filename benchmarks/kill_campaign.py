"""Runs that are killed at random moments: whether everything they leave can be read.

    python benchmarks/kill_campaign.py [--dry-run 60] [--evaluate 10] [--bench 10] [--tournament 20]

Each run flies more episodes than it will live for. It is killed with SIGKILL at a moment drawn
evenly between its start and twice the time of its first episode; every fourth gets SIGTERM first,
and 20 s. What it has started (sandbox, flight process, virtual arena) must end by itself. Then
every recording is read to its end; ``result.json``, or the journal of a tournament, must be whole
and tell of every finished one.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

from crazyarena.errors import CrazyarenaError
from crazyarena.runner.records import export
from crazyarena.runner.tournament.journal import JOURNAL, Journal

ROOT = Path(__file__).resolve().parent.parent
_EMPTY = [
    "track.gates=[]", "track.obstacles=[]", "start.position=[0, -0.5, 0.03]",
    "goal.position=[2.5, 2.5, 1.5]", "episode_length=8.0",
]  # fmt: skip
_MOST = 400.0  # s for a first episode, with compiling
_MERCY = 20.0  # s between SIGTERM and SIGKILL
_LANDING = 60.0  # s for a vehicle without a runner to be landed
_TEAMS = 200
_MARK = "CRAZYARENA_KILL_CAMPAIGN"


def _sets(overrides: list[str]) -> list[str]:
    return [word for override in overrides for word in ("--set", override)]


COMMANDS = {
    "dry-run": [
        "dry-run", str(ROOT / "examples" / "starter"), "--episodes", "100000", "--no-figure",
    ],
    "evaluate": [
        "evaluate", str(ROOT / "examples" / "starter_lsy"), "--level", "lsy/level1", "--record",
        "--runs", "100000",
    ],
    "bench": [
        "bench", str(ROOT / "examples" / "template"), "--no-dry", "--no-figure", "--runs", "100",
        *_sets(_EMPTY),
    ],
    "tournament": ["tournament", "{teams}", "--levels", "level0", "--seeds", "2"],
}  # fmt: skip


@dataclass
class Tally:
    """What the runs of one command came to."""

    runs: int = 0
    readable: int = 0
    episodes: int = 0
    recordings: int = 0
    parts: int = 0
    troubles: list[str] = field(default_factory=list)


def _first_episode(command: list[str], folder: Path) -> float:
    """s from the start to the first result of an episode."""
    out = folder / "first"
    started = time.monotonic()
    with _running(command, out) as process:
        while not _told(out):
            if time.monotonic() - started > _MOST or process.poll() is not None:
                raise SystemExit(f"{' '.join(command)}: no episode; exit code {process.poll()}")
            time.sleep(0.05)
        return time.monotonic() - started


@contextlib.contextmanager
def _running(command: list[str], out: Path):
    process = subprocess.Popen(
        [sys.executable, "-m", "crazyarena", *command, "--out", str(out)],
        stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        env={**os.environ, _MARK: str(out)}, cwd=out.parent,
    )  # fmt: skip
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def _alive(out: Path) -> list[int]:
    """Processes that a run has left, by the mark in their environment."""
    mark = f"{_MARK}={out}".encode()
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if mark in (folder / "environ").read_bytes().split(b"\0"):
                found.append(int(folder.name))
    return found


def _ended(out: Path) -> list[str]:
    """Wait for what a run has started; returns what is wrong."""
    deadline = time.monotonic() + _LANDING
    while left := _alive(out):
        if time.monotonic() > deadline:
            return [f"{out}: still alive: {left}"]
        time.sleep(0.2)
    return []


def _results(out: Path) -> list[Path]:
    return sorted(out.rglob("result.json"))


def _lines(journal: Path) -> list[str]:
    """Episodes of a tournament, as they are written: what is cut short is not there yet."""
    return [line for line in journal.read_text().splitlines(keepends=True) if line.endswith("\n")]


def _told(out: Path) -> int:
    count = sum(len(_lines(journal)) for journal in out.glob(JOURNAL))
    for file in _results(out):
        count += len(json.loads(file.read_text())["episodes"])
    return count


def check(out: Path, tally: Tally) -> list[str]:
    """Read everything a run has left in ``out``; returns what is wrong."""
    troubles = []
    for file in _results(out):
        try:
            document = json.loads(file.read_text())
        except ValueError as error:
            troubles.append(f"{file}: {error}")
            continue
        told = {e["files"]["recording"] for e in document["episodes"] if e["files"]}
        tally.episodes += len(document["episodes"])
        whole = {p.name for p in file.parent.glob("*.mcap")}
        parts = {p.name for p in file.parent.glob("*.mcap.part")}
        if lost := told - whole - parts:
            troubles.append(f"{file.parent}: told of and not there: {sorted(lost)}")
        if len(untold := whole - told) > 1:
            troubles.append(f"{file.parent}: there and not told of: {sorted(untold)}")
    if (out / JOURNAL).exists():
        troubles += _journal(out, tally)
    for file in sorted([*out.rglob("*.mcap"), *out.rglob("*.mcap.part")]):
        try:
            recording = export.read(file)
        except CrazyarenaError as error:
            troubles.append(str(error))
            continue
        finished = file.suffix == ".mcap"
        tally.recordings += finished
        tally.parts += not finished
        if finished and not recording.complete:
            troubles.append(f"{file}: not complete")
    return troubles


def _journal(out: Path, tally: Tally) -> list[str]:
    """Read a tournament's journal as the next start does."""
    try:
        journal = Journal(out)
    except CrazyarenaError as error:
        return [str(error)]
    journal.close()
    tally.episodes += len(journal.episodes)
    told = {e["recording"] for e in journal.episodes.values() if e["recording"]}
    lost = sorted(name for name in told if not (out / name).exists())
    return [f"{out}: told of and not there: {lost}"] if lost else []


def _command(name: str, folder: Path) -> list[str]:
    teams = folder / "teams"
    if "{teams}" in COMMANDS[name]:
        for team in range(_TEAMS):
            shutil.copytree(ROOT / "examples" / "starter", teams / f"team{team}")
    return [word.format(teams=teams) for word in COMMANDS[name]]


def campaign(name: str, runs: int, draw: random.Random, folder: Path) -> Tally:
    """Kill ``runs`` runs of a command."""
    tally = Tally()
    command = _command(name, folder)
    first = _first_episode(command, folder)
    for index in range(runs):
        out = folder / f"{name}-{index}"
        with _running(command, out) as process:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(draw.uniform(0.2, 2.0) * first)
            if process.poll() is not None:
                tally.troubles.append(f"{out}: ended by itself with {process.returncode}")
            if index % 4 == 3:
                process.terminate()
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(_MERCY)
        troubles = _ended(out) + check(out, tally)
        tally.runs += 1
        tally.readable += not troubles
        tally.troubles += troubles
    return tally


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    defaults = {"dry-run": 60, "evaluate": 10, "bench": 10, "tournament": 20}
    for name in COMMANDS:
        parser.add_argument(f"--{name}", type=int, default=defaults[name])
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    draw = random.Random(options.seed)
    good = runs = 0
    print(f"{'command':10} {'runs':>5} {'readable':>9} {'episodes':>9} {'whole':>6} {'parts':>6}")
    for name in COMMANDS:
        wanted = getattr(options, name.replace("-", "_"))
        if not wanted:
            continue
        with tempfile.TemporaryDirectory() as folder:
            t = campaign(name, wanted, draw, Path(folder))
        good, runs = good + t.readable, runs + t.runs
        print(
            f"{name:10} {t.runs:5} {t.readable:9} {t.episodes:9} {t.recordings:6} {t.parts:6}",
            flush=True,
        )
        for trouble in t.troubles:
            print(f"  {trouble}")
    print(f"readable: {good} of {runs}")
    sys.exit(good != runs)


if __name__ == "__main__":
    main()
