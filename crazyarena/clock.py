"""The one clock of the flight path.

Nothing in the flight path calls :func:`time.time` or :func:`time.sleep`: it is handed a
:class:`Clock`. A :class:`VirtualClock` runs as fast as the simulation it drives; a
:class:`WallClock` waits for absolute deadlines, so a loop over ``t0 + k / rate`` never drifts.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Protocol, runtime_checkable


@runtime_checkable
class Clock(Protocol):
    """Seconds on a monotonic time line that starts at 0 when the clock is made."""

    def now(self) -> float:
        """Return the present time in seconds."""
        ...

    def sleep_until(self, deadline: float) -> float:
        """Wait until ``deadline`` (s) and return how late the wake-up was (s, >= 0)."""
        ...


class WallClock:
    """Monotonic wall time. Safe to share between threads.

    Parameters
    ----------
    origin: :func:`time.monotonic` at which the clock shows 0; now by default. Processes of one
        machine that are given the same origin share the clock.
    """

    def __init__(self, origin: float | None = None) -> None:
        self.origin = time.monotonic() if origin is None else origin

    def now(self) -> float:
        return time.monotonic() - self.origin

    def sleep_until(self, deadline: float) -> float:
        remaining = deadline - self.now()
        if remaining > 0:
            time.sleep(remaining)
        return max(0.0, self.now() - deadline)


class VirtualClock:
    """Time that passes only when somebody waits for it.

    Simulations register with :meth:`on_advance`; ``sleep_until`` calls each of them, in the
    order of registration, with the new time before it returns. Whoever must not miss a moment
    in between names it with :meth:`stop_at`.
    """

    def __init__(self) -> None:
        self._now = 0.0
        self._advance: list[Callable[[float], None]] = []
        self._next: list[Callable[[], float]] = []
        self._lock = threading.RLock()

    def now(self) -> float:
        return self._now

    def on_advance(self, advance: Callable[[float], None]) -> Callable[[], None]:
        """Register ``advance(new_time)``; call the returned function to unregister it."""
        self._advance.append(advance)
        return lambda: self._advance.remove(advance)

    def stop_at(self, next_event: Callable[[], float]) -> Callable[[], None]:
        """Stop at ``next_event()`` (s) on every way past it; returns what unregisters."""
        self._next.append(next_event)
        return lambda: self._next.remove(next_event)

    def sleep_until(self, deadline: float) -> float:
        with self._lock:
            while self._now < deadline:
                coming = min(event() for event in self._next) if self._next else deadline
                self._now = coming if self._now < coming < deadline else deadline
                for advance in self._advance:
                    advance(self._now)
            return 0.0
