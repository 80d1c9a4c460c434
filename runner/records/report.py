"""The end of a trial: ``result.json`` and the table on the terminal."""

from __future__ import annotations

import contextlib
import datetime
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

NOT_ISOLATED = (
    "Not isolated: the submission could reach its judge. Good for your own work; where results "
    "count, fly with --require-sandbox."
)
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


def result_document(
    result: TrialResult, origin: dict[str, Any], finished: bool = True
) -> dict[str, Any]:
    """What ``result.json`` says; ``origin`` is what :func:`provenance` returns, ``finished``
    False while further episodes are to come: those flown are not in it then, for whoever adds one
    after the other has them already."""
    return {
        "format": FORMAT,
        "finished": finished,
        "clean": result.clean,
        "isolated": result.isolated,
        "requested_episodes": result.requested,
        "score": result.score(),
        "episodes": [episode.as_dict() for episode in result.episodes] if finished else [],
        "provenance": origin,
    }
