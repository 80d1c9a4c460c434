"""What runs in a worker process: is it fit, has it the submission, and the flight."""

from __future__ import annotations

import contextlib
import hashlib
import os
import platform
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

import crazyarena
from crazyarena import __version__
from crazyarena.errors import InputError
from crazyarena.runner.records.report import machine
from crazyarena.runner.tournament.archive import unpack
from crazyarena.runner.tournament.flight import Flown, NoWalls, Order, fly

_DECIDE = ("numpy", "scipy", "numba", "pydantic")  # packages that a flight's numbers come from
_FOLDERS = ("levels", "mocap", "crazyswarm_compat", "sim_backend", "safety", "runner")
_PREFIX = "crazyarena-submissions-"


@dataclass
class Answer:
    """What a worker says to an order: flown, or why it is not for it.

    Attributes
    ----------
    flown: the block. lacks: it has no copy of the submission; send it along.
    unfit: why no block may be flown here. worker: who it is, see :func:`identity`.
    """

    flown: Flown | None = None
    lacks: bool = False
    unfit: str | None = None
    worker: dict[str, Any] = field(default_factory=dict)


@cache
def sources_digest() -> str:
    """SHA-256 over this package's own code and data, wherever it is installed."""
    digest = hashlib.sha256()
    core = Path(crazyarena.__file__).parent
    files = [(f"crazyarena/{file.name}", file) for file in core.glob("*.py")]
    for name in _FOLDERS:
        place = (core / name).resolve()
        for file in place.rglob("*"):
            if file.suffix in (".py", ".yaml", ".toml", ".json") and file.is_file():
                files.append((f"{name}/{file.relative_to(place).as_posix()}", file))
    for label, file in sorted(files):
        digest.update(label.encode() + b"\0" + hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()


@cache
def _fixed() -> dict[str, Any]:
    here = machine()
    versions = {name: metadata.version(name) for name in _DECIDE}
    return {
        "host": here["host"],
        "cpu": here["cpu"] or platform.machine(),
        "machine": platform.machine(),
        "versions": {
            "crazyarena": __version__,
            "sources": sources_digest(),
            "python": ".".join(map(str, sys.version_info[:2])),
            **versions,
        },
    }


def identity() -> dict[str, Any]:
    """Machine, processors it may use, process and versions of this process."""
    cores = sorted(os.sched_getaffinity(0))
    return {**_fixed(), "pid": os.getpid(), "cores": cores, "pinned": _pinned, **_in_dask()}


def _in_dask() -> dict[str, Any]:
    try:
        from distributed import get_worker

        worker = get_worker()
    except (ImportError, ValueError):
        return {"worker": "", "address": ""}
    return {"worker": str(worker.name), "address": worker.address}


_pinned = False


def pin(cores: Sequence[int]) -> None:
    """Confine this process, and the contestants it starts, to some processors."""
    global _pinned
    for thread in os.listdir("/proc/self/task"):
        with contextlib.suppress(OSError):
            os.sched_setaffinity(int(thread), cores)
    _pinned = True


def difference(mine: Mapping[str, Any], wanted: Mapping[str, Any]) -> str | None:
    """Why versions do not go together, or None if they do."""
    for name, value in wanted["versions"].items():
        found = mine["versions"].get(name)
        if found != value:
            short = name == "sources"
            return (
                f"{name}: it has {str(found)[:12] if short else found}, the organiser "
                f"{str(value)[:12] if short else value}"
            )
    if mine["machine"] != wanted["machine"]:
        return f"processor: it is {mine['machine']}, the organiser's {wanted['machine']}"
    return None


def work(
    order: Order, wanted: Mapping[str, Any], near: str | None, data: bytes | None = None
) -> Answer:
    """Fly an order here, if this is a fit place for it.

    Parameters
    ----------
    wanted: the organiser's :func:`identity`; ``pins``: processors by name of the worker.
    near: folder of archives, if this machine sees it. data: the archive, once it was asked for.
    """
    me = identity()
    cores = wanted.get("pins", {}).get(me["worker"])
    if cores and not _pinned:
        pin(cores)
        me = identity()
    unlike = difference(me, wanted)
    if unlike is not None:
        return Answer(unfit=unlike, worker=me)
    folder = _kept()
    if not (folder / order.archive).is_dir():
        archive: Path | bytes | None = data
        if archive is None and near is not None:
            file = Path(near, f"{order.archive}.tar")
            archive = file if file.is_file() else None
        if archive is None:
            return Answer(lacks=True, worker=me)
        unpack(archive, order.archive, folder)
    submission = folder / order.archive / order.place
    try:
        return Answer(flown=fly(order, submission), worker=me)
    except NoWalls as error:
        return Answer(unfit=str(error), worker=me)


def _kept() -> Path:
    """Folder of this worker's unpacked submissions; dask removes it with the worker's others."""
    try:
        from distributed import get_worker

        base = Path(get_worker().local_directory)
    except (ImportError, ValueError):
        base = Path(tempfile.gettempdir())
    folder = base / f"{_PREFIX}{os.getuid()}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot make this folder: {error.strerror}") from error
    return folder
