"""A thread that keeps its ticks, as far as the system allows."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from crazyarena.clock import Clock
from crazyarena.runner.timing.realtime import (
    TICKING,
    lock_memory,
    lower_priority,
    raise_priority,
    unlock_memory,
    wide_awake,
)
from crazyarena.runner.timing.wakeup import StampedClock


@contextlib.contextmanager
def steady(clock: Clock) -> Iterator[list[str]]:
    """For the calling thread, which sleeps on ``clock``, inside the ``with`` block: memory is
    locked, the thread runs in real time, processors stay awake, and lookouts fetch it.

    Yields what of it is in force.
    """
    notes = [lock_memory(), raise_priority(TICKING)]
    try:
        with contextlib.ExitStack() as stack:
            notes.append(stack.enter_context(wide_awake()))
            if isinstance(clock, StampedClock):
                notes.append(stack.enter_context(clock.watched()))
            yield notes
    finally:
        lower_priority()
        unlock_memory()
