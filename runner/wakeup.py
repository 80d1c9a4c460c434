"""A wall clock that knows when the machine woke it, not only when Python went on.

Between the two lies the wait for the interpreter, which a program can cause itself; what comes
before is the machine's own doing (timer, scheduler, hypervisor). Both are lateness of a tick,
and only together with the first can the second be judged.
"""

from __future__ import annotations

import ctypes
import errno
import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from crazyarena.clock import WallClock

_MONOTONIC = 1
_ABSOLUTE = 1

Sleep = Callable[[Any, Any], int]


@functools.cache
def _sleeper() -> Sleep | None:
    """Sleep and stamp without a return to the interpreter; None where there is no such call."""
    from numba import njit

    libc = ctypes.CDLL(None)
    try:
        nanosleep, gettime = libc.clock_nanosleep, libc.clock_gettime
    except AttributeError:
        return None
    number, pointer = ctypes.c_int, ctypes.c_void_p
    nanosleep.argtypes, nanosleep.restype = (number, number, pointer, pointer), number
    gettime.argtypes, gettime.restype = (number, pointer), number

    @njit(nogil=True)  # type: ignore[untyped-decorator]
    def sleep(until, woke):  # type: ignore[no-untyped-def]
        result = nanosleep(_MONOTONIC, _ABSOLUTE, until.ctypes, 0)
        gettime(_MONOTONIC, woke.ctypes)
        return result

    past = np.zeros(2, dtype=np.int64)
    sleep(past, past.copy())
    return sleep  # type: ignore[no-any-return]


class StampedClock(WallClock):
    """For one thread. Making the first one takes a second.

    Attributes
    ----------
    machine_late: how late the machine ended the last :meth:`sleep_until`, s; NaN if the deadline
        had passed before, or the system cannot tell.
    """

    def __init__(self, origin: float | None = None) -> None:
        super().__init__(origin)
        self._sleep = _sleeper()
        self._until = np.zeros(2, dtype=np.int64)
        self._woke = np.zeros(2, dtype=np.int64)
        self.machine_late = math.nan

    def sleep_until(self, deadline: float) -> float:
        self.machine_late = math.nan
        sleep = self._sleep
        if sleep is None:
            return super().sleep_until(deadline)
        if deadline > self.now():
            self._until[:] = divmod(round((self.origin + deadline) * 1e9), 1_000_000_000)
            # Signals interrupt it; their handlers run here, and may raise.
            while sleep(self._until, self._woke) == errno.EINTR:
                pass
            woke = int(self._woke[0]) + 1e-9 * int(self._woke[1]) - self.origin
            self.machine_late = max(0.0, woke - deadline)
        return max(0.0, self.now() - deadline)
