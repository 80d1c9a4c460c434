"""Air time: packets per second that the vehicles of one radio share."""

from __future__ import annotations

import math
import threading


class Budget:
    """Token bucket over the packets of one radio, in seconds of the session clock.

    Parameters
    ----------
    rate: packets per second, ``inf`` for links that need no budget.
    burst: packets that may follow each other at once.
    """

    def __init__(self, rate: float = math.inf, burst: float = 20.0) -> None:
        if not rate > 0 or not burst >= 1:
            raise ValueError(f"budget of {rate} packets/s with bursts of {burst}: must be > 0")
        self.rate = rate
        self.burst = burst
        self._tokens = burst
        self._filled = 0.0
        self._lock = threading.Lock()

    def _fill(self, now: float) -> None:
        if now > self._filled:
            self._tokens = min(self.burst, self._tokens + self.rate * (now - self._filled))
            self._filled = now

    def spend(self, now: float) -> None:
        """Account for one packet that went out, whoever sent it. What must go out goes out:
        the debt is limited to one burst."""
        if math.isinf(self.rate):
            return
        with self._lock:
            self._fill(now)
            self._tokens = max(self._tokens - 1.0, -self.burst)

    def wait(self, now: float, reserve: float) -> float:
        """Seconds until a packet may go that leaves the share ``reserve`` (0..1) of a burst to
        more urgent ones; 0 for at once."""
        if math.isinf(self.rate):
            return 0.0
        with self._lock:
            self._fill(now)
            missing = 1.0 + reserve * (self.burst - 1.0) - self._tokens
        return max(0.0, missing / self.rate)
