"""The end of a trial: ``result.json`` and the table on the terminal."""

from __future__ import annotations

import contextlib
import datetime
import json
import os
import platform
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

from crazyarena import __version__
from crazyarena.levels import dump_level
from crazyarena.levels.schema import Level
from crazyarena.runner.judging.result import FORMAT, TrialResult

_PACKAGES = (
    "numpy",
    "numba",
    "scipy",
    "casadi",
    "torch",
    "cflib",
    "eclipse-zenoh",
    "motioncapture",
)


def versions() -> dict[str, str]:
    versions = {"crazyarena": __version__, "python": platform.python_version()}
    for package in _PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return versions


def machine() -> dict[str, Any]:
    """The computer, as far as it bears on timing."""
    model = platform.processor()
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.lower().startswith("model name"):
                model = line.partition(":")[2].strip()
                break
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    return {"host": platform.node(), "cpu": model, "cpus": os.cpu_count(), "load": load}


def provenance(level: Level, seed: int, submission: Path, digest: str) -> dict[str, Any]:
    """Everything needed to fly the same again."""
    return {
        "versions": versions(),
        "platform": platform.platform(),
        "machine": machine(),
        "command": sys.argv[1:],
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "level": level.name,
        "level_file": dump_level(level),
        "profile": str(level.profile.value),
        "seed": seed,
        "submission": str(submission),
        "submission_sha256": digest,
    }


def write_result(file: Path, result: TrialResult, origin: dict[str, Any]) -> None:
    """Write ``result.json``; ``origin`` is what :func:`provenance` returns."""
    document = {
        "format": FORMAT,
        "clean": result.clean,
        "requested_episodes": result.requested,
        "score": result.score(),
        "episodes": [episode.as_dict() for episode in result.episodes],
        "provenance": origin,
    }
    file.write_text(json.dumps(document, indent=2) + "\n")


def table(result: TrialResult) -> Any:
    """Rich table of the competition's summary fields, a row an episode."""
    from rich import box
    from rich.table import Table

    shown = Table(box=box.SIMPLE, header_style="bold", collapse_padding=True, pad_edge=False)
    shown.add_column("#", justify="right")
    # A narrow terminal may cut the other columns, never why a flight ended.
    longest = max((len(e.termination) for e in result.episodes), default=0)
    shown.add_column("termination", no_wrap=True, min_width=longest)
    for name in ("time s", "gates", "coll.", "viol.", "reward", "learn s"):
        shown.add_column(name, justify="right", no_wrap=True)
    shown.add_column("compute ms\np50/max", justify="right", no_wrap=True)
    for e in result.episodes:
        style = "green" if e.clean else "red"
        c = e.compute_ms
        learning = e.interstep_learning_time + e.interepisode_learning_time
        shown.add_row(
            str(e.index + 1),
            f"[{style}]{e.termination}[/{style}]",
            f"{e.flight_time:.3f}",
            f"{e.gates_passed}/{e.gates}",
            str(e.collisions),
            str(e.violations),
            f"{e.reward:.0f}",
            f"{learning:.3f}",
            f"{c['p50']:.2g}/{c['max']:.2g}" if c else "-",
        )
    return shown
