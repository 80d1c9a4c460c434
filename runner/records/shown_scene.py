"""What stands still in a flight, as viewers are shown it: plain data, see docs/viewer.md."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyarena.levels.schema import Arena, Level
from crazyarena.runner.records.scene import scene_update

NOMINAL = {"r": 0.55, "g": 0.55, "b": 0.6, "a": 0.3}


def arena_data(arena: Arena) -> dict[str, Any]:
    """The limits of an arena as plain data."""
    return arena.model_dump(mode="json", exclude_none=True)


def nominal_track(level: Level) -> list[dict[str, Any]]:
    """Entities of the track as the level file has it, in a colour of its own."""
    gates = np.array([[*gate.row[:2], gate.centre[2], *gate.row[3:]] for gate in level.track.gates])
    obstacles = np.array([post.row for post in level.track.obstacles])
    entities = scene_update(gates.reshape(-1, 7), obstacles.reshape(-1, 6), level)["entities"]
    for entity in entities:
        for kind in ("cubes", "cylinders"):
            for body in entity[kind]:
                body["color"] = NOMINAL
    return [entity for entity in entities if entity["id"] != "goal"]


def level_scene(
    level: Level,
    gates: NDArray[np.float64],
    obstacles: NDArray[np.float64],
    vehicles: list[str] | None = None,
) -> dict[str, Any]:
    """Scene of a level whose track truly stands at gates (n, 7) and obstacles (m, 6)."""
    return {
        "title": level.name,
        "track": scene_update(gates, obstacles, level)["entities"],
        "nominal": nominal_track(level),
        "arena": arena_data(level.arena),
        "start": list(level.start.position),
        "gates": len(level.track.gates),
        "vehicles": vehicles or [],
    }
