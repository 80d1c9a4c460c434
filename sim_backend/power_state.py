"""The firmware's power management: when it calls a battery low, and when empty."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

ON_BATTERY, LOW, EMPTY = 0, 3, 4  # of pm.state
LOW_VOLTS, EMPTY_VOLTS = 3.2, 3.0
# V above which a lithium cell at rest holds 10, 20 ... 90 % of its charge.
_LEVELS = (3.7, 3.74, 3.77, 3.79, 3.82, 3.87, 3.92, 4.0, 4.1)
_PATIENCE = 5000  # ms under a voltage: a moment of full thrust is no empty battery


class PowerStates:
    """``pm.state`` of every vehicle of a fleet."""

    def __init__(self, vehicles: int) -> None:
        self._above_low = np.zeros(vehicles, dtype=np.int64)
        self._above_empty = np.zeros(vehicles, dtype=np.int64)

    def note(self, tick: int, volts: NDArray[np.float64]) -> None:
        """What the terminals (n,) read at ``tick`` ms."""
        self._above_low[volts >= LOW_VOLTS] = tick
        self._above_empty[volts >= EMPTY_VOLTS] = tick

    def state(self, vehicle: int, tick: int) -> int:
        """``pm.state`` of one vehicle at ``tick`` ms."""
        if tick - self._above_empty[vehicle] > _PATIENCE:
            return EMPTY
        return LOW if tick - self._above_low[vehicle] > _PATIENCE else ON_BATTERY


def battery_level(volts: float) -> int:
    """``pm.batteryLevel``: per cent in steps of ten, by the terminals alone."""
    return 10 * sum(volts > step for step in _LEVELS)
