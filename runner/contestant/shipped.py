"""Submissions that come along: the examples, and what ``crazyarena new`` copies."""

from __future__ import annotations

import keyword
import shutil
from pathlib import Path

from crazyarena.errors import InputError, StorageError

STARTERS = {"2022": "starter", "lsy": "starter_lsy"}


def shipped_example(name: str) -> Path:
    """Folder of an example that comes along; raises InputError if it did not."""
    # Beside the runner, in a checkout as in a wheel.
    folder = Path(__file__).resolve().parents[2] / "examples" / name
    if folder.is_dir():
        return folder
    raise InputError(f"the example {name} is not part of this installation. Pass a submission")


def example_racer() -> Path:
    """Folder of the example that flies where no submission is named."""
    return shipped_example("racer")


def make(folder: Path, contract: str) -> list[Path]:
    """Copy the starter of a contract to a new folder; returns its files.

    Raises
    ------
    InputError: there is something already, or the name is none that Python can import.
    StorageError: it cannot be written.
    """
    name = folder.name
    if not name.isidentifier() or keyword.iskeyword(name):
        raise InputError(
            f"{folder}: '{name}' cannot be the name of a Python package. Use letters, digits and _"
        )
    if folder.exists() or folder.is_symlink():
        raise InputError(f"{folder}: is there already. Choose another name")
    source = shipped_example(STARTERS[contract])
    try:
        shutil.copytree(
            source, folder, ignore=shutil.ignore_patterns("__pycache__", "*.pyc", ".*_cache")
        )
    except (OSError, shutil.Error) as error:
        shutil.rmtree(folder, ignore_errors=True)
        raise StorageError(f"{folder}: cannot make it: {error}") from error
    return sorted(file for file in folder.iterdir() if file.is_file())
