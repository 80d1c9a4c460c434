"""Whether the time stamps of the cameras can be true."""

from __future__ import annotations

from collections import deque

_BASELINE_TIME = 2.0  # s, over which the least delay of the cameras is remembered


class CameraClock:
    """Notices that the cameras' time stamps have jumped ahead.

    A frame cannot arrive faster than the fastest of the last seconds did, but for the jitter.
    A jump back looks like growing delay, and is found as stale poses.
    """

    def __init__(self) -> None:
        self._recent: deque[tuple[float, float]] = deque()
        self.error = 0.0

    def update(self, captured: float, received: float) -> None:
        delay = received - captured
        recent = self._recent
        while recent and recent[0][0] < received - _BASELINE_TIME:
            recent.popleft()
        self.error = max(0.0, recent[0][1] - delay, -delay) if recent else max(0.0, -delay)
        # Delays in ascending order: what is later and smaller makes the earlier ones obsolete.
        while recent and recent[-1][1] >= delay:
            recent.pop()
        recent.append((received, delay))
