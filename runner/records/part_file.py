"""The beginning of a recording, written while the flight goes on.

A disk may take its time. It is waited for in a thread, so that no tick is.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterable
from pathlib import Path

from crazyarena.errors import StorageError
from crazyarena.runner.timing.realtime import SERVING, is_raised, raise_priority
from crazyarena.whole_file import whole_file

_PATIENCE = 30.0  # s for the disk to take the rest


class PartFile:
    """Appends to a file, which is made at once.

    What the disk refuses later is kept in memory, and tried once more at the end.

    Parameters
    ----------
    path: the file.
    beginning: written before this returns, so that what is there can be read from then on.

    Attributes
    ----------
    trouble: that refusal, or None.

    Raises
    ------
    OSError: the file cannot be made.
    """

    def __init__(self, path: Path, beginning: bytes) -> None:
        self.path = path
        self.trouble: OSError | None = None
        self._refused: list[memoryview] = []
        try:
            # Killed in between, a process must leave no recording that is none.
            with whole_file(path, sync=False) as stream:
                stream.write(beginning)
        except StorageError as error:
            raise (error.__cause__ or error) from None
        self._stream = open(path, "ab", buffering=0)  # noqa: SIM115 - closed by close()
        self._queue: queue.SimpleQueue[tuple[bytes, bool] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="recording", daemon=True)
        self._thread.start()

    def append(self, pieces: Iterable[bytes | memoryview]) -> None:
        """Write as soon as the disk can; returns at once."""
        self._queue.put((b"".join(pieces), is_raised()))

    def close(self) -> None:
        """Wait until everything is written. Idempotent."""
        if self._stream.closed:
            return
        self._queue.put(None)
        self._thread.join(_PATIENCE)
        self._stream.close()

    def close_complete(self) -> OSError | None:
        """Close, after another try at what the disk has refused; returns what it still says."""
        self._queue.put(None)
        self._thread.join(_PATIENCE)
        refused, self._refused, self.trouble = self._refused, [], None
        for data in refused:
            self._write(data)
        self._stream.close()
        return self.trouble

    def _run(self) -> None:
        in_flight = False
        while (item := self._queue.get()) is not None:
            data, raised = item
            if raised and not in_flight:
                # Not to be put aside by other programs while it holds the interpreter's lock.
                in_flight = True
                raise_priority(SERVING)
            self._write(memoryview(data))

    def _write(self, left: memoryview) -> None:
        while left and self.trouble is None:
            try:
                left = left[self._stream.write(left) :]
            except OSError as error:
                self.trouble = error
        if left:
            self._refused.append(left)
