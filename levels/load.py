"""Level files to :class:`~crazyarena.levels.schema.Level`, with errors that name the line."""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence
from pathlib import Path

import yaml

from crazyarena.errors import InputError
from crazyarena.levels import competition
from crazyarena.levels.document import Node, read
from crazyarena.levels.fields import assign, assignment, validate
from crazyarena.levels.schema import Arena, ArenaFile, Level

_FOLDER = Path(__file__).parent


def shipped_levels() -> tuple[str, ...]:
    """Names that :func:`load_level` knows without a path."""
    return tuple(sorted(path.stem for path in _FOLDER.glob("*.yaml")))


def load_level(name_or_path: str | Path, overrides: Sequence[str] = ()) -> Level:
    """Load a shipped level by name, or a level file in our format or the competition's.

    Parameters
    ----------
    name_or_path: ``level0`` ... ``level3``, ``getting_started``, ``sim2real``, or a path.
    overrides: ``a.b=value`` with the value in YAML; list members as ``a[2].b`` or ``a.2.b``.
        Paths are those of our format; on a competition file also those of the file.

    Raises
    ------
    InputError: naming file, line, column, field, what was found and what is allowed.
    """
    path, root = _read(name_or_path)
    assignments = [assignment(override) for override in overrides]
    foreign = competition.is_competition(root)
    if foreign:
        for keys, value in assignments:
            if competition.owns(str(keys[0])):
                root = assign(root, keys, value)
        root = competition.convert(root)
    for keys, value in assignments:
        if not (foreign and competition.owns(str(keys[0]))):
            root = assign(root, keys, value)
    if "name" not in root.value:
        stem = re.sub(r"[^A-Za-z0-9_.-]", "_", path.stem).lstrip("_.-")[:64] or "level"
        root = assign(root, ["name"], Node(stem, "name", root.source))
    return validate(root, Level)


def load_arena(name_or_path: str | Path) -> tuple[Arena, Level | None]:
    """Load the arena of a level (see :func:`load_level`), or of a file with nothing but an
    ``arena``; the level is None for the latter.

    Raises
    ------
    InputError: as :func:`load_level`.
    """
    _, root = _read(name_or_path)
    if "arena" in root.value and set(root.value) <= set(ArenaFile.model_fields):
        return validate(root, ArenaFile).arena, None
    level = load_level(name_or_path)
    return level.arena, level


def _read(name_or_path: str | Path) -> tuple[Path, Node]:
    text = str(name_or_path)
    if text in shipped_levels():
        path, shown = _FOLDER / f"{text}.yaml", f"{text}.yaml"
    else:
        path, shown = _existing(text), text
    root = read(path, shown)
    if root.value is None:
        root.fail("the file is empty; expected a level (see docs/levels.md)")
    if not isinstance(root.value, dict):
        root.expected("a level as a mapping of fields")
    return path, root


def dump_level(level: Level) -> str:
    """YAML text of a level with every field written out; loads back as an equal level."""
    data = level.model_dump(mode="json")
    if level.vehicle.model is None:
        # As levels without a model were always written: recordings hold this text.
        for name in ("model", "spread"):
            if not data["vehicle"][name]:
                del data["vehicle"][name]
    return yaml.safe_dump(data, sort_keys=False, default_flow_style=None)


def _existing(text: str) -> Path:
    if text.startswith("lsy/") or text.endswith(".toml"):
        raise InputError(
            f"{text}: levels of lsy_drone_racing (lsy/level0 ... lsy/level3, TOML files) are flown "
            "by dry-run, evaluate, bench and fly, with its controllers. Pass one of "
            f"{', '.join(shipped_levels())}, or a YAML file"
        )
    path = Path(text)
    try:
        if path.exists():
            return path
    except (OSError, ValueError):
        pass
    names = shipped_levels()
    bare = text.removesuffix(".yaml").removesuffix(".yml")
    close = [bare] if bare in names else difflib.get_close_matches(text, names, n=1)
    hint = f"; did you mean '{close[0]}'?" if close else ""
    shown = text if len(text) <= 200 else text[:197] + "..."
    raise InputError(f"{shown}: no such level file (shipped levels: {', '.join(names)}){hint}")
