"""Files that are there whole or not at all, whatever ends the program or fills the disk."""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

from crazyarena.errors import StorageError


def _numbers(*names: str) -> frozenset[int]:
    """Those that this system has."""
    return frozenset(getattr(errno, name) for name in names if hasattr(errno, name))


FULL = _numbers("ENOSPC", "EDQUOT", "EFBIG")
"""What a disk says that takes no more."""
_REFUSALS = FULL | _numbers("EROFS", "EIO", "EACCES", "EPERM", "ENOTDIR", "EISDIR", "ENOENT")


@contextlib.contextmanager
def whole_file(path: Path, sync: bool = True, mode: int | None = None) -> Iterator[BinaryIO]:
    """Open ``<path>.new``; it takes the place of ``path`` when the block ends, at once.

    If the block raises, or the disk refuses, what was at ``path`` stays as it was.

    Parameters
    ----------
    sync: wait until the disk has it, so that it outlives a loss of power, too.
    mode: permissions that it has from the beginning, whatever the umask; the usual ones if None.

    Raises
    ------
    StorageError: it cannot be written.
    """
    if path.exists() and not path.is_file():
        # A device or a pipe, which nothing can take the place of.
        try:
            with open(path, "wb") as stream:
                yield stream
        except OSError as error:
            raise StorageError.of(path, error) from error
        return
    unfinished = path.with_name(path.name + ".new")
    try:
        opener = None if mode is None else partial(_open_with, mode)
        with open(unfinished, "wb", opener=opener) as stream:
            yield stream
            stream.flush()
            if sync:
                os.fsync(stream.fileno())
        os.replace(unfinished, path)
        if sync:
            _sync_folder(path.parent)
    except BaseException as error:
        with contextlib.suppress(OSError):
            unfinished.unlink()
        if isinstance(error, OSError):
            raise StorageError.of(path, error) from error
        raise


def write_whole(path: Path, text: str | bytes, mode: int | None = None) -> None:
    """Write a file (UTF-8) in one piece; raises StorageError and leaves what was there."""
    with whole_file(path, mode=mode) as stream:
        stream.write(text.encode() if isinstance(text, str) else text)


def save_figure(figure: Any, path: Path, dpi: float | None = None) -> None:
    """Write a figure of matplotlib in one piece, in the format that the file's name tells."""
    options = {} if dpi is None else {"dpi": dpi}
    with whole_file(path, sync=False) as stream:
        figure.savefig(stream, format=path.suffix[1:] or "png", **options)


def _open_with(mode: int, path: str, flags: int) -> int:
    number = os.open(path, flags, mode)
    os.chmod(path, mode)  # what the umask took, or an older file had
    return number


def is_refusal(error: OSError) -> bool:
    """Whether an error speaks of the disk, or of who may write to it, and not of the program."""
    return error.errno in _REFUSALS


def _sync_folder(folder: Path) -> None:
    """Put a new name on the disk; not every system lets a folder be synced."""
    with contextlib.suppress(OSError):
        number = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(number)
        finally:
            os.close(number)
