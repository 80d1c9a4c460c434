"""Reads small files of strangers: bounded in size, depth and count, with errors that say where.

For files that hold settings or results. Each function raises
:class:`~crazyarena.errors.InputError` with one line, whatever the file holds or is.
"""

from __future__ import annotations

import json
import stat
from pathlib import Path
from typing import Any

from crazyarena.errors import InputError
from crazyarena.plain_text import shown_line

MOST_BYTES = 16 * 2**20
_MOST_NODES = 1_000_000
_MOST_DEPTH = 100
_MOST_CODE = 16 * 2**20  # bytes, of a file of Python


def read_text(path: Path, what: str, most: int = MOST_BYTES) -> str:
    """Text of a regular file of up to ``most`` bytes in UTF-8; ``what`` it should be."""
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise InputError(f"{path}: cannot read the {what}: is a folder or a device")
        with path.open("rb") as stream:
            data = stream.read(most + 1)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        if isinstance(error, FileNotFoundError):
            reason += f" (looked in {Path.cwd()})"
        raise InputError(f"{path}: cannot read the {what}: {reason}") from None
    if len(data) > most:
        raise InputError(f"{path}: larger than the {most // 2**20} MiB a {what} may have")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise InputError(
            f"{path}:{line}: not a {what}: byte {error.start} is not UTF-8 text"
        ) from None


def read_json(path: Path, what: str, most: int = MOST_BYTES) -> Any:
    """Value of a JSON file; numbers that are not finite are no JSON."""
    text = read_text(path, what, most)
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        raise InputError(
            f"{path}:{error.lineno}:{error.colno}: not a {what}: {error.msg}"
        ) from None
    except (ValueError, RecursionError) as error:
        deep = isinstance(error, RecursionError)
        reason = "nested too deeply" if deep else shown_line(str(error))
        raise InputError(f"{path}: not a {what}: {reason}") from None


def parse_yaml(text: str, source: str) -> Any:
    """Value of YAML text; aliases may not make more of it than a million values."""
    import yaml

    loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    try:
        _count(yaml, text, loader, source)
        return yaml.load(text, Loader=loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        place = f"{source}:{mark.line + 1}:{mark.column + 1}" if mark else source
        problem = " ".join(part for part in (error.context, error.problem) if part)
        raise InputError(f"{place}: not valid YAML: {shown_line(problem)}") from None
    except (yaml.YAMLError, ValueError, OverflowError, RecursionError) as error:
        reason = next(iter(str(error).splitlines()), type(error).__name__)
        raise InputError(f"{source}: not valid YAML: {shown_line(reason)}") from None


def _count(yaml: Any, text: str, loader: Any, source: str) -> None:
    """Refuse what grows beyond all bounds when its aliases are followed."""
    sizes: dict[str, int] = {}
    open_: list[tuple[str | None, int]] = []  # anchors, and what was counted before them
    total = 0
    for event in yaml.parse(text, Loader=loader):
        place = f"{source}:{event.start_mark.line + 1}"
        if isinstance(event, yaml.AliasEvent):
            total += sizes.get(event.anchor, 1)
        elif isinstance(event, yaml.CollectionStartEvent):
            open_.append((event.anchor, total))
            total += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, before = open_.pop()
            if anchor is not None:
                sizes[anchor] = total - before
        elif isinstance(event, yaml.ScalarEvent):
            total += 1
        if total > _MOST_NODES:
            raise InputError(f"{place}: more than {_MOST_NODES} values, with aliases followed")
        if len(open_) > _MOST_DEPTH:
            raise InputError(f"{place}: more than {_MOST_DEPTH} levels of nesting")


def check_code(file: Path) -> None:
    """Raise InputError for a file that is too large to be Python code; it is not read."""
    length = file.stat().st_size
    if length > _MOST_CODE:
        raise InputError(
            f"{file}: {size_words(length)}; a Python file may have {size_words(_MOST_CODE)}. Put "
            "data into files beside it"
        )


def size_words(length: int) -> str:
    """Bytes for people."""
    value = float(length)
    for unit in ("bytes", "KiB", "MiB", "GiB"):
        if value < 1024.0:
            return f"{value:.4g} {unit}"
        value /= 1024.0
    return f"{value:.4g} TiB"
