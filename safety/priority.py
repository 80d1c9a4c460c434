"""The watchdog's thread comes before others."""

from __future__ import annotations

import os
import threading


def raise_priority() -> str:
    """Move the calling thread in front of ordinary ones; returns what the system granted."""
    thread = threading.get_native_id()
    try:
        os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(50))
        return "real-time"
    except (OSError, AttributeError):
        pass
    try:
        os.setpriority(os.PRIO_PROCESS, thread, -15)
        return "raised"
    except (OSError, AttributeError):
        return "normal"
