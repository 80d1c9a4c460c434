"""Level files: their schema, the shipped levels, the random draws.

Importing this package costs pydantic and PyYAML only; :mod:`crazyarena.levels.draw` and
:mod:`crazyarena.levels.contract` bring numpy and munch, and are imported by those who need them.
"""

from crazyarena.levels.load import dump_level, load_arena, load_level, shipped_levels
from crazyarena.levels.schema import (
    Arena,
    Disturbances,
    Gate,
    GateType,
    Goal,
    KeepOut,
    Level,
    Obstacle,
    Profile,
    Randomization,
    RngKind,
    Shape,
    ShapeKind,
    Start,
    Track,
)

__all__ = [
    "Arena",
    "Disturbances",
    "Gate",
    "GateType",
    "Goal",
    "KeepOut",
    "Level",
    "Obstacle",
    "Profile",
    "Randomization",
    "RngKind",
    "Shape",
    "ShapeKind",
    "Start",
    "Track",
    "dump_level",
    "load_arena",
    "load_level",
    "shipped_levels",
]
