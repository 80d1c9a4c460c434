"""Trials flown elsewhere, in the arena above all, taken into a tournament."""

from __future__ import annotations

import json
import re
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from crazyarena.errors import InputError
from crazyarena.plain_text import shown_in
from crazyarena.runner.contestant.submission import submission_hash
from crazyarena.runner.records.export import read
from crazyarena.runner.tournament.archive import unpack
from crazyarena.runner.tournament.flight import thinned
from crazyarena.runner.tournament.journal import full
from crazyarena.runner.tournament.plan import SUBMISSIONS, Team
from crazyarena.runner.tournament.run import Tournament

TRIALS = "trials"
_MOST_BYTES = 64 * 2**20  # of a result.json
_NUMBERS = ("flight_time", "interstep_learning_time", "interepisode_learning_time")


def add_trial(tournament: Tournament, argument: str) -> list[dict[str, Any]]:
    """Take in ``RUN`` or ``TEAM=RUN``, the results folder of ``fly`` or ``bench``.

    The team is told by the digest of what flew where it is not named. A level on which trials were
    taken in is scored by them alone.

    Raises
    ------
    InputError: no such run or team, it is of no team, or it is there already.
    """
    name, equals, place = argument.partition("=")
    run = Path(place if equals else argument).expanduser()
    if not equals or (not run.exists() and Path(argument).exists()):
        name, run = "", Path(argument).expanduser()
    file = run / "result.json" if run.is_dir() else run
    document = _document(file)
    origin = document["provenance"]
    team = _team(tournament, name, str(origin.get("submission_sha256", "")), run)
    level = _level_key(origin, file)
    digest = str(origin.get("date", "")) + str(origin.get("submission_sha256", ""))
    taken = [e for e in tournament.journal.episodes.values() if e.get("trial")]
    if any(e["trial"]["origin"] == digest and e["team"] == team.slug for e in taken):
        raise InputError(f"--add-trial {run}: this trial of team {team.name} is there already")
    before = sum(e["team"] == team.slug and e["level"] == level for e in taken)
    folder = Path(TRIALS, team.slug, f"{level}-{before:03d}")
    lines = []
    for index, episode in enumerate(document["episodes"]):
        line = _line(episode, file, index)
        recording = _copied(tournament, file.parent, episode, folder)
        path, at = ([], None) if recording is None else _path(tournament.out / recording)
        lines.append(
            {
                **line,
                "key": f"{team.slug}/{level}/trial-{before + index}",
                "team": team.slug,
                "level": level,
                "draw": before + index,
                "block": "",
                "recording": recording,
                "path": path,
                "place": at,
                "trial": {
                    "origin": digest,
                    "date": str(origin.get("date", "")),
                    "backend": str(_dict(origin.get("rig")).get("backend", "sim")),
                    "level": str(origin.get("level", level)),
                    "track": _track(origin),
                },
            }
        )
    if not lines:
        raise InputError(f"{file}: no episodes in this run")
    _copy(tournament, file, folder / "result.json")
    tournament.journal.append(lines)
    return lines


def _document(file: Path) -> dict[str, Any]:
    try:
        if not file.is_file():
            raise InputError(
                f"--add-trial {file.parent}: no result.json here. Pass the results folder of "
                "crazyarena fly"
            )
        if file.stat().st_size > _MOST_BYTES:
            raise InputError(f"{file}: too large for the result of a run")
        document = shown_in(json.loads(file.read_text("utf-8")))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{file}: cannot read the result of a run: {error}") from None
    if (
        not isinstance(document, dict)
        or not isinstance(document.get("episodes"), list)
        or not isinstance(document.get("provenance"), dict)
        or document.get("contract") is not None
    ):
        raise InputError(f"{file}: not the result of a run of the 2022 contract")
    return document


def _team(tournament: Tournament, name: str, digest: str, run: Path) -> Team:
    teams = tournament.plan.teams
    if name:
        for team in teams:
            if name.casefold() in (team.name.casefold(), team.slug):
                return team
        raise InputError(
            f"--add-trial {name}={run}: no team of this name (there are "
            f"{', '.join(team.name for team in teams)})"
        )
    found = [team for team in teams if team.archive and _hash(tournament, team) == digest]
    if len(found) == 1:
        return found[0]
    what = "several teams" if found else "no team"
    raise InputError(
        f"--add-trial {run}: what flew there is the submission of {what}. Name it: "
        f"--add-trial TEAM={run}"
    )


def _hash(tournament: Tournament, team: Team) -> str:
    assert team.archive is not None
    archive = tournament.out / SUBMISSIONS / f"{team.archive}.tar"
    with tempfile.TemporaryDirectory(prefix="crazyarena-trial-") as folder:
        return submission_hash(unpack(archive, team.archive, Path(folder)) / team.place)


def _level_key(origin: dict[str, Any], file: Path) -> str:
    name = origin.get("level")
    if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}", name):
        raise InputError(f"{file}: provenance.level: expected the name of a level")
    return name


def _line(episode: Any, file: Path, index: int) -> dict[str, Any]:
    where = f"{file}: episodes[{index}]"
    if not isinstance(episode, dict):
        raise InputError(f"{where}: expected an episode")
    numbers = {}
    for name in _NUMBERS:
        value = episode.get(name)
        if not isinstance(value, int | float) or isinstance(value, bool) or not 0 <= value < 1e6:
            raise InputError(f"{where}.{name}: expected s, found {value!r}")
        numbers[name] = float(value)
    counts = {}
    for name in ("gates_passed", "gates", "collisions", "violations", "missed_ticks"):
        value = episode.get(name, 0)
        if not isinstance(value, int) or isinstance(value, bool) or value < 0:
            raise InputError(f"{where}.{name}: expected a whole number, found {value!r}")
        counts[name] = value
    completed = episode.get("completed") is True
    events = episode.get("events")
    return {
        "outcome": str(episode.get("termination", "")),
        "why": str(episode.get("why") or episode.get("termination", ""))[:300],
        "clean": completed and counts["collisions"] == 0 and counts["violations"] == 0,
        "completed": completed,
        "flight_time": numbers["flight_time"],
        "learning_time": numbers["interstep_learning_time"] + numbers["interepisode_learning_time"],
        **counts,
        "gate_times": [t for t in episode.get("gate_times") or [] if isinstance(t, int | float)],
        "compute_ms": _dict(episode.get("compute_ms")),
        "noise_ms": {},
        "events": [
            {name: event.get(name, "") for name in ("time", "event", "detail")}
            for event in (events if isinstance(events, list) else [])[:100]
            if isinstance(event, dict)
        ],
        "error": None if episode.get("error") is None else str(episode["error"])[:4000],
        "wall": 0.0,
        "worker": {},
    }


def _dict(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def _track(origin: dict[str, Any]) -> dict[str, Any]:
    """Nominal gates and obstacles, of the level that the run has noted."""
    try:
        track = _dict(_dict(yaml.safe_load(str(origin.get("level_file", "")))).get("track"))
        gates = [[float(g["x"]), float(g["y"]), float(g.get("yaw", 0.0))] for g in track["gates"]]
        obstacles = [[float(o["x"]), float(o["y"])] for o in track.get("obstacles") or []]
    except (yaml.YAMLError, KeyError, TypeError, ValueError):
        return {"gates": [], "obstacles": []}
    return {"gates": gates, "obstacles": obstacles}


def _copied(tournament: Tournament, run: Path, episode: Any, folder: Path) -> str | None:
    name = _dict(episode.get("files")).get("recording")
    if not isinstance(name, str) or Path(name).name != name or not (run / name).is_file():
        return None
    _copy(tournament, run / name, folder / name)
    return (folder / name).as_posix()


def _copy(tournament: Tournament, source: Path, place: Path) -> None:
    target = tournament.out / place
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, target)
    except OSError as error:
        raise full(target, error, len(tournament.journal.episodes)) from error


def _path(recording: Path) -> tuple[list[list[float]], list[float] | None]:
    tables = read(recording)
    states, columns = tables.tables.get("state"), tables.columns.get("state", [])
    if states is None or not len(states) or "position_0" not in columns:
        return [], None
    at = columns.index("position_0")
    positions = states[:, at : at + 3]
    return thinned(positions[::25]), [round(float(x), 3) for x in positions[-1]]


def trial_levels(lines: Sequence[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Levels on which trials were taken in, by key: what the first of them says of its track."""
    found: dict[str, dict[str, Any]] = {}
    for line in lines:
        if line.get("trial"):
            found.setdefault(line["level"], line["trial"]["track"])
    return found
