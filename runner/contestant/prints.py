"""What a contestant in this process prints, shown and not obeyed by the terminal."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable
from typing import Any

from crazyarena.plain_text import shown


class PrintsShown:
    """Until it is closed, what the main thread prints while ``active()`` is made fit to be shown.

    Other threads, as that of a progress bar, write what they like. This is courtesy to who reads
    the terminal, not a wall: code in this process can get around it.
    """

    def __init__(self, active: Callable[[], bool]) -> None:
        self._before = (sys.stdout, sys.stderr)
        self._ours = (_Stream(sys.stdout, active), _Stream(sys.stderr, active))
        sys.stdout, sys.stderr = self._ours

    def close(self) -> None:
        """Idempotent; streams that somebody has put in place meanwhile stay."""
        if sys.stdout is self._ours[0]:
            sys.stdout = self._before[0]
        if sys.stderr is self._ours[1]:
            sys.stderr = self._before[1]


class _Stream:
    def __init__(self, stream: Any, active: Callable[[], bool]) -> None:
        self._stream = stream
        self._active = active

    def write(self, text: str) -> Any:
        if self._active() and threading.current_thread() is threading.main_thread():
            text = shown(text)
        return self._stream.write(text)

    def writelines(self, lines: Any) -> None:
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)
