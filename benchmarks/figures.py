"""What pictures and report of a dry run cost: 100 episodes of level 3 with and without.

    python benchmarks/figures.py [--pairs 5] [--episodes 100]

Flown in turn, with the defaults (figures, contact sheet, report) and with ``--no-figure
--no-report``: the racer, which flies 10 s an episode, and a controller that never takes off, whose
hundred episodes are over at once. Told are the wall times and the processor times, s, of all
processes, and the medians of their ratios; on a machine that has less than two processors to spare
drawing and flying take turns, and the first ratio comes near the second.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

NEVER = """\
from competition_utils import Command


class Controller:
    def __init__(self, initial_obs, initial_info, use_firmware=False, verbose=False):
        pass

    def cmdFirmware(self, time, obs, reward=None, done=None, info=None):
        return Command.NONE, []
"""


def fly(folder: Path, submission: Path | None, episodes: int, plain: bool) -> tuple[float, float]:
    """Wall and processor time of one command, s."""
    line = [sys.executable, "-m", "crazyarena", "dry-run", "--level", "level3"]
    line += ["--episodes", str(episodes), "--out", str(folder)]
    line += [] if submission is None else [str(submission)]
    line += ["--no-figure", "--no-report"] if plain else []
    began, used = time.perf_counter(), _used()
    done = subprocess.run(line, stdout=subprocess.DEVNULL)
    if done.returncode not in (0, 1):
        raise SystemExit(f"{' '.join(line)}: exit code {done.returncode}")
    return time.perf_counter() - began, _used() - used


def _used() -> float:
    """Processor time of the children that have ended, and of theirs, s."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def main() -> None:
    """Fly and tell."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pairs", type=int, default=5)
    parser.add_argument("--episodes", type=int, default=100)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="crazyarena-figures-") as name:
        place = Path(name)
        never = place / "never.py"
        never.write_text(NEVER)
        for who, submission in (("racer", None), ("never takes off", never)):
            fly(place / f"{who} warm", submission, 2, False)
            pairs = []
            for k in range(arguments.pairs):
                times = [
                    fly(place / f"{who} {k} {plain}", submission, arguments.episodes, plain)
                    for plain in ((True, False) if k % 2 else (False, True))
                ]
                pairs.append(times[::-1] if k % 2 else times)
            told: dict[str, object] = {"flown": who, "load": os.getloadavg()[0]}
            for k, kind in enumerate(("wall", "processor")):
                both = [(drawn[k], plain[k]) for drawn, plain in pairs]
                told[f"{kind} drawn, plain, s"] = [[round(t, 2) for t in pair] for pair in both]
                ratio = statistics.median(drawn / plain for drawn, plain in both)
                told[f"{kind} ratio"] = round(ratio, 3)
            print(json.dumps(told), flush=True)


if __name__ == "__main__":
    main()
