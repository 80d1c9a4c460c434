"""The line of the checklist that says whether the gates can be flown through."""

from __future__ import annotations

from collections.abc import Mapping

from crazyarena.safety.placement import nominal_track, obstructions
from crazyarena.safety.preflight import Line, Preflight
from crazyarena.types import Pose

NAME = "gates free"


def gates_free(p: Preflight, measured: Mapping[str, Pose] | None = None) -> list[Line]:
    """Whether something stands in a gate's opening, or a gate has no room to the fence.

    By ``measured`` poses of an earlier survey, else by where the cameras see things now; nominal
    where neither says anything. None for a level without gates.
    """
    if not p.level.track.gates:
        return []
    parts = nominal_track(p.level)
    where = {name: pose for name, pose in (measured or p.poses).items() if name in parts}
    problems = obstructions(p.level, where)
    found = "; ".join(problems) or f"{len(p.level.track.gates)} gates, nothing in their openings"
    return [Line(NAME, not problems, found, "clear the opening, then measure the track again")]
