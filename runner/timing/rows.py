"""Rows of float64 that grow without ever being moved.

A tick must not pay for a copy of everything recorded before it, nor for the page faults of a
new array as long as the old one: rows are kept in blocks, whose pages are touched one by one.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Rows:
    """A growing table.

    Parameters
    ----------
    width: columns. block: rows of one block; what stays within one is never joined up.
    """

    def __init__(self, width: int, block: int) -> None:
        self._width = width
        self._block = block
        self._blocks = [np.empty((block, width))]
        self.count = 0

    def next(self) -> Array:
        """A new row (width,), still to be filled in."""
        block, at = divmod(self.count, self._block)
        if block == len(self._blocks):
            self._add()
        self.count += 1
        row: Array = self._blocks[block][at]
        return row

    def extend(self, rows: Array) -> None:
        """Append (k, width)."""
        while len(rows):
            block, at = divmod(self.count, self._block)
            if block == len(self._blocks):
                self._add()
            n = min(len(rows), self._block - at)
            self._blocks[block][at : at + n] = rows[:n]
            self.count += n
            rows = rows[n:]

    def _add(self) -> None:
        self._blocks.append(np.empty((self._block, self._width)))

    def between(self, first: int, last: int) -> Array:
        """Rows ``first`` (inclusive) to ``last`` (exclusive), at most ``count``."""
        parts = []
        for index in range(first // self._block, -(-last // self._block)):
            start = index * self._block
            parts.append(self._blocks[index][max(first - start, 0) : last - start])
        if len(parts) == 1:
            return parts[0]
        return np.concatenate(parts) if parts else np.empty((0, self._width))

    def take(self, indices: list[int]) -> Array:
        """Rows of these numbers, (len(indices), width)."""
        if not indices:
            return np.empty((0, self._width))
        first = min(indices)
        return self.between(first, max(indices) + 1)[np.array(indices) - first]

    @property
    def rows(self) -> Array:
        """(count, width)."""
        return self.between(0, self.count)
