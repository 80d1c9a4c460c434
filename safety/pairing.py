"""Brings together what cameras saw and what the gyroscope felt at the same moment.

Both arrive late and in bursts when a computer or a link is busy. A pose that is compared with the
rates of another moment shows a vehicle that turns where it does not; so a pose waits until rates
from after it have come, and is compared with what lies between.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from crazyarena.safety.heading import Point, Quaternion
from crazyarena.types import Telemetry

_APART = 0.12  # s between rates, at most, for what lies between them to be known
_LAG = 0.005  # s by which rates are old when they are told: the gyroscope's filter, and the way
_PATIENCE = 0.5  # s that a pose waits
_POSES = 128

Rates = NDArray[np.float64]


class Pairing:
    """For one vehicle; times in s on the session clock, poses and rates in their own order."""

    def __init__(self) -> None:
        self._poses: deque[tuple[float, Point, Quaternion]] = deque(maxlen=_POSES)
        self._before: tuple[float, Rates] | None = None
        self._after: tuple[float, Rates] | None = None

    def reset(self) -> None:
        """Forget everything."""
        self._poses.clear()
        self._before = self._after = None

    def pose(self, time: float, position: Point, attitude: Quaternion) -> None:
        """A pose that was captured at ``time``."""
        self._poses.append((time, position, attitude))

    def told(self, telemetry: Telemetry) -> Iterator[tuple[float, Point, Quaternion, Point]]:
        """What the vehicle tells now; yields the poses whose rates are known by it.

        Yields
        ------
        time, position and attitude of a pose, and the body rates (rad/s) at that time.
        """
        state = telemetry.state
        if state is None:
            return
        time = telemetry.rates_at if telemetry.rates_at is not None else state.timestamp
        time -= _LAG
        if self._after is None or time > self._after[0]:
            self._before, self._after = self._after, (time, state.angular_velocity)
        if self._before is None:
            return
        (t0, w0), (t1, w1) = self._before, self._after
        while self._poses and self._poses[0][0] <= t1:
            at, position, attitude = self._poses.popleft()
            # A gyroscope is never quite still: zeros are those of a vehicle that does not tell.
            if at >= t0 and t1 - t0 <= _APART and w0.any() and w1.any():
                share = (at - t0) / (t1 - t0)
                x, y, z = (w0 + share * (w1 - w0)).tolist()
                yield at, position, attitude, (x, y, z)
        while self._poses and self._poses[-1][0] - self._poses[0][0] > _PATIENCE:
            self._poses.popleft()
