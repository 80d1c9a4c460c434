"""The log of ``--writecsv``: one file per vehicle, one row per tick."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, TextIO

import numpy as np

HEADER = "t,x,y,z,roll,pitch,yaw"


class CsvLog:
    """Keeps rows ``[t - t0, x, y, z, roll, pitch, yaw]`` (s, m, rad) and writes them as they come.

    Parameters
    ----------
    folder: where ``logcf<id>.csv`` are written; the working directory by default.
    """

    def __init__(self, folder: str | Path = ".") -> None:
        self._folder = Path(folder).resolve()
        self._rows: dict[int, list[list[float]]] = {}
        self._files: dict[int, TextIO] = {}
        self._start: float | None = None

    @property
    def data(self) -> dict[int, np.ndarray]:
        """Rows (n, 7) by vehicle id."""
        return {number: np.array(rows) for number, rows in self._rows.items()}

    def add(self, t: float, crazyflies: Sequence[Any]) -> None:
        """Log the present state of every vehicle at time ``t`` s."""
        if self._start is None:
            self._start = t
        for cf in crazyflies:
            row = [t - self._start, *cf.position(), *cf.rpy()]
            if cf.id not in self._files:
                self._rows[cf.id] = []
                self._files[cf.id] = (self._folder / f"logcf{cf.id}.csv").open("w")
                self._files[cf.id].write(HEADER + "\n")
            self._rows[cf.id].append(row)
            self._files[cf.id].write(",".join(f"{value:.9g}" for value in row) + "\n")

    def close(self) -> None:
        """Write out what is buffered and close the files; idempotent."""
        for file in self._files.values():
            file.close()
