"""The trajectory memory of a vehicle, as uploads have left it."""

from __future__ import annotations

import numpy as np

from crazyarena.crazyswarm_compat.checks import MEMORY_PIECES, PIECE_COLUMNS
from crazyarena.safety.planner import Array


class TrajectoryMemory:
    """The trajectory memory of one vehicle, piece by piece."""

    def __init__(self) -> None:
        self._pieces = np.full((MEMORY_PIECES, PIECE_COLUMNS), np.nan)
        self._writer: list[int | None] = [None] * MEMORY_PIECES
        self._parts: dict[int, range] = {}

    def write(self, ident: int, offset: int, pieces: Array) -> None:
        """Note an upload, as the vehicle stores it: in single precision."""
        part = range(offset, offset + len(pieces))
        self._pieces[part.start : part.stop] = np.asarray(pieces, dtype=np.float32)
        self._writer[part.start : part.stop] = [ident] * len(part)
        self._parts[ident] = part

    def part(self, ident: int) -> range | None:
        """Where a trajectory lies; None if it was never uploaded."""
        return self._parts.get(ident)

    def overwritten_by(self, ident: int) -> int | None:
        """Another trajectory that was uploaded over this one, if any."""
        writers = (self._writer[slot] for slot in self._parts[ident])
        return next((writer for writer in writers if writer != ident), None)

    def read(self, ident: int) -> Array:
        """Pieces (n, 33) that a start of ``ident`` would fly."""
        part = self._parts[ident]
        return self._pieces[part.start : part.stop].copy()
