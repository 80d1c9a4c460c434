"""Where a vehicle comes to rest that is told to stop now."""

from __future__ import annotations

import math

from crazyarena.safety.limits import Limits
from crazyarena.safety.observation import Observation, Point


def stopping_path(obs: Observation, limits: Limits) -> tuple[Point, Point]:
    """Where the vehicle is when it begins to brake, and where it comes to rest.

    Until the command bites (``limits.reaction``) it goes on with the acceleration its attitude
    gives it, so that one who brakes already is not taken for one who runs away; then it brakes
    along its velocity with ``limits.braking``.
    """
    assert obs.position is not None
    (x, y, z), (vx, vy, vz) = obs.position, obs.velocity
    ax, ay = obs.horizontal_acceleration(limits.braking)
    t = limits.reaction
    towards_rest = -(vx * ax + vy * ay)
    if towards_rest > 0.0:
        t = min(t, towards_rest / (ax * ax + ay * ay))
    half = 0.5 * t * t
    x, y, z = x + vx * t + ax * half, y + vy * t + ay * half, z + vz * t
    vx, vy = vx + ax * t, vy + ay * t
    stop = math.sqrt(vx * vx + vy * vy + vz * vz) / (2.0 * limits.braking)
    return (x, y, z), (x + vx * stop, y + vy * stop, z + vz * stop)


def pushed_path(obs: Observation, push: Point, limits: Limits) -> tuple[Point, Point]:
    """The same of a vehicle that is told an attitude: until the command to stop has turned it
    round (``limits.attitude_reaction``) it goes on with the acceleration (m/s2) it was told last.
    """
    assert obs.position is not None
    t = limits.attitude_reaction
    half = 0.5 * t * t
    x, y, z = (
        p + v * t + a * half for p, v, a in zip(obs.position, obs.velocity, push, strict=True)
    )
    vx, vy, vz = (v + a * t for v, a in zip(obs.velocity, push, strict=True))
    stop = math.sqrt(vx * vx + vy * vy + vz * vz) / (2.0 * limits.braking)
    return (x, y, z), (x + vx * stop, y + vy * stop, z + vz * stop)
