"""A fence and observations for the safety tests."""

from __future__ import annotations

import math
from typing import Any

from crazyarena.safety.fence import Fence, Zone
from crazyarena.safety.guard import Guard
from crazyarena.safety.limits import Limits
from crazyarena.safety.observation import Observation
from crazyarena.safety.shapes import Box, Cylinder

BOX = ((-3.0, -3.0, -0.1), (3.0, 3.0, 2.0))


def fence(**options: Any) -> Fence:
    """The competition's box with a pillar and a stand for people."""
    zones = (
        Zone("pillar", Cylinder(1.0, 1.0, 0.1, 0.0, 1.0), 0.1),
        Zone("stand", Box((-3.0, 2.0, -0.1), (-2.0, 3.0, 2.0)), 0.2, people=True),
    )
    return Fence(BOX, zones=options.pop("zones", zones), **options)


def flying(time: float = 0.0, **changes: Any) -> Observation:
    """A vehicle that hovers in the middle, with everything in order."""
    values: dict[str, Any] = {
        "time": time,
        "active": True,
        "airborne": True,
        "position": (0.0, 0.0, 1.0),
        "pose_age": 0.01,
        "onboard": (0.0, 0.0, 1.0),
        "link_age": 0.02,
        "link_quality": 1.0,
        "battery": 3.8,
        "supervisor": 1 << 1 | 1 << 3 | 1 << 4,
        "setpoint": (0.0, 0.0, 1.0),
        "controller_age": 0.03,
        "lateness": 0.001,
        "clock_error": 0.0,
        "dead_man_age": 0.1,
        "person_distance": 5.0,
        "person_depth": -2.0,
    }
    if "position" in changes and "onboard" not in changes:
        changes["onboard"] = changes["position"]
    if "position" in changes and "setpoint" not in changes:
        changes["setpoint"] = changes["position"]
    values.update(changes)
    return Observation(**values)


def tilted(angle: float) -> tuple[float, float, float, float]:
    """Attitude rolled by ``angle`` rad."""
    return math.sin(angle / 2), 0.0, 0.0, math.cos(angle / 2)


def run(guard: Guard, observations: list[Observation]) -> list[Any]:
    """Feed a guard; returns its events."""
    events = []
    for obs in observations:
        events += guard.update(obs)[1]
    return events


def lasting(seconds: float, **changes: Any) -> list[Observation]:
    """The same observation at 100 Hz for so long."""
    return [flying(0.01 * k, **changes) for k in range(round(seconds * 100) + 1)]


def new_guard(limits: Limits | None = None) -> Guard:
    return Guard(fence(), limits)
