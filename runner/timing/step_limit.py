"""Ends foreign code in this process that does not return in time."""

from __future__ import annotations

import atexit
import contextlib
import faulthandler
import math
import signal
import threading
import time
from collections.abc import Iterator
from functools import cache
from typing import Any

_AGAIN = 1.0  # s, until it is interrupted once more, should it have caught the first
_GRACE = 20.0  # s of processor time, within which that must have ended it
_AT_ONCE = 1e-3  # s
_LOOK = 0.25  # s
_STDERR = 2


class TimeIsUp(BaseException):
    """Raised in code that :func:`bounded` has run out of patience with; not to be caught by it."""


@contextlib.contextmanager
def bounded(seconds: float) -> Iterator[None]:
    """Raise :class:`TimeIsUp` in the ``with`` block once it has run for ``seconds`` s of wall time.

    Works in the main thread, where signals arrive; elsewhere it does nothing. Compiled code that
    never returns to the interpreter cannot be interrupted: after another 20 s of its processor
    the program says where it hangs and is ended by SIGPROF.
    """
    if threading.current_thread() is not threading.main_thread() or seconds <= 0.0:
        yield
        return

    began, running = time.perf_counter(), True

    def ring(number: int, frame: Any) -> None:
        # An alarm of somebody else's timer may still be on its way.
        if running and time.perf_counter() - began >= 0.99 * seconds:
            raise TimeIsUp

    _last_resort()
    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_PROF, seconds + _GRACE)
    due, again = signal.setitimer(signal.ITIMER_REAL, seconds, _AGAIN)
    try:
        yield
    finally:
        running = False
        # Whoever has set an alarm of their own gets it, if late.
        left = max(due - (time.perf_counter() - began), _AT_ONCE) if due else 0.0
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGALRM, before)
        signal.setitimer(signal.ITIMER_REAL, left, again)


class StepLimit:
    """As :func:`bounded`, for many short pieces of code, each of which costs two assignments.

    One timer looks now and then whether the present piece is overdue; so it may run for a quarter
    of a second longer. Begins with the first piece; :meth:`close` gives alarm and timer back.
    """

    def __init__(self) -> None:
        self._due = math.inf
        self._open = False
        self._patience = 0.0
        self._before: Any = None
        self._timer = (0.0, 0.0)

    def begin(self, started: float, seconds: float) -> None:
        """A piece has begun at ``started`` (:func:`time.perf_counter`) and may take so long."""
        if not self._open and threading.current_thread() is threading.main_thread():
            self._start(seconds)
        self._patience = seconds
        self._due = started + seconds

    def end(self) -> None:
        """It has returned."""
        self._due = math.inf

    def _start(self, seconds: float) -> None:
        self._open = True
        # An alarm that rings while the interpreter ends would end it with an error.
        atexit.register(self.close)
        _last_resort()
        self._before = signal.signal(signal.SIGALRM, self._look)
        # Pushed away as long as the interpreter lives: what it finds is code that never returns.
        signal.setitimer(signal.ITIMER_PROF, seconds + _GRACE)
        self._timer = signal.setitimer(signal.ITIMER_REAL, _LOOK, _LOOK)

    def _look(self, number: int, frame: Any) -> None:
        signal.setitimer(signal.ITIMER_PROF, self._patience + _GRACE)
        if time.perf_counter() > self._due:
            raise TimeIsUp

    def close(self) -> None:
        """Idempotent."""
        if not self._open:
            return
        self._open = False
        atexit.unregister(self.close)
        self._due = math.inf
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGALRM, self._before)
        left, again = self._timer
        signal.setitimer(signal.ITIMER_REAL, max(left, _AT_ONCE) if left else 0.0, again)


@cache
def _last_resort() -> None:
    """Have SIGPROF tell where the program is, without the interpreter's help, and end it."""
    faulthandler.register(signal.SIGPROF, file=_STDERR, all_threads=False, chain=True)
