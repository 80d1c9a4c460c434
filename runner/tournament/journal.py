"""What was flown, one JSON line an episode, on disk before anybody is told of it.

A line that was cut short (the machine lost power, the disk was full) is not there: its episode is
flown again. Everything before it stands.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from crazyarena.errors import CrazyarenaError, InputError

JOURNAL, LOCK = "episodes.jsonl", "lock"


class StorageFull(CrazyarenaError):
    """A result could not be written; what was written before is safe."""


class Journal:
    """The journal of a results folder, held by one process at a time.

    Attributes
    ----------
    episodes: lines by key. dropped: bytes of a line that was cut short.

    Raises
    ------
    InputError: another process holds it, or it is damaged.
    """

    def __init__(self, out: Path) -> None:
        self.file = out / JOURNAL
        self._lock = os.open(out / LOCK, os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(self._lock)
            raise InputError(
                f"{out}: another tournament is being flown into this folder. Wait for it, or pass "
                "another --out"
            ) from None
        self.dropped = 0
        self.episodes: dict[str, dict[str, Any]] = {}
        try:
            self._stream = open(self.file, "ab")  # noqa: SIM115
            self._load()
        except OSError as error:
            raise InputError(f"{self.file}: cannot open it: {error.strerror}") from error

    def _load(self) -> None:
        size = 0
        for number, line in enumerate(self.file.read_bytes().splitlines(keepends=True), 1):
            if not line.endswith(b"\n"):
                self.dropped = len(line)
                break
            size += len(line)
            try:
                episode = json.loads(line)
                self.episodes[episode["key"]] = episode
            except (ValueError, KeyError, TypeError):
                raise InputError(
                    f"{self.file}:{number}: not a line of a journal. Repair or remove this line; "
                    "its episode is flown again"
                ) from None
        if self.dropped:
            os.truncate(self.file, size)

    def append(self, episodes: Sequence[dict[str, Any]]) -> None:
        """Write lines, all of them or none.

        Raises
        ------
        StorageFull: no room for them.
        """
        size = os.fstat(self._stream.fileno()).st_size
        data = b"".join(json.dumps(e, separators=(",", ":")).encode() + b"\n" for e in episodes)
        try:
            os_write(self._stream.fileno(), data)
            os.fsync(self._stream.fileno())
        except OSError as error:
            with contextlib.suppress(OSError):
                os.ftruncate(self._stream.fileno(), size)
            raise full(self.file, error, len(self.episodes)) from error
        for episode in episodes:
            self.episodes[episode["key"]] = episode

    def close(self) -> None:
        """Let go of it; idempotent."""
        if self._lock >= 0:
            self._stream.close()
            os.close(self._lock)
            self._lock = -1


def os_write(file: int, data: bytes) -> None:
    """Write all of it."""
    view = memoryview(data)
    while view:
        view = view[os.write(file, view) :]


def full(file: Path, why: BaseException | None, safe: int) -> StorageFull:
    """What to say when a result cannot be written."""
    reason = getattr(why, "strerror", why)
    return StorageFull(
        f"{file}: cannot write: {reason}. {safe} episodes are safe; make room and start again with "
        "the same --out"
    )
