"""Thrust that a vehicle needs to be upright, and heights that leave it so much.

Rotors at their limits cannot steer: at full thrust nothing is left to stop a turn, without thrust
nothing begins one. What a controller makes of a setpoint's height is told by
:mod:`~crazyarena.safety.flight_model`; of controllers that follow places only, not their velocity,
it is bounded on board.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from crazyarena.safety.flight_model import GRAVITY, FlightModel

# rad/s and cosine of a tilt, above which a vehicle needs its motors to be upright; what it may be
# asked to climb with then, of what they have over the weight (racers ask for all of it at times).
_TIPS, _LEANS, _AMPLE = 2.0, 0.9, 1.5
LEAST_LIFT = 0.4  # of the weight, that keeps rotors turning
CALM_LIFT = 0.25  # and of one that is upright and does not tip


def tipping(rates: Sequence[float]) -> float:
    """rad/s about roll and pitch, of body rates (3,)."""
    return math.hypot(float(rates[0]), float(rates[1]))


def is_busy(upright: float, rate: float) -> bool:
    """Whether it leans (cosine of the tilt) or tips (rad/s), and needs its motors for that."""
    return rate > _TIPS or upright < _LEANS


def highest(
    model: FlightModel, height: float, climb: float, place: float, velocity: float, push: float
) -> float:
    """Height, m, up to ``place``, that a busy vehicle may be told.

    ``height`` m and ``climb`` m/s are its own; ``velocity``, ``push`` (m/s2) those of the setpoint.
    """
    if not model.follows_velocity:
        return place
    spare, stiffness = GRAVITY * (model.lift - 1.0), model.stiffness[2]
    taken = model.feed[2] * push + model.damping[2] * (velocity - climb)
    level = height - model.floats
    if taken + stiffness * (place - level) <= _AMPLE * spare:
        return place
    return min(place, level + (spare - taken) / stiffness)


def lowest(
    model: FlightModel,
    height: float,
    climb: float,
    place: float,
    velocity: float,
    push: float,
    least: float = LEAST_LIFT,
) -> float:
    """Height, m, from ``place`` on, that any vehicle may be told whose rotors are to lift
    ``least`` of its weight."""
    if not model.follows_velocity:
        return place
    taken = model.feed[2] * push + model.damping[2] * (velocity - climb)
    falls = (least - 1.0) * GRAVITY
    return max(place, height - model.floats + (falls - taken) / model.stiffness[2])
