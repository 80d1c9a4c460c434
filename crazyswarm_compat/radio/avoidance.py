"""Collision avoidance on board, as the parameters that switch it."""

from __future__ import annotations

from collections.abc import Callable

from crazyarena.crazyswarm_compat.commands import CollisionAvoidance
from crazyarena.errors import BackendError

AVOIDANCE_SWITCH = "colAv.enable"
_EVERYWHERE = 1e6  # m, of a box without bounds


def avoidance_params(
    m: CollisionAvoidance, has: Callable[[str], bool], who: str
) -> list[tuple[str, float]]:
    """Parameters ``group.name`` and values, in the order to write them: the switch is last, so
    that no vehicle avoids with numbers that it had before.

    ``has`` says which parameters vehicle ``who`` has; BackendError if it cannot avoid collisions.
    """
    if not has(AVOIDANCE_SWITCH):
        if m.enable:
            raise BackendError(
                f"{who}: its firmware was built without collision avoidance (colAv.*)"
            )
        return []
    switch = (AVOIDANCE_SWITCH, int(m.enable))
    if not m.enable:
        return [switch]
    wanted: list[tuple[str, float]] = []
    for axis, name in enumerate("XYZ"):
        wanted += [
            (f"colAv.ellipsoid{name}", float(m.radii[axis])),
            (f"colAv.bboxMin{name}", max(float(m.bbox_min[axis]), -_EVERYWHERE)),
            (f"colAv.bboxMax{name}", min(float(m.bbox_max[axis]), _EVERYWHERE)),
        ]
    return [*wanted, ("colAv.horizon", m.horizon), ("colAv.maxSpeed", m.max_speed), switch]
