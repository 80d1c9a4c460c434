"""Files of lsy_drone_racing to :class:`~crazyarena.levels.lsy.schema.LsyLevel`."""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from crazyarena.errors import InputError
from crazyarena.levels.document import Node, read_text
from crazyarena.levels.fields import assign, assignment, validate
from crazyarena.levels.lsy.schema import PER_DRONE, RACE, LsyLevel
from crazyarena.levels.lsy.toml_document import read_toml

_FOLDER = Path(__file__).parent
_PREFIX = "lsy/"
_OURS = ("rng", "name", "profile")
# Keys that are known, and without influence on a flight here.
_KNOWN = {
    "": {"deploy", "controller", "sim", "env"},
    "deploy": {"real_track_objects", "drones", "return_height_min", "return_height_max"},
    "controller": {"file"},
    "sim": {"render", "camera", "cam_config", "camera_view", "dynamics"},
}
_NO_RACE = (
    "a race of several drones, which crazyarena dry-run flies; single drones (env.id "
    "DroneRacing-v0) are flown here"
)
_NEEDS_ID = "belongs to a race of several drones, which has env.id MultiDroneRacing-v0"


def shipped_lsy_levels() -> tuple[str, ...]:
    """Names that :func:`load_lsy_level` knows without a path: ``lsy/level0`` ..."""
    return tuple(f"{_PREFIX}{path.stem}" for path in sorted(_FOLDER.glob("*.toml")))


def is_lsy_level(name_or_path: str | Path) -> bool:
    """Whether this names a level of lsy_drone_racing: shipped under ``lsy/``, or a TOML file."""
    text = str(name_or_path)
    return text in shipped_lsy_levels() or text.lower().endswith(".toml")


def load_lsy_level(
    name_or_path: str | Path, overrides: Sequence[str] = (), *, race: bool = False
) -> LsyLevel:
    """Load a level of lsy_drone_racing.

    Parameters
    ----------
    name_or_path: ``lsy/level0`` ... ``lsy/level3``, or the path of a TOML file.
    overrides: ``env.seed=7``; besides the file's own fields there are ``rng`` (``pcg64``,
        ``threefry``) and ``profile`` (``successor``, ``arena``).
    race: races of several drones are welcome, and not refused.

    Raises
    ------
    InputError: naming file, line, field, what was found and what is allowed.
    """
    path, shown = _place(name_or_path)
    root = read_toml(path, shown)
    ours = dict[str, Node]()
    for override in overrides:
        keys, value = assignment(override)
        if keys[0] in _OURS and len(keys) == 1:
            ours[str(keys[0])] = value
        else:
            root = assign(root, keys, value)
    _look_for_several(root, race)
    known = Node({k: v for k, v in root.value.items() if k not in _OURS}, "", root.source)
    stem = re.sub(r"[^A-Za-z0-9_.-]", "_", path.stem)
    name = f"lsy-{stem}" if path.parent == _FOLDER else stem
    extra = {
        "name": Node(name, "name", root.source),
        **ours,
        "config": Node(None, "config", root.source),
    }
    tree = Node({**known.value, **extra}, "", root.source)
    tree.value["config"] = _Plain(known.plain(), "config", root.source)
    level = validate(tree, LsyLevel)
    warnings = _unknown(known, LsyLevel) + (_unheeded(known) if level.race else [])
    return level.model_copy(update={"warnings": tuple(warnings)})


def lsy_text(name_or_path: str | Path) -> str:
    """The file of a level as it is; raises InputError if it cannot be read."""
    path, shown = _place(name_or_path)
    return read_text(path, shown)


def _place(name_or_path: str | Path) -> tuple[Path, str]:
    """Where a level's file is, and its name in messages."""
    text = str(name_or_path)
    if text in shipped_lsy_levels():
        return _FOLDER / f"{text.removeprefix(_PREFIX)}.toml", f"{text}.toml"
    path = Path(text)
    if not path.is_file():
        raise InputError(f"{text}: no such level file (shipped: {', '.join(shipped_lsy_levels())})")
    return path, text


class _Plain(Node):
    """A value that stays as it is."""

    def plain(self) -> Any:
        return self.value


def _look_for_several(root: Node, welcome: bool) -> None:
    """Refuse a race where it is not welcome, and what belongs to one where there is none."""
    controller = root.value.get("controller")
    env = root.value.get("env")
    if env is None:
        root.fail("missing; expected a level of lsy_drone_racing", "env")
    if not isinstance(env.value, dict):
        env.expected("a table")
    kind = env.value.get("id")
    racing = kind is not None and isinstance(kind.value, str) and kind.value == RACE
    if racing:
        if not welcome:
            kind.fail(_NO_RACE)
        if "kwargs" not in env.value:
            env.fail("missing; expected a table for each drone", "kwargs")
        return
    if controller is not None and isinstance(controller.value, list):
        controller.fail(_NEEDS_ID)
    if "kwargs" in env.value:
        env.value["kwargs"].fail(_NEEDS_ID)


def _unheeded(root: Node) -> list[str]:
    """A warning for what a race has elsewhere, or only for its first drone."""
    env = root.value["env"].value
    found = [
        f"{env[name].source}: env.{name}: ignored; a race has it in env.kwargs"
        for name in PER_DRONE
        if name in env
    ]
    first, *others = (racer.plain() for racer in env["kwargs"].value)
    for name in PER_DRONE[1:]:
        if any(racer.get(name, first.get(name)) != first.get(name) for racer in others):
            found.append(
                f"{env['kwargs'].source}: env.kwargs: {name}: the first one's is that of all "
                "drones, as in lsy_drone_racing"
            )
    return found


def _unknown(node: Node, model: type[BaseModel]) -> list[str]:
    """A warning for every key that no model has."""
    found: list[str] = []
    if not isinstance(node.value, dict):
        return found
    allowed = {*model.model_fields, *_KNOWN.get(node.path, set())} - set(_OURS) - {"warnings"}
    for key, child in node.value.items():
        if key not in allowed:
            close = difflib.get_close_matches(key, sorted(allowed), n=1)
            hint = f"; did you mean '{close[0]}'?" if close else ""
            found.append(f"{child.source}: {child.path}: not known here, ignored{hint}")
            continue
        if key not in model.model_fields:
            continue
        inner = _model_of(model.model_fields[key].annotation)
        if inner is None:
            continue
        for member in child.value if isinstance(child.value, list) else [child]:
            found += _unknown(member, inner)
    return found


def _model_of(annotation: Any) -> type[BaseModel] | None:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for part in getattr(annotation, "__args__", ()):
        found = _model_of(part)
        if found is not None:
            return found
    return None
