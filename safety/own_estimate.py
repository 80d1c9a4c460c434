"""What a watchdog is blind to when it knows of a vehicle only what the vehicle says of itself."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from crazyarena.crazyswarm_compat.positioning import Positioning, positioning
from crazyarena.mocap.onboard import Certainty, certainty
from crazyarena.safety.events import Action, SafetyEvent

UNCHECKED = "wrong_body, body_turned, yaw_apart, body_swap, person_near, person_inside, strangers"
_DETAIL = (
    f"the poses are the vehicle's own estimate: not checked are {UNCHECKED}; fence, speed and "
    "following hold for where it believes to be"
)


@dataclass(frozen=True, slots=True)
class OwnEstimate:
    """How a vehicle without cameras knows its place, and when it is believed."""

    decks: Positioning
    certainty: Certainty

    @classmethod
    def of(cls, get_param: Callable[[str], float], options: Mapping[str, Any]) -> OwnEstimate:
        """Of a vehicle whose parameters ``get_param`` reads (BackendError for one it lacks), with
        the limits of ``--mocap-option``."""
        decks = positioning(get_param)
        return cls(decks, certainty(decks.relative, options))


def not_watched(time: float, vehicle: int) -> SafetyEvent:
    """The event that says so, at the beginning."""
    nothing = math.nan
    return SafetyEvent(
        "own_estimate", Action.WARN, nothing, nothing, Action.NONE, time, vehicle, _DETAIL
    )
