"""How far out of the arena a vehicle gets in a flight of the fault campaign."""

from __future__ import annotations

import math

from crazyarena.safety.fence import Fence
from crazyarena.types import VehicleState

_LYING = 0.12  # m, height of a vehicle that lies on the ground, whichever way up
_SLIDING = 2.0 * 0.5 * 9.81  # m/s2: twice friction times gravity


class Excursion:
    """Follows one vehicle; see :attr:`worst`.

    Once it has come down with its motors off, it is let slide to rest by friction (0.5). The
    simulated body is a cylinder, which on its side would roll for many metres; arms do not.

    Attributes
    ----------
    worst: m, furthest beyond the hard fence's walls and ceiling so far; negative: inside.
    lies: it lies on the ground with its motors off.
    """

    def __init__(self, fence: Fence) -> None:
        self._fence = fence
        low, high = fence.bounds
        self._middle = 0.5 * (low[2] + high[2])
        self.worst = -math.inf
        self.lies = False

    def see(self, state: VehicleState, motors_off: bool) -> None:
        """Take note of a true state."""
        x, y, z = state.position.tolist()
        if not (motors_off and z < _LYING):
            self.lies = False
            self._reach(x, y, z)
        elif not self.lies:
            self.lies = True
            vx, vy, _ = state.velocity.tolist()
            slide = math.hypot(vx, vy) / _SLIDING
            self._reach(x, y, z)
            self._reach(x + slide * vx, y + slide * vy, z)

    def _reach(self, x: float, y: float, z: float) -> None:
        # The ground is close to a box's bottom, and stops a vehicle by itself.
        self.worst = max(self.worst, -self._fence.clearance(x, y, max(z, self._middle)))
