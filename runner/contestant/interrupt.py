"""Ctrl-C during a trial."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from typing import Any


class Interrupt:
    """Ctrl-C as a wish to end at the next control step, so that no step is half recorded.

    Only while the controller's own code runs in this process (which may never return) it
    interrupts at once.
    """

    def __init__(self) -> None:
        self.asked = False
        self.in_controller = False
        self._previous: Any = None

    def __enter__(self) -> Interrupt:
        if threading.current_thread() is threading.main_thread():
            self._previous = signal.signal(signal.SIGINT, self._handle)
        return self

    def __exit__(self, *exc: object) -> None:
        if self._previous is not None:
            signal.signal(signal.SIGINT, self._previous)
            self._previous = None

    @contextlib.contextmanager
    def at_once(self) -> Iterator[None]:
        """Inside the ``with`` block the controller's code runs here."""
        self.in_controller = True
        try:
            yield
        finally:
            self.in_controller = False

    def _handle(self, signum: int, frame: object) -> None:
        again = self.asked
        self.asked = True
        if self.in_controller or again:
            raise KeyboardInterrupt
