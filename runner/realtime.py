"""Keeps the runner's own ticks free of what would delay them.

The collector is frozen and off, memory is locked (no page faults), the control thread runs in
front of ordinary ones, and processors stay awake; the last three as far as the system allows.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import sys
from collections.abc import Iterator

_CURRENT, _FUTURE, _ON_FAULT = 1, 2, 4
_DMA_LATENCY = "/dev/cpu_dma_latency"
_SWITCH_INTERVAL = 0.0005  # s
PRIORITY = 40  # below the watchdog's


def lock_memory() -> str:
    """Lock this process's memory; returns what came of it, in words."""
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(_CURRENT | _FUTURE | _ON_FAULT) == 0:
        return "memory locked"
    reason = os.strerror(ctypes.get_errno())
    return (
        f"memory not locked ({reason}): page faults may delay ticks. "
        "Raise the limit: ulimit -l unlimited, or memlock in /etc/security/limits.conf"
    )


def unlock_memory() -> None:
    """Undo :func:`lock_memory`."""
    ctypes.CDLL(None).munlockall()


def raise_priority(inherit: bool = False) -> str:
    """Schedule the calling thread in real time; returns what came of it, in words.

    What it starts from now on is scheduled as usual, or likewise with ``inherit``.
    """
    try:
        policy = os.SCHED_FIFO if inherit else os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
        os.sched_setscheduler(0, policy, os.sched_param(PRIORITY))
    except (OSError, AttributeError) as error:
        return (
            f"ordinary scheduling ({error}): other programs may delay ticks. "
            "Allow it: rtprio 50 for this user in /etc/security/limits.conf"
        )
    return f"SCHED_FIFO {PRIORITY}"


def is_raised() -> bool:
    """Whether the calling thread is scheduled in real time."""
    with contextlib.suppress(OSError, AttributeError):
        return os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO
    return False


def lower_priority() -> None:
    """Undo :func:`raise_priority`."""
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


@contextlib.contextmanager
def wide_awake() -> Iterator[str]:
    """Keep processors from falling asleep inside the ``with`` block; yields what came of it.

    Waking one up takes longer than anything we do in a tick, most of all in a virtual machine.
    The kernel's quality-of-service interface holds as long as the file is open
    (Documentation/power/pm_qos_interface).
    """
    with contextlib.ExitStack() as stack:
        note = "processors stay awake"
        try:
            file = stack.enter_context(open(_DMA_LATENCY, "wb", buffering=0))
            file.write(bytes(4))  # us, as int32: none at all
        except OSError as error:
            note = (
                f"processors may fall asleep ({error.strerror}): waking them delays ticks. "
                f"Allow it: make {_DMA_LATENCY} writable for this user"
            )
        yield note


@contextlib.contextmanager
def quiet_collector() -> Iterator[None]:
    """No garbage collection inside the ``with`` block, and cheap ones after it; other threads
    give way sooner."""
    gc.collect()
    gc.freeze()
    gc.disable()
    interval = sys.getswitchinterval()
    sys.setswitchinterval(min(interval, _SWITCH_INTERVAL))
    try:
        yield
    finally:
        sys.setswitchinterval(interval)
        gc.enable()
        gc.unfreeze()


@contextlib.contextmanager
def steady() -> Iterator[list[str]]:
    """Lock memory, raise the priority and keep processors awake inside the ``with`` block.

    Yields what is in force.
    """
    notes = [lock_memory(), raise_priority()]
    try:
        with wide_awake() as note:
            yield [*notes, note]
    finally:
        lower_priority()
        unlock_memory()
