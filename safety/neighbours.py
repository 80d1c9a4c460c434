"""How close two vehicles are, and will be if both are told to stop now."""

from __future__ import annotations

import math
from collections.abc import Iterable

from crazyarena.safety.limits import Limits
from crazyarena.safety.observation import Observation, Point
from crazyarena.safety.stopping import stopping_path

_SHARES = (0.25, 0.5, 0.75, 1.0)


def nearest(
    own: Observation, others: Iterable[Observation], limits: Limits
) -> tuple[float, float] | None:
    """m to the nearest of the others that fly, now and at the closest of a stop of both.

    None without any. Whoever stands on the ground is an obstacle to nobody who takes off.
    """
    if own.position is None or not own.airborne:
        return None
    way = _way(own, limits)
    found = []
    for other in others:
        if other.position is None or not other.airborne:
            continue
        now = math.dist(own.position, other.position)
        ways = zip(way, _way(other, limits), strict=True)
        found.append((now, min(now, *(math.dist(a, b) for a, b in ways))))
    if not found:
        return None
    return min(now for now, _ in found), min(then for _, then in found)


def _way(obs: Observation, limits: Limits) -> list[Point]:
    """Places on the way to a stop; the first is where braking begins."""
    begin, end = stopping_path(obs, limits)
    way = [begin]
    for share in _SHARES:
        x, y, z = (a + share * (b - a) for a, b in zip(begin, end, strict=True))
        way.append((x, y, z))
    return way
