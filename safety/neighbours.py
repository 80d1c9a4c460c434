"""How close two vehicles are, and will be if both are told to stop now."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence

from crazyarena.safety.limits import Limits
from crazyarena.safety.observation import Observation, Point
from crazyarena.safety.stopping import stopping_path

_SHARES = (0.25, 0.5, 0.75, 1.0)
_BESIDE = 0.4  # m, horizontally, from which on one comes down beside another and its wash
_APART = 0.55  # m, where a place beside another is looked for
_LEVEL = 0.1  # m, by which one may be higher and still be in the way down
_WAYS = 16  # directions in which such a place is looked for


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


def in_the_way_down(own: Observation, others: Iterable[Observation]) -> tuple[Point, ...]:
    """Places, m, of the others that one who comes down here would come down on or beside.

    Whether they fly or stand: who was taken in the air above another lands after it.
    """
    if own.position is None or not own.airborne:
        return ()
    x, y, z = own.position
    return tuple(
        other.position
        for other in others
        if other.position is not None
        and other.position[2] <= z + _LEVEL
        and math.dist(other.position[:2], (x, y)) < _BESIDE
    )


def beside(place: Point, others: Sequence[Point], within: Callable[[Point], Point]) -> Point | None:
    """The nearest place, m, at this height from which the way down is free of ``others``.

    ``within`` moves a place inside the arena. None if there is none around any of them.
    """
    found = []
    for ox, oy, _ in others:
        away = math.atan2(place[1] - oy, place[0] - ox)
        for k in range(_WAYS):
            angle = away + math.tau * k / _WAYS
            x, y, z = ox + _APART * math.cos(angle), oy + _APART * math.sin(angle), place[2]
            there = within((x, y, z))
            if all(math.dist(there[:2], other[:2]) >= _BESIDE for other in others):
                found.append(there)
    return min(found, key=lambda there: math.dist(there, place)) if found else None


def _way(obs: Observation, limits: Limits) -> list[Point]:
    """Places on the way to a stop; the first is where braking begins."""
    begin, end = stopping_path(obs, limits)
    way = [begin]
    for share in _SHARES:
        x, y, z = (a + share * (b - a) for a, b in zip(begin, end, strict=True))
        way.append((x, y, z))
    return way
