"""Levels of lsy_drone_racing: their TOML files as they are, and what they draw.

A package of its own beside the schema of the 2022 competition: what is flown there (directed
gates that tilt, poles by their top, noise on the command) has other fields and another order of
draws.
"""

from crazyarena.levels.lsy.load import is_lsy_level, load_lsy_level, lsy_text, shipped_lsy_levels
from crazyarena.levels.lsy.schema import LsyLevel

__all__ = ["LsyLevel", "is_lsy_level", "load_lsy_level", "lsy_text", "shipped_lsy_levels"]
