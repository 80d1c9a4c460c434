"""Who takes part: submissions found in a folder, or named by a list.

A folder has a team in each of its folders and ``.py`` files. A list is CSV (``team,path`` and,
where needed, ``control_mode``) or YAML (``teams: [{name, path, control_mode}]``); paths are those
seen from the list's own folder. A submission that cannot be read stays in the list with the reason,
so that one bad folder does not keep forty teams from flying.
"""

from __future__ import annotations

import csv
import io
import re
import tomllib
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from crazyarena.errors import InputError
from crazyarena.levels.document import read, read_text
from crazyarena.levels.fields import validate
from crazyarena.levels.values import Model
from crazyarena.plain_text import shown_line
from crazyarena.runner.contestant.contract_lsy.submission import find_controller
from crazyarena.runner.contestant.submission import check_size, entry_file

MOST_TEAMS = 1000
_LONGEST_NAME = 64
_COLUMNS = ("team", "path", "control_mode")
_LSY_CONTROL = ("lsy_drone_racing", "control")
_LSY_LEVEL = Path("config", "level2.toml")  # in which their competition names the controller
_REF = re.compile(r"ref: (refs/[\w./+-]{1,200})")
_COMMIT = re.compile(r"[0-9a-f]{40,64}")

IROS, LSY = "iros2022", "lsy"
"""Contracts: which calls a controller answers, and so which levels it can fly."""


@dataclass(frozen=True, slots=True)
class Entry:
    """A team and what it submitted.

    Attributes
    ----------
    name: as shown. slug: the same for file names and keys.
    path: what is flown: a folder with ``edit_this.py`` or a file; of lsy_drone_racing a file.
    root: folder that is sent along with ``path``; None where the file comes alone.
    contract: ``iros2022`` or ``lsy``. control_mode: of lsy_drone_racing; None: the level's.
    commit: checked out where it lies; None where that is no git checkout.
    trouble: why it cannot be flown; None if it can, as far as can be told.
    """

    name: str
    slug: str
    path: Path
    root: Path | None = None
    contract: str = IROS
    control_mode: str | None = None
    commit: str | None = None
    trouble: str | None = None


class _Team(Model):
    name: Annotated[str, Field(min_length=1, max_length=200)]
    path: Annotated[str, Field(min_length=1, max_length=4000)]
    control_mode: Literal["state", "attitude"] | None = None


class _List(Model):
    teams: Annotated[tuple[_Team, ...], Field(min_length=1, max_length=MOST_TEAMS)]


def find_entries(source: Path) -> list[Entry]:
    """Teams of a folder of submissions, of one submission, or of a list.

    Raises
    ------
    InputError: nothing there, a bad list, two teams of one name, or none that can be flown.
    """
    source = source.expanduser()
    if not source.exists():
        raise InputError(
            f"{source}: no such file or folder. Pass a folder of submissions, or a list (.csv, "
            ".yaml) of teams"
        )
    if source.is_dir():
        teams = [_Team(name=source.name or "team", path=".")]
        if not _is_submission(source):
            teams = _in_folder(source)
        base = source
    elif source.suffix.lower() in (".yaml", ".yml"):
        root = read(source, str(source))
        if not isinstance(root.value, dict):
            root.expected("a list of teams (teams: [{name, path}])")
        teams, base = list(validate(root, _List).teams), source.parent
    elif source.suffix.lower() == ".csv":
        teams, base = _read_csv(source), source.parent
    elif source.suffix == ".py":
        teams, base = [_Team(name=source.stem, path=source.name)], source.parent
    else:
        raise InputError(f"{source}: expected a folder, a .py file, or a list (.csv, .yaml)")
    entries = _named(teams, base, str(source))
    if all(entry.trouble for entry in entries):
        first = "; ".join(f"{e.name}: {e.trouble}" for e in entries[:5])
        raise InputError(f"{source}: no submission here can be flown. {first}")
    return entries


def _is_submission(folder: Path) -> bool:
    return (folder / "edit_this.py").is_file()


def _in_folder(folder: Path) -> list[_Team]:
    teams = []
    try:
        inside = sorted(folder.iterdir(), key=lambda p: p.name.casefold())
    except OSError as error:
        raise InputError(f"{folder}: cannot read the folder: {error.strerror}") from None
    for path in inside:
        if path.name.startswith((".", "__")):
            continue
        if path.is_dir():
            teams.append(_Team(name=path.name, path=path.name))
        elif path.suffix == ".py":
            teams.append(_Team(name=path.stem, path=path.name))
    if not teams:
        raise InputError(
            f"{folder}: no submissions here. Expected a folder, or a .py file, for each team"
        )
    if len(teams) > MOST_TEAMS:
        raise InputError(f"{folder}: {len(teams)} teams; at most {MOST_TEAMS} can take part")
    return teams


def _read_csv(file: Path) -> list[_Team]:
    text = read_text(file, str(file))
    try:
        rows = list(csv.reader(io.StringIO(text), strict=True))
    except csv.Error as error:
        raise InputError(f"{file}: no valid CSV: {error}") from None
    header = [cell.strip().lower() for cell in rows[0]] if rows else []
    if not {"team", "path"} <= set(header) <= set(_COLUMNS) or len(set(header)) < len(header):
        raise InputError(
            f"{file}:1: expected the header team,path (and control_mode where needed), found "
            f"{','.join(header) or 'nothing'}"
        )
    teams = []
    for number, row in enumerate(rows[1:], 2):
        if not any(cell.strip() for cell in row):
            continue
        if len(row) != len(header):
            raise InputError(f"{file}:{number}: expected {len(header)} columns, found {len(row)}")
        cells = {name: cell.strip() for name, cell in zip(header, row, strict=True)}
        for name in ("team", "path"):
            if not cells[name]:
                raise InputError(f"{file}:{number}: {name}: missing")
        mode = cells.get("control_mode") or None
        if mode not in (None, "state", "attitude"):
            raise InputError(
                f"{file}:{number}: control_mode: expected state or attitude, found '{mode}'"
            )
        teams.append(
            _Team(name=cells["team"], path=cells["path"], control_mode=mode)  # type: ignore[arg-type]
        )
    if not teams:
        raise InputError(f"{file}: no teams in this list")
    if len(teams) > MOST_TEAMS:
        raise InputError(f"{file}: {len(teams)} teams; at most {MOST_TEAMS} can take part")
    return teams


def _named(teams: Sequence[_Team], base: Path, source: str) -> list[Entry]:
    seen: dict[str, str] = {}
    slugs: set[str] = set()
    entries = []
    for team in teams:
        name = shown_line(" ".join(unicodedata.normalize("NFC", team.name).split()))
        if not name or len(name) > _LONGEST_NAME:
            raise InputError(
                f"{source}: team '{name[:70]}': expected a name of 1 to {_LONGEST_NAME} characters"
            )
        key = unicodedata.normalize("NFKC", name).casefold()
        if key in seen:
            raise InputError(
                f"{source}: two teams are called '{name}' ({seen[key]} and {team.path}). Give "
                "each a name of its own"
            )
        seen[key] = team.path
        entries.append(_examined(name, _slug(name, slugs), base / team.path, team.control_mode))
    return entries


def _slug(name: str, taken: set[str]) -> str:
    """A name for files and keys, unlike those before."""
    plain = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode()
    base = re.sub(r"[^A-Za-z0-9]+", "-", plain).strip("-").lower()[:48] or "team"
    slug, count = base, 1
    while slug in taken:
        count += 1
        slug = f"{base}-{count}"
    taken.add(slug)
    return slug


def _examined(name: str, slug: str, path: Path, control_mode: str | None) -> Entry:
    path = path.expanduser()
    try:
        path = path.resolve()
        commit = commit_of(path)
        file, root, mode = _find(path)
        if file is not None:
            lsy_mode = control_mode or mode
            return Entry(name, slug, file, root, LSY, lsy_mode, commit)
        inner = path / "competition"
        if path.is_dir() and not _is_submission(path) and _is_submission(inner):
            path = inner  # a checkout of safe-control-gym
        entry_file(path)
        check_size(path)
        if control_mode is not None:
            raise InputError("control_mode: only controllers of lsy_drone_racing have one")
        return Entry(name, slug, path, commit=commit)
    except (InputError, OSError, RecursionError, ValueError) as error:
        text = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        return Entry(
            name, slug, path, trouble=shown_line(text.replace(f"{path.parent}/", ""))[:500]
        )


def _find(path: Path) -> tuple[Path | None, Path | None, str | None]:
    """File of a controller of lsy_drone_racing, folder that goes with it, control mode; a file
    that is named brings only itself, unless it lies in a checkout of theirs."""
    control = path.joinpath(*_LSY_CONTROL)
    if path.is_dir() and control.is_dir() and not _is_submission(path):
        file, mode = _chosen(path)
        chosen = file if file is not None else find_controller(control)
        if chosen is None:
            raise InputError(f"{control}: no controller of lsy_drone_racing here")
        return chosen, chosen.parents[1], mode
    found = find_controller(path)
    if found is None:
        return None, None, None
    if path.is_dir():
        return found, path, None
    in_checkout = path.parent.name == _LSY_CONTROL[1] and path.parents[1].name == _LSY_CONTROL[0]
    return found, path.parents[1] if in_checkout else None, None


def _chosen(checkout: Path) -> tuple[Path | None, str | None]:
    """What a checkout's level says of its controller, as their own evaluation reads it."""
    file = checkout / _LSY_LEVEL
    if not file.is_file():
        return None, None
    try:
        document = tomllib.loads(read_text(file, str(file)))
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{file}: no valid TOML: {error}") from None
    controller, env = document.get("controller"), document.get("env")
    name = controller.get("file") if isinstance(controller, dict) else None
    mode = env.get("control_mode") if isinstance(env, dict) else None
    mode = mode if mode in ("state", "attitude") else None
    if not isinstance(name, str):
        return None, mode
    place = checkout.joinpath(*_LSY_CONTROL, Path(name).name)
    if not place.is_file():
        raise InputError(f"{file}: controller.file: no {name} in {place.parent}")
    return place, mode


def commit_of(path: Path) -> str | None:
    """Commit that is checked out at a path or above it; None if there is none.

    Read from the files of the checkout: running git in a stranger's folder would run what its
    configuration says.
    """
    folder = path if path.is_dir() else path.parent
    git = folder / ".git"
    if not git.is_dir():
        return None
    head = _line(git / "HEAD")
    match = _REF.fullmatch(head)
    if match is None:
        return head if _COMMIT.fullmatch(head) else None
    if ".." in match[1]:
        return None
    loose = _line(git / match[1])
    if _COMMIT.fullmatch(loose):
        return loose
    for line in _text(git / "packed-refs").splitlines():
        commit, _, name = line.partition(" ")
        if name == match[1] and _COMMIT.fullmatch(commit):
            return commit
    return None


def _line(file: Path) -> str:
    return _text(file).partition("\n")[0].strip()


def _text(file: Path) -> str:
    try:
        if not file.is_file() or file.is_symlink():
            return ""
        with open(file, "rb") as stream:
            return stream.read(1 << 20).decode("utf-8", "replace")
    except OSError:
        return ""
