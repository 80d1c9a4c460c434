"""How often a body comes, counted in frames of its source: every one, every second, ...

A tracker of 50 Hz beside others of 100 Hz misses nothing; a body of cameras that comes in every
second frame by chance does. Counting frames tells them apart without any jitter of arrival.
"""

from __future__ import annotations

from collections import Counter


class Cadence:
    """Strides of one body: frames from one sight to the next.

    ``first`` is the index of the frame in which it was first seen (0 is the first of all).
    """

    def __init__(self, first: int) -> None:
        self._first = first
        self._last = first
        self._strides: Counter[int] = Counter()
        self.seen = 1

    def note(self, index: int) -> int:
        """Count a sight in frame ``index``; return the stride."""
        stride = index - self._last
        self._last = index
        self._strides[stride] += 1
        self.seen += 1
        return stride

    @property
    def period(self) -> int:
        """Frames from one sight to the next when nothing is missed (20th percentile)."""
        wanted = 0.2 * sum(self._strides.values())
        for stride in sorted(self._strides):
            wanted -= self._strides[stride]
            if wanted <= 0.0:
                return max(1, stride)
        return 1

    def missing(self, frames: int) -> int:
        """Sights that did not happen in the first ``frames`` frames."""
        period = self.period
        gaps = sum(
            count * max(0, round(stride / period) - 1) for stride, count in self._strides.items()
        )
        return self._first // period + gaps + max(0, frames - 1 - self._last) // period
