"""Finds recorded truth: environment variable, then ../shared, then the copies in tests/data.

Files are told apart by what they say of themselves (array names, ``meta_json``), never by
their names, so that another set of the same layout goes through the same tests.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
_FOLDERS = {
    "vectors": "CRAZYARENA_VECTORS",
    "reference_flights": "CRAZYARENA_REFERENCE_FLIGHTS",
    "firmware_recordings": "CRAZYARENA_RECORDINGS",
}


def folder(kind: str) -> Path:
    """Folder of one kind of recordings; a set given by the environment must exist."""
    given = os.environ.get(_FOLDERS[kind])
    if given:
        path = Path(given)
        if not path.is_dir():
            raise FileNotFoundError(f"{_FOLDERS[kind]}={given}: no such folder")
        return path
    shared = ROOT.parent / "shared" / kind
    return shared if shared.is_dir() else ROOT / "tests" / "data" / kind


@cache
def arrays(path: Path) -> dict[str, np.ndarray]:
    """All arrays of one .npz file."""
    with np.load(path, allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}


def _names(path: Path) -> frozenset[str]:
    with np.load(path, allow_pickle=False) as archive:
        return frozenset(archive.files)


def vector_files(*required: str, where: Callable[[dict], bool] | None = None) -> Iterator[Path]:
    """Vector files that hold all the named arrays (and satisfy ``where``), sorted by path."""
    for path in sorted(folder("vectors").glob("*.npz")):
        if set(required) <= _names(path) and (where is None or where(arrays(path))):
            yield path
