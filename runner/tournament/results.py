"""What a tournament comes to: standings, intervals, comparisons; as tables and files."""

from __future__ import annotations

import csv
import io
import itertools
import json
import statistics as plain
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from crazyarena.errors import InputError
from crazyarena.runner.tournament import scoring, statistics
from crazyarena.runner.tournament.entries import IROS
from crazyarena.runner.tournament.plan import Team, write_file
from crazyarena.runner.tournament.rules import Success
from crazyarena.runner.tournament.run import Tournament
from crazyarena.runner.tournament.statistics import Comparison
from crazyarena.runner.tournament.trials import trial_levels

CSV, PARQUET, STANDINGS = "results.csv", "results.parquet", "standings.json"
_COLUMNS = (
    "team", "level", "source", "draw", "outcome", "clean", "completed", "flight_time",
    "learning_time", "gates_passed", "gates", "collisions", "violations", "missed_ticks",
    "compute_p50_ms", "compute_p99_ms", "noise_p50_ms", "noise_p99_ms", "x", "y", "z", "why",
    "recording", "draw_file", "host", "cpu",
)  # fmt: skip


@dataclass(frozen=True)
class Level:
    """As scored. trials: by trials flown elsewhere, not by its draws."""

    key: str
    name: str
    contract: str
    trials: bool
    gates: Sequence[Sequence[float]]
    obstacles: Sequence[Sequence[float]]


@dataclass
class Cell:
    """A team on a level: what the tables say.

    Times in s, compute times in ms. interval: of the success rate; median, spread: of the times of
    the successes. compute, noise: 99th percentiles of thinking, and of a work that is always the
    same, where it thought. causes: how often it ended how, most often first.
    """

    episodes: list[dict[str, Any]]
    planned: int
    successes: int
    rate: float | None
    interval: tuple[float, float] | None
    median: float | None
    spread: tuple[float, float] | None
    compute: float | None
    noise: float | None
    causes: list[tuple[str, int]]
    score: scoring.TeamLevel


@dataclass
class Results:
    """Everything that is told."""

    tournament: Tournament
    teams: list[Team]
    levels: list[Level]
    cells: dict[tuple[str, str], Cell]
    standings: scoring.Standings
    comparisons: list[tuple[Team, Team, Comparison]]
    remarks: list[str] = field(default_factory=list)

    @property
    def complete(self) -> bool:
        """Everything that was to be flown was."""
        return not self.tournament.missing()

    def team(self, slug: str) -> Team:
        """By slug."""
        return next(team for team in self.teams if team.slug == slug)


def assemble(tournament: Tournament, asked: Sequence[tuple[str, str]] = ()) -> Results:
    """Score what the journal holds.

    Parameters
    ----------
    asked: names of teams to compare, besides each with the next one of the leaderboard.

    Raises
    ------
    InputError: no team of such a name.
    """
    plan, rules = tournament.plan, tournament.rules
    lines = list(tournament.journal.episodes.values())
    tracks = trial_levels(lines)
    levels = [
        Level(p.key, p.name, p.contract, p.key in tracks, p.gates, p.obstacles) for p in plan.levels
    ]
    known = {level.key for level in levels}
    levels += [
        Level(key, key, IROS, True, track["gates"], track["obstacles"])
        for key, track in tracks.items()
        if key not in known
    ]
    flown: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for line in sorted(lines, key=lambda e: (e["team"], e["level"], e["draw"])):
        if bool(line.get("trial")) == (line["level"] in tracks):
            flown.setdefault((line["team"], line["level"]), []).append(line)
    planned = {(t.slug, p.key): p.draws for t, p in plan.pairs() if p.key not in tracks}
    for level in levels:
        if level.trials:
            for team in plan.teams:
                if team.contract == level.contract:
                    planned[team.slug, level.key] = max(
                        1, len(flown.get((team.slug, level.key), ()))
                    )
    slugs = [team.slug for team in plan.teams]
    keys = [level.key for level in levels]
    standings = scoring.score(rules, slugs, keys, flown, planned)
    success = rules.qualification.success
    cells = {
        (team, level): _cell(
            flown.get((team, level), []), planned[team, level], success,
            standings.levels[level][team],
        )
        for team, level in planned
    }  # fmt: skip
    by_slug = {team.slug: team for team in plan.teams}
    pairs = []
    wanted = [(named(plan.teams, a).slug, named(plan.teams, b).slug) for a, b in asked]
    for first, second in [*wanted, *itertools.pairwise(standings.order)]:
        both = (_by_draw(cells, slug, tracks) for slug in (first, second))
        comparison = statistics.compare(*both)
        if comparison.pairs or (first, second) in wanted:
            pairs.append((by_slug[first], by_slug[second], comparison))
    results = Results(
        tournament,
        [by_slug[slug] for slug in standings.order],
        levels,
        cells,
        standings,
        pairs,
    )
    results.remarks = [*tournament.remarks, *_remarks(tournament, lines, levels)]
    return results


def named(teams: Sequence[Team], name: str) -> Team:
    """The team of a name, in any case; raises InputError for none."""
    for team in teams:
        if name.strip().casefold() in (team.name.casefold(), team.slug):
            return team
    raise InputError(
        f"{name}: no team of this name (there are {', '.join(team.name for team in teams)})"
    )


def _by_draw(
    cells: Mapping[tuple[str, str], Cell], team: str, trials: Mapping[str, Any]
) -> dict[tuple[str, int], dict[str, Any]]:
    return {
        (level, e["draw"]): e
        for (slug, level), cell in cells.items()
        if slug == team and level not in trials
        for e in cell.episodes
    }


def _cell(
    episodes: list[dict[str, Any]], planned: int, success: Success, score: scoring.TeamLevel
) -> Cell:
    won = [e for e in episodes if scoring.is_success(e, success)]
    times = [float(e["flight_time"]) for e in won]
    causes: dict[str, int] = {}
    for e in episodes:
        if not scoring.is_success(e, success):
            causes[_cause(e)] = causes.get(_cause(e), 0) + 1
    return Cell(
        episodes,
        planned,
        len(won),
        len(won) / len(episodes) if episodes else None,
        statistics.success_interval(len(won), len(episodes)),
        plain.median(times) if times else None,
        statistics.median_interval(times),
        _highest(episodes, "compute_ms"),
        _highest(episodes, "noise_ms"),
        sorted(causes.items(), key=lambda item: (-item[1], item[0])),
        score,
    )


def _cause(episode: Mapping[str, Any]) -> str:
    """How it ended and where: after which gate."""
    outcome = str(episode["outcome"]).lower()
    if episode["completed"] and not episode["clean"]:
        outcome = "touched something" if episode["collisions"] else "constraint violation"
    if not episode["path"]:
        return outcome
    passed = int(episode["gates_passed"])
    if passed >= int(episode["gates"]):
        return f"{outcome} after the last gate"
    return f"{outcome} before gate {passed}"


def _highest(episodes: Sequence[Mapping[str, Any]], name: str) -> float | None:
    values = [float(e[name]["p99"]) for e in episodes if e[name].get("p99") is not None]
    return plain.median(values) if values else None


def _remarks(
    tournament: Tournament, lines: Sequence[Mapping[str, Any]], levels: Sequence[Level]
) -> list[str]:
    found = []
    processors = sorted({e["worker"]["cpu"] for e in lines if e["worker"].get("cpu")})
    if len(processors) > 1:
        found.append(
            f"flown on {len(processors)} kinds of processor ({', '.join(processors)}): compute and "
            "learning times are not comparable"
        )
    if tournament.plan.options.compute == "measured":
        flown = [e for e in lines if e["worker"]]
        if not all(e["worker"].get("pinned") for e in flown):
            found.append(
                "thinking was measured on processors that others used as well: flights are not "
                "comparable"
            )
    for level in levels:
        if level.trials:
            simulated = any(
                e["level"] == level.key and e.get("trial") and e["trial"]["backend"] == "sim"
                for e in lines
            )
            note = ", some of them in simulation" if simulated else ""
            found.append(f"{level.name}: scored by trials that were flown elsewhere{note}")
    missing = tournament.missing()
    if missing:
        count = sum(len(order.draws) for order in missing)
        found.append(f"not finished: {count} episodes are still to be flown")
    return found


# Files


def rows(results: Results) -> list[dict[str, Any]]:
    """One row an episode, with the columns of ``results.csv``."""
    plan = results.tournament.plan
    blocks = {
        (level.key, draw): (level, number)
        for level in plan.levels
        for number, draws in enumerate(level.blocks)
        for draw in draws
    }
    names = {team.slug: team for team in plan.teams}
    found = []
    lines = results.tournament.journal.episodes.values()
    for e in sorted(lines, key=lambda e: (e["level"], e["team"], bool(e.get("trial")), e["draw"])):
        place = e["place"] or (None, None, None)
        draw_file = None
        if not e.get("trial") and (e["level"], e["draw"]) in blocks:
            level, number = blocks[e["level"], e["draw"]]
            draw_file = f"draws/{plan.draw_name(level, number, names[e['team']].control_mode)}"
        found.append(
            {
                **{name: e.get(name) for name in _COLUMNS},
                "team": names[e["team"]].name,
                "source": e["trial"]["backend"] if e.get("trial") else "tournament",
                "compute_p50_ms": e["compute_ms"].get("p50"),
                "compute_p99_ms": e["compute_ms"].get("p99"),
                "noise_p50_ms": e["noise_ms"].get("p50"),
                "noise_p99_ms": e["noise_ms"].get("p99"),
                "x": place[0],
                "y": place[1],
                "z": place[2],
                "draw_file": draw_file,
                "host": e["worker"].get("host"),
                "cpu": e["worker"].get("cpu"),
            }
        )
    return found


def write_files(results: Results, parquet: bool = False) -> list[Path]:
    """Write ``results.csv``, ``standings.json`` and, if asked for, ``results.parquet``.

    Raises
    ------
    InputError: no room. DependencyMissing: no pyarrow for a parquet file.
    """
    out = results.tournament.out
    table = rows(results)
    stream = io.StringIO()
    writer = csv.DictWriter(stream, _COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: _safe_cell(value) for name, value in row.items()} for row in table)
    written = [out / CSV, out / STANDINGS]
    write_file(out / CSV, stream.getvalue().encode())
    write_file(out / STANDINGS, (json.dumps(document(results), indent=1) + "\n").encode())
    if parquet:
        written.append(_write_parquet(table, out / PARQUET))
    return written


def _safe_cell(value: Any) -> Any:
    """Text that a spreadsheet would take for a formula is shown as text."""
    if isinstance(value, str) and value[:1] in ("=", "+", "-", "@"):
        return f"'{value}"
    return value


def _write_parquet(table: list[dict[str, Any]], file: Path) -> Path:
    from crazyarena.errors import DependencyMissing

    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise DependencyMissing("pyarrow", "parquet", "results.parquet") from None
    try:
        pyarrow.parquet.write_table(pyarrow.Table.from_pylist(table), file)
    except OSError as error:
        raise InputError(f"{file}: cannot write it: {error}") from error
    return file


def document(results: Results) -> dict[str, Any]:
    """``standings.json``."""
    standings, plan = results.standings, results.tournament.plan
    return {
        "title": plan.title,
        "created": plan.created,
        "rules": results.tournament.rules.name,
        "complete": results.complete,
        "remarks": results.remarks,
        "options": asdict(plan.options),
        "teams": [
            {
                "place": standings.places[team.slug],
                "team": team.name,
                "points": standings.totals[team.slug],
                "value": standings.values[team.slug],
                "levels_qualified": standings.qualified[team.slug],
                "contract": team.contract,
                "archive_sha256": team.archive,
                "commit": team.commit,
                "trouble": team.trouble,
                "levels": {
                    level.key: _cell_document(results.cells[team.slug, level.key])
                    for level in results.levels
                    if (team.slug, level.key) in results.cells
                },
            }
            for team in results.teams
        ],
        "comparisons": [
            {"first": a.name, "second": b.name, **asdict(c), "words": c.words}
            for a, b, c in results.comparisons
        ],
    }


def _cell_document(cell: Cell) -> dict[str, Any]:
    return {
        "flown": len(cell.episodes),
        "planned": cell.planned,
        "successes": cell.successes,
        "success_rate": cell.rate,
        "success_interval": cell.interval,
        "median_time": cell.median,
        "median_interval": cell.spread,
        "compute_p99_ms": cell.compute,
        "noise_p99_ms": cell.noise,
        "causes": dict(cell.causes),
        "qualified": cell.score.qualified,
        "points": cell.score.points,
        "categories": {name: asdict(c) for name, c in cell.score.categories.items()},
    }
