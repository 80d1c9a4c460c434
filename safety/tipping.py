"""Attitudes of a vehicle that somebody tips by hand, and of the body the cameras see."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from crazyarena.types import Pose


def tipped_body(bodies: Mapping[str, Pose], own: np.ndarray, least: float = 0.2) -> str | None:
    """The one body that is tipped as a vehicle feels it is, while it is tipped by hand.

    ``own`` is the vehicle's own attitude (x, y, z, w); None until it is tipped by ``least`` rad,
    and when no body, or more than one, has that tilt within half of ``least``.
    """
    felt = tilt(own)
    if felt < least:
        return None
    alike = [k for k, pose in bodies.items() if abs(tilt(pose.quaternion) - felt) < 0.5 * least]
    return alike[0] if len(alike) == 1 else None


def nose_between(own: np.ndarray, body: np.ndarray) -> float:
    """rad by which a body's nose lies to the left of its vehicle's, both tipped alike.

    ``own`` and ``body`` are attitudes (x, y, z, w) of the vehicle, by its own sensors, and of the
    body, by the cameras. Both know where up is, each in its own axes; nothing is asked of the
    yaw of either. Only as good as the tilt: an error of attitude counts by 1 / sin(tilt).
    """
    return math.remainder(_leaning(own) - _leaning(body), math.tau)


def _leaning(q: np.ndarray) -> float:
    """Direction of the world's up across the body's own axes, rad."""
    x, y, z, w = q.tolist()
    return math.atan2(2.0 * (y * z + w * x), 2.0 * (x * z - w * y))


def tilt(q: np.ndarray) -> float:
    """Angle, rad, between a body's own up and the world's; quaternion x, y, z, w."""
    x, y, _, _ = q.tolist()
    return math.acos(min(max(1.0 - 2.0 * (x * x + y * y), -1.0), 1.0))


def yaw(q: np.ndarray) -> float:
    """rad, of a quaternion x, y, z, w."""
    x, y, z, w = q.tolist()
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
