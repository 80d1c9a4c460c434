"""Waiting for what happens by itself, in another thread or process."""

from __future__ import annotations

import time
from collections.abc import Callable


def eventually(holds: Callable[[], object], timeout: float = 20.0) -> None:
    """Wait until ``holds()``; fails the test after ``timeout`` s."""
    deadline = time.monotonic() + timeout
    while not holds():
        assert time.monotonic() < deadline, "did not happen in time"
        time.sleep(0.01)
