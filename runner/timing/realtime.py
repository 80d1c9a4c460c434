"""What keeps ticks free of delays, piece by piece: all of it is put together in ``steady``.

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
# Of mallopt(3), with the C library's defaults.
_TRIM_THRESHOLD, _MMAP_MAX = -1, -4
_USUAL_TRIM_THRESHOLD, _USUAL_MMAP_MAX = 128 * 1024, 65536
_DMA_LATENCY = "/dev/cpu_dma_latency"
_SWITCH_INTERVAL = 0.0005  # s
# Priorities of real-time threads, all below the watchdog's: what serves a tick, what ticks (for a
# moment, and rarely), and what looks out for it.
SERVING, TICKING, LOOKING_OUT = 40, 41, 42


def lock_memory() -> str:
    """Lock this process's memory and give none of it back; returns what came of it, in words.

    Memory that is mapped and unmapped again costs page faults, and the kernel interrupts all
    processors of the process each time.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    if hasattr(libc, "mallopt"):
        libc.mallopt(_MMAP_MAX, 0)
        libc.mallopt(_TRIM_THRESHOLD, -1)
    if libc.mlockall(_CURRENT | _FUTURE | _ON_FAULT) == 0:
        return "memory locked"
    reason = os.strerror(ctypes.get_errno())
    return (
        f"memory not locked ({reason}): page faults may delay ticks. "
        "Raise the limit: ulimit -l unlimited, or memlock in /etc/security/limits.conf"
    )


def unlock_memory() -> None:
    """Undo :func:`lock_memory`."""
    libc = ctypes.CDLL(None)
    libc.munlockall()
    if hasattr(libc, "mallopt"):
        libc.mallopt(_MMAP_MAX, _USUAL_MMAP_MAX)
        libc.mallopt(_TRIM_THRESHOLD, _USUAL_TRIM_THRESHOLD)


def raise_priority(priority: int, inherit: bool = False) -> str:
    """Schedule the calling thread in real time; returns what came of it, in words.

    What it starts from now on is scheduled as usual, or likewise with ``inherit``.
    """
    try:
        policy = os.SCHED_FIFO if inherit else os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
        os.sched_setscheduler(0, policy, os.sched_param(priority))
    except (OSError, AttributeError) as error:
        return (
            f"ordinary scheduling ({error}): other programs may delay ticks. "
            "Allow it: rtprio 50 for this user in /etc/security/limits.conf"
        )
    return f"SCHED_FIFO {priority}"


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
