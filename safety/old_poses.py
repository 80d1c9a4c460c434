"""Tells a pose that was measured from one that was measured before."""

from __future__ import annotations

import numpy as np

from crazyarena.types import Pose

# What a hovering vehicle moves and cameras' noise adds from one frame to the next is more.
_STILL = 2e-5  # m
_STILL_TURN = 1e-4  # of a quaternion's parts


def repeats(last: Pose, pose: Pose, flying: bool) -> bool:
    """Whether ``pose`` is ``last`` again: to the bit, or, ``flying``, but for some micrometres."""
    if not flying:
        return np.array_equal(last.position, pose.position) and np.array_equal(
            last.quaternion, pose.quaternion, equal_nan=True
        )
    moved = np.abs(last.position - pose.position).max()
    turned = np.abs(last.quaternion - pose.quaternion).max()
    # A pose without attitude (NaN) has only its place.
    return bool(moved <= _STILL and not turned > _STILL_TURN)
