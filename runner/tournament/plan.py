"""What is to be flown: teams, levels, draws and blocks. All of it is files in the results folder.

``tournament.json`` says who and what, ``draws/`` in which worlds, ``submissions/`` holds the
archives. Draws come from the system's randomness and are readable by the organiser alone until
everything is flown; they are the same for every team.
"""

from __future__ import annotations

import datetime
import json
import re
import secrets
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from crazyarena.errors import InputError, StorageError
from crazyarena.levels import load_level
from crazyarena.levels.draw_file import dump_draw
from crazyarena.levels.lsy import is_lsy_level, load_lsy_level, lsy_text
from crazyarena.levels.lsy.schema import LsyRng
from crazyarena.levels.schema import Level, Profile
from crazyarena.runner.tournament.entries import IROS, LSY, Entry
from crazyarena.runner.tournament.flight import Order
from crazyarena.runner.tournament.rules import Lives
from crazyarena.whole_file import write_whole

FORMAT = 1
MOST_SEEDS = 5_000  # one draw file holds them all
_SECRET_BITS = 128
_LSY_BLOCK = 5  # episodes: a process for each would cost more than they do
PLAN, DRAWS, SUBMISSIONS = "tournament.json", "draws", "submissions"


@dataclass(frozen=True)
class Team:
    """As :class:`.entries.Entry`, with its archive; levels: keys of those it flies, all of its
    contract if empty. parameters: told to it."""

    name: str
    slug: str
    source: str
    contract: str
    control_mode: str | None = None
    commit: str | None = None
    trouble: str | None = None
    archive: str | None = None
    place: str = ""
    levels: tuple[str, ...] = ()
    parameters: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True)
class PlannedLevel:
    """A level and its draws.

    Attributes
    ----------
    key: for files. name: as shown. contract: of those who fly it. profile: of its simulation.
    toml: file name and text of a level of lsy_drone_racing; its ``overrides``.
    blocks: numbers of the draws that one controller lives through. seeds: of all draws.
    gates, obstacles: nominal x, y, yaw of the gates, x, y of the obstacles.
    """

    key: str
    name: str
    contract: str
    profile: str
    blocks: tuple[tuple[int, ...], ...]
    seeds: tuple[int, ...] = field(repr=False)
    level: Level | None = field(default=None, repr=False)
    toml: tuple[str, str] | None = field(default=None, repr=False)
    overrides: tuple[str, ...] = ()
    gates: tuple[tuple[float, float, float], ...] = ()
    obstacles: tuple[tuple[float, float], ...] = ()

    @property
    def draws(self) -> int:
        """How many."""
        return len(self.seeds)


@dataclass(frozen=True)
class Options:
    """How a tournament is flown; the same from its first to its last episode."""

    seeds: int = 10
    compute: str = "free"
    patience: float = 10.0
    record: bool = True

    def check(self) -> None:
        """Raise InputError for what cannot be."""
        from crazyarena.runner.contestant.compute import parse_compute

        if not 1 <= self.seeds <= MOST_SEEDS:
            raise InputError(f"--seeds: found {self.seeds}; need 1 to {MOST_SEEDS}")
        if not 0.05 <= self.patience <= 600.0:
            raise InputError(f"--patience: found {self.patience:g}; need 0.05 to 600 s")
        parse_compute(self.compute)


@dataclass(frozen=True)
class Plan:
    """Everything that is settled before the first flight."""

    teams: tuple[Team, ...]
    levels: tuple[PlannedLevel, ...]
    options: Options
    rules: str
    title: str
    created: str

    def level(self, key: str) -> PlannedLevel:
        """By key."""
        return next(level for level in self.levels if level.key == key)

    def pairs(self) -> Iterator[tuple[Team, PlannedLevel]]:
        """Who flies what, level by level."""
        for level in self.levels:
            for team in self.teams:
                if team.contract == level.contract and (
                    not team.levels or level.key in team.levels
                ):
                    yield team, level

    def orders(self) -> Iterator[Order]:
        """The work, in the order in which it is handed out."""
        for team, level in self.pairs():
            if team.archive is None:
                continue
            for number, draws in enumerate(level.blocks):
                yield Order(
                    key=f"{team.slug}/{level.key}/{number}",
                    team=team.slug,
                    level=level.key,
                    draws=draws,
                    archive=team.archive,
                    place=team.place,
                    contract=team.contract,
                    draw_file=self.draw_text(level, number, team.control_mode),
                    toml=level.toml,
                    record=self.options.record,
                    patience=self.options.patience,
                    parameters=team.parameters,
                )

    def draw_text(self, level: PlannedLevel, block: int, control_mode: str | None = None) -> str:
        """Text of the draw file of a block."""
        seeds = [level.seeds[number] for number in level.blocks[block]]
        if level.level is not None:
            return dump_draw(level.level, seeds, self.options.compute)
        assert level.toml is not None
        mode = [] if control_mode is None else [f"env.control_mode={control_mode}"]
        return dump_draw(level.toml[0], seeds, "free", [*level.overrides, *mode])

    def draw_name(self, level: PlannedLevel, block: int, control_mode: str | None = None) -> str:
        """File name of it."""
        mode = "" if control_mode is None or level.contract != LSY else f"-{control_mode}"
        return f"{level.key}{mode}-{block:03d}.yaml"


def plan_level(
    name: str,
    seeds: Sequence[int],
    lives: Lives,
    overrides: Sequence[str] = (),
    key: str | None = None,
    most: int | None = None,
) -> PlannedLevel:
    """A level by name or file, flown with these seeds; a block has ``most`` draws at most.

    Raises
    ------
    InputError: no such level, or one that cannot be flown in secret worlds.
    """
    numbers = tuple(range(len(seeds)))
    one_each = tuple((number,) for number in numbers)
    if is_lsy_level(name) or name.startswith("lsy/"):
        lsy = load_lsy_level(name, overrides)
        if lsy.rng is LsyRng.THREEFRY:
            raise InputError(
                f"level {name}: rng threefry draws from 32 bits, which nobody could call secret. "
                "Use pcg64"
            )
        stem = Path(name).name.removesuffix(".toml")
        step = most or (len(seeds) if lives is Lives.LEVEL else _LSY_BLOCK)
        return PlannedLevel(
            key or f"lsy-{_key(stem)}",
            f"lsy/{stem}" if name.startswith("lsy/") else stem,
            LSY,
            "successor",
            _cut(numbers, step),
            tuple(seeds),
            toml=(f"{key or 'lsy-' + _key(stem)}.toml", lsy_text(name)),
            overrides=tuple(overrides),
            gates=tuple((g.pos[0], g.pos[1], g.rpy[2] + _TURN) for g in lsy.env.track.gates),
            obstacles=tuple((o.pos[0], o.pos[1]) for o in lsy.env.track.obstacles),
        )
    level = load_level(name, overrides)
    together = lives is Lives.LEVEL and level.profile is Profile.COMPETITION
    return PlannedLevel(
        key or _key(level.name),
        level.name,
        IROS,
        level.profile.value,
        _cut(numbers, most or len(numbers)) if together else one_each,
        tuple(seeds),
        # One draw after the other is from a seed of its own, whatever the level says.
        level=level.model_copy(update={"num_episodes": 1}),
        gates=tuple((g.x, g.y, g.yaw) for g in level.track.gates),
        obstacles=tuple((o.x, o.y) for o in level.track.obstacles),
    )


_TURN = 1.5707963267948966  # a gate of theirs is flown along its x axis, one of 2022 along y


def _cut(numbers: Sequence[int], step: int) -> tuple[tuple[int, ...], ...]:
    return tuple(tuple(numbers[k : k + step]) for k in range(0, len(numbers), step))


def _key(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9_.-]", "-", name).strip(".-") or "level"


def secret_seeds(count: int) -> tuple[int, ...]:
    """Of the system's randomness; nobody can guess one from another."""
    return tuple(secrets.randbits(_SECRET_BITS) for _ in range(count))


def make_team(entry: Entry, archive: str | None, place: str, trouble: str | None) -> Team:
    """An entry with its archive."""
    return Team(
        entry.name,
        entry.slug,
        str(entry.path),
        entry.contract,
        entry.control_mode,
        entry.commit,
        trouble or entry.trouble,
        archive,
        place,
    )


def now() -> str:
    """The date, for people."""
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")


# Files


def write_plan(plan: Plan, out: Path) -> None:
    """Write ``tournament.json`` and ``draws/``; the former last, so that it stands for both."""
    folder = out / DRAWS
    folder.mkdir(exist_ok=True)
    folder.chmod(0o700)
    modes: dict[str, set[str | None]] = {}
    for team, level in plan.pairs():
        modes.setdefault(level.key, set()).add(team.control_mode)
    for level in plan.levels:
        if level.toml is not None:
            write_file(folder / level.toml[0], level.toml[1].encode(), 0o600)
        for mode in sorted(modes.get(level.key, {None}), key=str):
            for block in range(len(level.blocks)):
                text = plan.draw_text(level, block, mode)
                write_file(folder / plan.draw_name(level, block, mode), text.encode(), 0o600)
    document = {
        "format": FORMAT,
        "title": plan.title,
        "created": plan.created,
        "options": asdict(plan.options),
        "rules": plan.rules,
        "teams": [asdict(team) for team in plan.teams],
        "levels": [_level_document(level) for level in plan.levels],
    }
    write_file(out / PLAN, (json.dumps(document, indent=1) + "\n").encode(), 0o600)


def publish(out: Path) -> None:
    """Everything is flown: draws may be read by anybody."""
    for file in (out / DRAWS).iterdir():
        file.chmod(0o644)
    (out / DRAWS).chmod(0o755)
    (out / PLAN).chmod(0o644)


def _level_document(level: PlannedLevel) -> dict[str, Any]:
    document = asdict(replace(level, level=None))
    document["level"] = None if level.level is None else level.level.model_dump(mode="json")
    return document


def read_plan(out: Path) -> Plan:
    """Read ``tournament.json``.

    Raises
    ------
    InputError: it cannot be read, or is of another version.
    """
    file = out / PLAN
    try:
        document = json.loads(file.read_text("utf-8"))
        if document["format"] != FORMAT:
            raise InputError(f"{file}: format {document['format']}; this version reads {FORMAT}")
        teams = [Team(**{**team, "levels": tuple(team["levels"])}) for team in document["teams"]]
        levels = [_level(data) for data in document["levels"]]
        options = Options(**document["options"])
        return Plan(
            tuple(teams),
            tuple(levels),
            options,
            str(document["rules"]),
            str(document["title"]),
            str(document["created"]),
        )
    except OSError as error:
        raise InputError(f"{file}: cannot read it: {error.strerror}") from None
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            f"{file}: no plan of a tournament ({type(error).__name__}: {error}). Pass another --out"
        ) from None


def _level(data: dict[str, Any]) -> PlannedLevel:
    def tuples(value: Any) -> Any:
        return tuple(map(tuples, value)) if isinstance(value, list) else value

    plain = {name: tuples(value) for name, value in data.items() if name != "level"}
    level = None if data["level"] is None else Level.model_validate(data["level"])
    return PlannedLevel(**plain, level=level)


def write_file(file: Path, data: bytes, mode: int = 0o644) -> None:
    """Write a file so that it is there as a whole or as it was before.

    Raises
    ------
    InputError: no room, or no right to.
    """
    try:
        write_whole(file, data, mode)
    except StorageError as error:
        raise InputError(f"{error}. Make room and start again with the same --out") from error
