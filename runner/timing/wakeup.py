"""A wall clock that knows when the machine woke it, not only when Python went on.

Between the two lies the wait for the interpreter, which a program can cause itself; what comes
before is the machine's own doing (timer, scheduler, hypervisor). Both are lateness of a tick,
and only together with the first can the second be judged.
"""

from __future__ import annotations

import contextlib
import functools
import math
import select
from collections.abc import Callable, Iterator

import numpy as np

from crazyarena.clock import WallClock
from crazyarena.runner.timing.libc import MONOTONIC, call
from crazyarena.runner.timing.lookouts import (
    ASLEEP,
    GENERATION,
    Lookouts,
    as_timespec,
    no_orders,
    prepare,
)

_POLLIN = 1
_SLOTS = np.dtype([("fd", "i4"), ("events", "i2"), ("revents", "i2")])


@functools.cache
def _sleeper() -> Callable[..., int] | None:
    """Sleep and stamp without a return to the interpreter; None where there is no such call."""
    from numba import njit

    try:
        poll, gettime = call("ppoll"), call("clock_gettime")
    except AttributeError:
        return None

    @njit(nogil=True)  # type: ignore[untyped-decorator]
    def sleep(slots, until, orders, woke):  # type: ignore[no-untyped-def]
        gettime(MONOTONIC, woke.ctypes)
        left = (until[0] - woke[0]) * 1_000_000_000 + until[1] - woke[1]
        if left <= 0:
            return 0
        rest = np.array([left // 1_000_000_000, left % 1_000_000_000])
        orders[ASLEEP] = orders[GENERATION]
        ready = poll(slots.ctypes, len(slots), rest.ctypes, 0)
        gettime(MONOTONIC, woke.ctypes)
        orders[ASLEEP] = 0
        return ready

    past = np.zeros(2, dtype=np.int64)
    sleep(np.zeros(2, _SLOTS).view(np.int64), past, no_orders(), past.copy())
    return sleep  # type: ignore[no-any-return]


class StampedClock(WallClock):
    """For one thread. Making the first one takes seconds.

    Attributes
    ----------
    machine_late: how late the machine ended the last :meth:`sleep_until`, s; if the deadline had
        passed before, what of that delay the machine has caused; NaN if nobody can tell.
    standstill: how long after that deadline no processor that we know of was awake, s: what no
        program could have made up for; NaN likewise.
    """

    def __init__(self, origin: float | None = None) -> None:
        super().__init__(origin)
        self._sleep = _sleeper()
        if self._sleep is not None:
            prepare()
        self._until = np.zeros(2, dtype=np.int64)
        self._woke = np.zeros(2, dtype=np.int64)
        # The lookouts', and somebody else's.
        self._slots = np.zeros(2, _SLOTS)
        self._slots["fd"] = -1
        self._slots["events"] = _POLLIN
        self._numbers = self._slots.view(np.int64)
        self._lookouts: Lookouts | None = None
        self._orders = no_orders()
        self._expected = math.nan
        self._overslept = math.nan
        self.machine_late = self.standstill = math.nan

    @contextlib.contextmanager
    def watched(self) -> Iterator[str]:
        """Have :class:`~.Lookouts` fetch the calling thread when it oversleeps, inside the
        ``with`` block; yields what is in force."""
        if self._sleep is None:
            yield "nobody looks out for ticks that oversleep: no system call"
            return
        lookouts = Lookouts()
        self._lookouts, self._orders = lookouts, lookouts.orders
        self._slots["fd"][0] = lookouts.descriptor
        try:
            yield lookouts.note
        finally:
            self._lookouts, self._orders = None, no_orders()
            self._slots["fd"][0] = -1
            lookouts.close()

    def expect(self, deadline: float) -> None:
        """Make ``deadline`` the one that the lookouts know of, before there is time to sleep."""
        if deadline != self._expected:
            self._expected = deadline
            self._overslept = math.nan
            if self._lookouts is not None:
                self._lookouts.expect(*as_timespec(self.origin + deadline))

    def doze(self, until: float, descriptor: int) -> None:
        """Sleep until a time before the expected deadline, or until ``descriptor`` is readable."""
        if self._sleep is None:
            waited_for = [descriptor] if descriptor >= 0 else []
            select.select(waited_for, [], [], max(0.0, until - self.now()))
        else:
            self._wait(until, descriptor)

    def sleep_until(self, deadline: float) -> float:
        self.machine_late = self.standstill = math.nan
        if self._sleep is None:
            return super().sleep_until(deadline)
        self.expect(deadline)
        if deadline > self.now():
            # Signals interrupt it; their handlers run here, and may raise.
            while self._wait(deadline, -1) < deadline:
                pass
        late = max(0.0, self.now() - deadline)
        self._blame()
        return late

    def _blame(self) -> None:
        """Find out who was late."""
        lookouts = self._lookouts
        if not math.isnan(self._overslept):
            self.machine_late = self._overslept
        elif lookouts is not None and (here := lookouts.late_here()) is not None:
            self.machine_late = here
        self.standstill = self.machine_late
        if lookouts is not None:
            self.standstill = min(self.standstill, lookouts.first_awake())

    def _wait(self, until: float, descriptor: int) -> float:
        self._until[:] = as_timespec(self.origin + until)
        self._slots["fd"][1] = descriptor
        self._sleep(self._numbers, self._until, self._orders, self._woke)  # type: ignore[misc]
        seconds, nanoseconds = self._woke.tolist()
        woke: float = seconds + 1e-9 * nanoseconds - self.origin
        if woke >= self._expected:
            self._overslept = woke - self._expected
        if self._lookouts is not None and self._slots["revents"][0]:
            self._slots["revents"][0] = 0
            self._lookouts.release()
        return woke
