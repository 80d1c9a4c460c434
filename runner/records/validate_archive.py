"""NumPy archives that somebody else may have written, in bounded memory."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from crazyarena.bounded_read import size_words
from crazyarena.errors import InputError
from crazyarena.plain_text import shown_line

_MOST = 1 << 29  # bytes, unpacked: an hour of everything at 400 Hz
# A header may claim any shape, and what is packed may be spoilt, or packed in some other way.
_UNREADABLE = (
    OSError,
    ValueError,
    EOFError,
    KeyError,
    MemoryError,
    RuntimeError,
    zipfile.BadZipFile,
    zlib.error,
)


def unpacked(file: Path) -> dict[str, Any]:
    """Arrays of an archive by name; raises InputError if it is none, or unpacks to too much."""
    try:
        with zipfile.ZipFile(file) as packed:
            size = sum(entry.file_size for entry in packed.infolist())
        if size > _MOST:
            raise InputError(
                f"{file}: unpacks to {size_words(size)}; a flight may have {size_words(_MOST)}"
            )
        with np.load(file, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except _UNREADABLE as error:
        reason = shown_line(str(error) or type(error).__name__)
        raise InputError(f"{file}: not a NumPy archive: {reason}") from error
