"""What a contestant in this process prints: shown, not obeyed by the terminal, and not endless."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable
from typing import Any

from crazyarena.plain_text import shown

MOST = 2**20
"""Characters that are shown of one contestant; further ones are left out, which is told once."""


class PrintsShown:
    """Until it is closed, what the main thread prints while ``active()`` is made fit to be shown.

    Other threads, as that of a progress bar, write what they like. This is courtesy to who reads
    the terminal, not a wall: code in this process can get around it.
    """

    def __init__(self, active: Callable[[], bool]) -> None:
        self._before = (sys.stdout, sys.stderr)
        self._active = active
        self._left = MOST
        self._ours = (_Stream(sys.stdout, self._fit), _Stream(sys.stderr, self._fit))
        sys.stdout, sys.stderr = self._ours

    def close(self) -> None:
        """Idempotent; streams that somebody has put in place meanwhile stay."""
        if sys.stdout is self._ours[0]:
            sys.stdout = self._before[0]
        if sys.stderr is self._ours[1]:
            sys.stderr = self._before[1]

    def _fit(self, text: str) -> str:
        """What is to be written of ``text``."""
        if not self._active() or threading.current_thread() is not threading.main_thread():
            return text
        if self._left <= 0:
            return ""
        self._left -= len(text)
        if self._left > 0:
            return shown(text)
        kept = shown(text[: self._left + len(text)])
        return f"{kept}\n[the controller has printed {MOST >> 20} MiB; no more of it is shown]\n"


class _Stream:
    def __init__(self, stream: Any, fit: Callable[[str], str]) -> None:
        self._stream = stream
        self._fit = fit

    def write(self, text: str) -> Any:
        fit = self._fit(text)
        if fit:
            self._stream.write(fit)
        return len(text)

    def writelines(self, lines: Any) -> None:
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)
