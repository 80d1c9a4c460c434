"""Ctrl-C during a trial, and what else asks a program to end."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from typing import Any

# SIGHUP is ignored where nohup says so. Windows has none.
_SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)


class Interrupt:
    """Ctrl-C, SIGTERM or a closed terminal as a wish to end at the next control step.

    So no step is half recorded, and what was flown is reported.

    Only while the controller's own code runs in this process (which may never return) it
    interrupts at once.
    """

    def __init__(self) -> None:
        self.asked = False
        self.in_controller = False
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> Interrupt:
        if threading.current_thread() is threading.main_thread():
            for number in _SIGNALS:
                if signal.getsignal(number) is not signal.SIG_IGN or number == signal.SIGINT:
                    self._previous[number] = signal.signal(number, self._handle)
        return self

    def __exit__(self, *exc: object) -> None:
        while self._previous:
            signal.signal(*self._previous.popitem())

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
