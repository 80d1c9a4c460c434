"""What becomes of a vehicle whose streamed setpoints fell silent."""

from __future__ import annotations

import numpy as np

from crazyarena.crazyswarm_compat import commands as c
from crazyarena.types import VehicleState

_LOW = 0.15  # m; below it lands
_BRAKING = 2.0  # m/s2


def until_told(state: VehicleState | None) -> tuple[str, c.Land | c.GoTo]:
    """What a vehicle does that flies and is told nothing: ``land`` or ``hold``, and how."""
    if state is not None and state.position[2] < _LOW:
        return "land", c.Land(0.0, 1.0)
    velocity = np.zeros(3) if state is None else state.velocity
    speed = float(np.linalg.norm(velocity))
    duration = min(3.0, max(0.5, 2.0 * speed / _BRAKING))
    # Half of the way at the present speed is the way of constant braking.
    return "hold", c.GoTo(0.5 * duration * velocity, 0.0, duration, True)
