"""How many frames a second a camera system delivers."""

from __future__ import annotations

from collections import deque

_SPAN = 1.0  # s that are looked at
_LEAST = 0.3  # s of frames, until there is an answer


class FrameRate:
    """Counts frames by when they were captured."""

    def __init__(self) -> None:
        self._times: deque[float] = deque()

    def note(self, captured: float) -> None:
        """A frame was captured at ``captured`` s."""
        times = self._times
        if times and captured <= times[-1]:
            if captured < times[-1] - _SPAN:
                times.clear()  # the cameras' clock was set back
            else:
                return
        times.append(captured)
        while captured - times[0] > _SPAN:
            times.popleft()

    @property
    def rate(self) -> float | None:
        """Hz, over the last second of frames; None until there were some."""
        times = self._times
        span = times[-1] - times[0] if times else 0.0
        return (len(times) - 1) / span if span >= _LEAST else None
