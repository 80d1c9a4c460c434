"""Which way up the cameras' world is, from bodies whose place is known.

A stream in Motive's default axes (y up) has every vehicle that stands on the floor at a small y,
and one that stands turned looks tipped over. Both are seen before anything flies.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from crazyarena.mocap.frames import Convention
from crazyarena.types import Pose

CANDIDATES = ("z-up", "y-up")
# A body that stands on level ground leans no further than this, rad.
_UPRIGHT = math.radians(15.0)
# How near its known place a body is when the axes are right, m, and how much farther away the
# present axes must put it before they are called wrong.
_NEAR, _MARGIN = 0.5, 0.3


def _tilt(pose: Pose) -> float:
    x, y, _, _ = pose.quaternion.tolist()
    return math.acos(min(1.0, max(-1.0, 1.0 - 2.0 * (x * x + y * y))))


def recognised_axes(
    bodies: Mapping[str, Pose], places: Mapping[str, np.ndarray] | None = None
) -> str | None:
    """Name the axes that the stream has, if they are not ours; None when nothing speaks for it.

    Parameters
    ----------
    bodies: poses of bodies that stand upright, as they arrive, by name.
    places: where some of them are known to be, (3,) each, m, in our world.

    The axes of another convention are named only if they put every body of known place within
    0.5 m of it and all bodies upright, and ours do not.
    """
    if not bodies:
        return None
    known = places or {}
    ours = _misfit("z-up", bodies, known)
    for axes in CANDIDATES[1:]:
        theirs = _misfit(axes, bodies, known)
        if not (theirs.far <= _NEAR and theirs.lean <= _UPRIGHT):
            continue
        if ours.lean > _UPRIGHT or ours.far > max(_NEAR, theirs.far + _MARGIN):
            return axes
    return None


class _Misfit:
    def __init__(self, far: float, lean: float) -> None:
        self.far = far
        self.lean = lean


def _misfit(axes: str, bodies: Mapping[str, Pose], places: Mapping[str, np.ndarray]) -> _Misfit:
    """Largest distance from a known place, m, and largest lean, rad, in these axes."""
    convention = Convention(axes)
    turned = {name: convention.body(name, pose) for name, pose in bodies.items()}
    far = max(
        (
            float(np.linalg.norm(turned[name].position - place))
            for name, place in places.items()
            if name in turned
        ),
        default=0.0,
    )
    return _Misfit(far, max(_tilt(pose) for pose in turned.values()))
