"""A little push sideways at every take-off, so that there is something to see.

A vehicle that rises straight up shows nothing of how its body is turned (safety/heading.py) until
something else pushes it aside, a metre up. So what the cameras tell the vehicle of its place is
moved by some centimetres to and fro while it lifts off: it tips a degree or two against that, moves
by millimetres, and its gyroscope and the cameras show about which axes. Commands, estimates and
recordings are not touched.

It goes along one axis and then along the other, never round: on a circle a delay between cameras
and gyroscope looks like a turn.
"""

from __future__ import annotations

import math

_PERIOD = 0.4  # s, to and fro; slower moves the vehicle more and tips it less


class Nudge:
    """For one vehicle.

    Parameters
    ----------
    size: m, by which its place is moved at most; 0 for never.
    """

    def __init__(self, size: float) -> None:
        self._size = size
        self._begun: float | None = None
        self._times = 0

    def shift(self, now: float, needed: bool) -> tuple[float, float]:
        """What to add to x and y of the pose that the vehicle is told now, m.

        It begins and ends at zero: one that is no longer needed is brought to its end.
        """
        if self._begun is None:
            if not needed or not self._size:
                return 0.0, 0.0
            self._begun, self._times = now, 0
        phase = (now - self._begun) / _PERIOD
        if int(phase) != self._times:
            self._times = int(phase)
            if not needed:
                self._begun = None
                return 0.0, 0.0
        shift = self._size * math.sin(math.tau * phase)
        return (shift, 0.0) if self._times % 2 == 0 else (0.0, shift)
