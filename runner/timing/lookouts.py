"""Threads that fetch a sleeper whose processor does not wake up in time.

A thread that sleeps is woken on the processor it fell asleep on. Where that one is held up (by
a hypervisor that runs somebody else on it, by firmware, by an interrupt handler), it oversleeps,
however many other processors stand idle. A lookout on another one gets up a moment after the
deadline, sees that the sleeper has not, moves it over and wakes it.

Each lookout also notes how late it got up itself. It runs before everything else on its
processor, so that this is the machine's doing, whatever the sleeper was up to.
"""

from __future__ import annotations

import contextlib
import functools
import os
import signal
import threading
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from crazyarena.runner.timing.libc import MONOTONIC, call
from crazyarena.runner.timing.realtime import LOOKING_OUT, is_raised, raise_priority

_MOST = 4
_GRACE = 0.0001  # s that a sleeper has to get up by itself
_APART = 0.00005  # s between the lookouts, of which one is enough
_MASK_WORDS = 16  # 1024 processors
_FAR = 1 << 40  # s
_NOT_YET = -1

# Places in the orders. The generation numbers the deadlines.
GENERATION, SECONDS, NANOSECONDS, ASLEEP, STOP, SLEEPER = range(6)

Orders = NDArray[np.int64]


def no_orders() -> Orders:
    """Orders for nobody."""
    return np.zeros(8, dtype=np.int64)


def as_timespec(seconds: float) -> tuple[int, int]:
    """Whole seconds and nanoseconds."""
    whole, part = divmod(round(seconds * 1e9), 1_000_000_000)
    return whole, part


@functools.cache
def _look_out() -> Callable[..., None] | None:
    """What a lookout does, compiled; None where the system lacks a call for it."""
    from numba import njit

    try:
        wait, gettime = call("sem_clockwait"), call("clock_gettime")
        move, write = call("sched_setaffinity"), call("write")
    except AttributeError:
        return None
    far, mask_size = _FAR, 8 * _MASK_WORDS

    @njit(nogil=True)  # type: ignore[untyped-decorator]
    def look_out(orders, posted, woke, mask, descriptor, grace):  # type: ignore[no-untyped-def]
        until = np.array([far, 0])
        now = np.zeros(2, np.int64)
        one = np.ones(1, np.int64)
        generation = 0
        woke[0] = generation
        while True:
            ordered = wait(posted.ctypes, MONOTONIC, until.ctypes) == 0
            if orders[STOP] != 0:
                return
            if ordered:
                generation = orders[GENERATION]
                at = orders[SECONDS] * 1_000_000_000 + orders[NANOSECONDS] + grace
                until[0] = at // 1_000_000_000
                until[1] = at % 1_000_000_000
                continue
            gettime(MONOTONIC, now.ctypes)
            late = (now[0] - until[0]) * 1_000_000_000 + now[1] - until[1]
            if late < 0:
                continue
            until[0] = far
            woke[1] = late
            woke[0] = generation
            if orders[ASLEEP] == generation:
                move(orders[SLEEPER], mask_size, mask.ctypes)
                write(descriptor, one.ctypes, 8)

    # Compiled here and now: one that finds its orders to stop does nothing else.
    post, numbers, stop = call("sem_post"), np.zeros((2, 4), dtype=np.int64), no_orders()
    stop[STOP] = 1
    call("sem_init")(numbers[0].ctypes.data, 0, 0)
    post(numbers[0].ctypes.data)
    look_out(stop, numbers[0], numbers[1, :2], np.zeros(_MASK_WORDS, dtype=np.uint64), -1, 0)
    return look_out  # type: ignore[no-any-return]


def prepare() -> None:
    """Do now what takes the first lookouts a second."""
    _look_out()


class Lookouts:
    """Look out for the thread that makes them, in front of it if it runs in real time.

    They keep it to one processor at a time: it is never sent to one that may be held up.

    Attributes
    ----------
    orders: shared with whoever sleeps: it writes the generation to ``ASLEEP`` before it falls
        asleep and 0 when it is up.
    descriptor: becomes readable to wake the sleeper, until it calls :meth:`release`.
    fetched: how often that happened.
    """

    def __init__(self) -> None:
        self.orders = no_orders()
        self.orders[SLEEPER] = threading.get_native_id()
        self.descriptor = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._processors = sorted(os.sched_getaffinity(0))
        self.fetched = 0
        self._threads: list[threading.Thread] = []
        self._closed = False
        look_out = _look_out()
        if look_out is None or len(self._processors) < 2:
            self._chosen: list[int] = []
        else:
            stride = -(-len(self._processors) // _MOST)
            self._chosen = self._processors[::stride]
        count = len(self._chosen)
        # A semaphore of the C library is four words at most.
        self._posted = np.zeros((count, 4), dtype=np.int64)
        # Generation and lateness, ns.
        self._woke = np.full((count, 2), _NOT_YET, dtype=np.int64)
        self._post = call("sem_post") if count else None
        raised = is_raised()
        for index, processor in enumerate(self._chosen):
            call("sem_init")(self._posted[index].ctypes.data, 0, 0)
            thread = threading.Thread(
                target=self._run,
                args=(look_out, index, processor, raised),
                name=f"lookout-{processor}",
                daemon=True,
            )
            thread.start()
            self._threads.append(thread)
        # None of them needs the interpreter from here on.
        pause = threading.Event()
        while (self._woke[:, 0] == _NOT_YET).any():
            pause.wait(0.001)
        if count:
            os.sched_setaffinity(0, {call("sched_getcpu")()})

    def _run(self, look_out: Callable[..., None], index: int, processor: int, raised: bool) -> None:
        # A signal is for the main thread, which it wakes.
        signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())
        with contextlib.suppress(OSError):
            os.sched_setaffinity(0, {processor})
        if raised:
            raise_priority(LOOKING_OUT)
        mask = np.zeros(_MASK_WORDS, dtype=np.uint64)
        mask[processor // 64] = 1 << (processor % 64)
        grace = round(1e9 * (_GRACE + index * _APART))
        look_out(
            self.orders,
            self._posted[index],
            self._woke[index],
            mask,
            self.descriptor,
            grace,
        )

    @property
    def note(self) -> str:
        """What is in force, in words."""
        if not self._chosen:
            return "nobody looks out for ticks that oversleep: one processor, or no system call"
        names = ", ".join(map(str, self._chosen))
        return f"lookouts on processors {names}"

    def expect(self, seconds: int, nanoseconds: int) -> None:
        """Make this time on the monotonic clock the deadline."""
        orders = self.orders
        orders[SECONDS], orders[NANOSECONDS] = seconds, nanoseconds
        orders[GENERATION] += 1
        for posted in self._posted:
            self._post(posted.ctypes.data)  # type: ignore[misc]

    def release(self) -> None:
        """For the sleeper, when it was fetched: ready for the next time."""
        with contextlib.suppress(BlockingIOError):
            self.fetched += os.eventfd_read(self.descriptor)

    def late_here(self) -> float | None:
        """How late the lookout of the processor we run on got up for the present deadline, s;
        None if it has not, or there is none."""
        if not self._chosen:
            return None
        processor = call("sched_getcpu")()
        if processor not in self._chosen:
            return None
        generation, late = self._woke[self._chosen.index(processor)].tolist()
        return 1e-9 * late if generation and generation == self.orders[GENERATION] else None

    def first_awake(self) -> float:
        """How long after the present deadline the first lookout was up, s; inf if none is yet."""
        grace = _GRACE + _APART * np.arange(len(self._woke))
        noted = self._woke[:, 0] == self.orders[GENERATION]
        return float(np.min((1e-9 * self._woke[:, 1] + grace)[noted], initial=np.inf))

    def close(self) -> None:
        """Let the lookouts go. Idempotent."""
        if self._closed:
            return
        self._closed = True
        self.orders[STOP] = 1
        for posted in self._posted:
            self._post(posted.ctypes.data)  # type: ignore[misc]
        for thread in self._threads:
            thread.join()
        os.sched_setaffinity(0, self._processors)
        os.close(self.descriptor)
