"""Waiting for what happens by itself, in another thread or process."""

from __future__ import annotations

import time
from collections.abc import Callable

PATIENCE = 6.0
"""How many times longer than on an idle machine anything may take; it costs only what fails."""


def eventually(holds: Callable[[], object], timeout: float = 20.0) -> None:
    """Wait until ``holds()``; fails the test after ``timeout`` s of an idle machine."""
    deadline = time.monotonic() + PATIENCE * timeout
    while not holds():
        assert time.monotonic() < deadline, "did not happen in time"
        time.sleep(0.01)
