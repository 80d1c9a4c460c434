"""The level that a recording carries."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache

from crazyarena.errors import CrazyarenaError
from crazyarena.levels.document import parse
from crazyarena.levels.fields import validate
from crazyarena.levels.schema import Level


def recorded_level(metadata: Mapping[str, str]) -> Level | None:
    """The level as the recording has it; None for one of another contract or another time."""
    text = metadata.get("level_file", "")
    if not text or text.lstrip().startswith("{"):
        return None
    return _level(text)


@lru_cache(maxsize=8)  # the flights of a run carry the same
def _level(text: str) -> Level | None:
    try:
        return validate(parse(text, "level_file"), Level)
    except CrazyarenaError:
        return None
