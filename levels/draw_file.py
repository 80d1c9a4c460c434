"""Draw files: what was flown in which worlds, so that anybody can fly the same again.

A draw file is YAML: the level itself, one seed for each episode that a controller lives through,
and what its thinking cost. Seeds may be as large as secrets are (docs/tournament.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import yaml
from pydantic import Field, model_validator

from crazyarena.errors import InputError
from crazyarena.levels.document import Node, read
from crazyarena.levels.fields import validate
from crazyarena.levels.load import dump_level
from crazyarena.levels.lsy.load import load_lsy_level
from crazyarena.levels.lsy.schema import LsyLevel
from crazyarena.levels.schema import Level
from crazyarena.levels.values import Model, Whole, invalid

FORMAT = 1
MOST_SEEDS = 10_000

Seed = Annotated[Whole, Field(ge=0, lt=2**128)]


class DrawFile(Model):
    """Contents of a draw file; immutable.

    Exactly one of ``level`` (of the 2022 contract) and ``lsy_level`` (file name of a TOML level of
    lsy_drone_racing, beside the draw file, or ``lsy/level0`` ...) is given.
    """

    draw: Literal[1] = 1
    """Version of this format."""
    level: dict[str, Any] | None = None
    lsy_level: Annotated[str, Field(min_length=1, max_length=1000)] | None = None
    overrides: Annotated[tuple[str, ...], Field(max_length=1000)] = ()
    """``field=value``, of ``lsy_level``."""
    seeds: Annotated[tuple[Seed, ...], Field(min_length=1, max_length=MOST_SEEDS)]
    compute: Annotated[str, Field(max_length=50)] = "free"
    """As ``--compute``."""

    @model_validator(mode="after")
    def _one_level(self) -> Self:
        if (self.level is None) == (self.lsy_level is None):
            raise invalid("expected either level or lsy_level", "level")
        return self


class LoadedDraw:
    """A draw file with its level.

    Attributes
    ----------
    file: its contents. level: the level of it, whichever contract it is of. seeds: as there.
    """

    def __init__(self, file: DrawFile, level: Level | LsyLevel) -> None:
        self.file = file
        self.level = level
        self.seeds = file.seeds


def read_draw(path: Path) -> LoadedDraw:
    """Read a draw file and its level.

    Raises
    ------
    InputError: naming file, line, field, what was found and what is allowed.
    """
    if not path.is_file():
        raise InputError(f"--draw {path}: no such file. Pass a file of a tournament's draws/")
    root = read(path, str(path))
    if not isinstance(root.value, dict):
        root.expected("a draw file (a mapping with level and seeds)")
    file = validate(root, DrawFile)
    if file.lsy_level is not None:
        return LoadedDraw(file, load_lsy_level(_toml(path, file.lsy_level), file.overrides))
    if file.overrides:
        root.value["overrides"].fail("only for lsy_level; write them into level")
    member = root.value["level"]
    level = validate(Node(member.value, "", member.source), Level)
    return LoadedDraw(file, level)


def _toml(path: Path, name: str) -> str | Path:
    if name.startswith("lsy/"):
        return name
    if Path(name).name != name:
        raise InputError(f"{path}: lsy_level: expected a file beside this one, found '{name}'")
    return path.parent / name


def dump_draw(
    level: Level | str, seeds: Sequence[int], compute: str, overrides: Sequence[str] = ()
) -> str:
    """Text of a draw file; ``level`` is one of the 2022 contract, or the name that ``lsy_level``
    is to have."""
    head: dict[str, Any] = {"draw": FORMAT, "compute": compute, "seeds": list(seeds)}
    if isinstance(level, str):
        body: dict[str, Any] = {"lsy_level": level}
        if overrides:
            body["overrides"] = list(overrides)
    else:
        body = {"level": yaml.safe_load(dump_level(level))}
    return yaml.safe_dump({**head, **body}, sort_keys=False, default_flow_style=None, width=1000)
