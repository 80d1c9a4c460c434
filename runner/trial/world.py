"""What a trial needs of the world it flies in; simulation and reality differ behind this."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from crazyarena.clock import Clock
from crazyarena.crazyswarm_compat.commands import Command


class World(Protocol):
    """One vehicle on a track."""

    @property
    def clock(self) -> Clock:
        """Advancing it (``sleep_until``) lets the world happen."""
        ...

    def send(self, command: Command) -> None:
        """Take a command; raises CommandError for one that the vehicle could not execute."""
        ...

    def reset(self, draw: Any) -> None:
        """Put the vehicle and the track where ``draw`` says; the episode's time is 0."""
        ...

    def poll(self) -> NDArray[np.float64]:
        """Rows (k, TRACE_SIZE) of the ticks since the last call, oldest first."""
        ...

    def motor_forces(self) -> NDArray[np.float64]:
        """(4,) rotor forces (N) the firmware asked for last; NaN where nobody knows them."""
        ...

    def close(self) -> None:
        """Release what the world holds; idempotent."""
        ...
