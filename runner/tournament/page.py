"""The page: who won, how sure that is, and what became of every flight. No server, no network.

``index.html`` for all, ``teams/<team>.html`` with a report of every episode; each is one file with
its style, its script and its drawings in it.
"""

from __future__ import annotations

import itertools
import math
import re
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from crazyarena.errors import DependencyMissing, InputError
from crazyarena.runner.tournament import scoring
from crazyarena.runner.tournament.plan import Team, write_file
from crazyarena.runner.tournament.results import (
    CSV,
    PARQUET,
    STANDINGS,
    Cell,
    Level,
    Results,
    rows,
)
from crazyarena.runner.tournament.rules import Best, Overall

INDEX, TEAMS = "index.html", "teams"
_FOLDER = Path(__file__).parent / "templates"
_GATE = 0.25  # m, half of a gate's width
_CROSS = 8  # cm
_EDGE = 30  # cm around what is drawn
_MOST_CAUSES = 4
_FARTHEST = 1000  # cm: what flies away further is not followed


@dataclass(frozen=True)
class _Map:
    """A level from above, cm, y down as screens have it."""

    key: str
    x: int
    y: int
    w: int
    h: int
    gates: list[tuple[int, int, int, int]]
    obstacles: list[tuple[int, int]]

    @property
    def box(self) -> str:
        return f"{self.x} {self.y} {self.w} {self.h}"


@dataclass(frozen=True)
class _Flights:
    """SVG path data of clean flights, of others, and of crosses where those ended."""

    ok: str
    no: str
    end: str

    @property
    def any(self) -> bool:
        return bool(self.ok or self.no)


def write_pages(results: Results) -> Path:
    """Write all pages; returns the first one.

    Raises
    ------
    DependencyMissing: jinja2 is not installed. InputError: no room.
    """
    try:
        import jinja2
    except ImportError:
        raise DependencyMissing("jinja2", "tournament", "a tournament's page") from None
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(_FOLDER), autoescape=True, trim_blocks=True
    )
    from markupsafe import Markup

    environment.globals |= {
        "css": Markup((_FOLDER / "style.css").read_text("utf-8")),
        "js": Markup((_FOLDER / "page.js").read_text("utf-8")),
        "title": results.tournament.plan.title,
    }
    out = results.tournament.out
    maps = {level.key: _map(level, results) for level in results.levels}
    try:
        (out / TEAMS).mkdir(exist_ok=True)
    except OSError as error:
        raise InputError(f"{out / TEAMS}: cannot make this folder: {error.strerror}") from error
    team_page = environment.get_template("team.html.j2")
    by_team: dict[str, list[dict[str, Any]]] = {}
    for row in rows(results):
        by_team.setdefault(row["team"], []).append(row)
    for team in results.teams:
        text = team_page.render(**_team(results, team, maps, by_team.get(team.name, [])))
        write_file(out / TEAMS / f"{team.slug}.html", text.encode())
    page = environment.get_template("index.html.j2").render(**_index(results, maps))
    write_file(out / INDEX, page.encode())
    return out / INDEX


def _id(key: str) -> str:
    return re.sub(r"[^A-Za-z0-9_-]", "_", key)


def _index(results: Results, maps: Mapping[str, _Map]) -> dict[str, Any]:
    rules, standings = results.tournament.rules, results.standings
    by_points = rules.overall is Overall.POINTS
    lowest = rules.categories[0].best is Best.LOWEST
    out = results.tournament.out
    return {
        "rules": rules.name,
        "created": results.tournament.plan.created.replace("T", " ").replace("+00:00", " UTC"),
        "episodes": len(results.tournament.journal.episodes),
        "remarks": results.remarks,
        "value_name": "Points" if by_points else rules.categories[0].name.capitalize(),
        "value_first": "ascending" if not by_points and lowest else "descending",
        "categories": [category.name for category in rules.categories],
        "maps": list(maps.values()),
        "teams": [
            {
                "slug": team.slug,
                "name": team.name,
                "place": standings.places[team.slug],
                "qualified": standings.qualified[team.slug],
                "value": standings.totals[team.slug] if by_points else standings.values[team.slug],
                "shown": f"{standings.totals[team.slug]:g}"
                if by_points
                else _number(standings.values[team.slug], 2),
                "cells": [
                    _short(results.cells.get((team.slug, level.key)), by_points)
                    for level in results.levels
                ],
            }
            for team in results.teams
        ],
        "levels": [
            {
                "key": _id(level.key),
                "name": level.name,
                "map": maps[level.key],
                "rows": _rows(results, level),
            }
            for level in results.levels
        ],
        "comparisons": [
            {
                "first": first.name,
                "second": second.name,
                "winner": {"first": first.name, "second": second.name}.get(c.better or ""),
                "words": c.words,
            }
            for first, second, c in results.comparisons
        ],
        "files": [name for name in (CSV, PARQUET, STANDINGS) if (out / name).exists()],
    }


def _short(cell: Cell | None, by_points: bool) -> dict[str, Any]:
    if cell is None or not cell.episodes:
        return {"text": "", "sort": "", "qualified": False, "time": ""}
    points = f"+{cell.score.points:g}  " if by_points and cell.score.points else ""
    sort = cell.score.points * 1e4 + (cell.rate or 0.0)
    return {
        "text": f"{points}{cell.successes}/{len(cell.episodes)}",
        "sort": f"{sort:.6f}",
        "qualified": cell.score.qualified,
        "time": "" if cell.median is None else f"{cell.median:.2f} s",
    }


def _rows(results: Results, level: Level) -> list[dict[str, Any]]:
    cells = [
        (team, results.cells[team.slug, level.key])
        for team in results.teams
        if (team.slug, level.key) in results.cells
    ]
    times = [t for _, c in cells if c.median is not None for t in (*(c.spread or ()), c.median)]
    low, high = (min(times), max(times)) if times else (0.0, 1.0)
    span = max(high - low, 1e-6)

    def scaled(value: float) -> float:
        return round(2.0 + 96.0 * (value - low) / span, 1)

    found = []
    for team, cell in cells:
        middle = cell.median if cell.median is not None else 0.0
        rate = cell.rate if cell.rate is not None else 0.0
        interval, spread = cell.interval, cell.spread or (middle, middle)
        found.append(
            {
                "slug": team.slug,
                "name": team.name,
                "qualified": cell.score.qualified,
                "rate": cell.rate,
                "success": _success(cell),
                "success_bar": (None, None, None)
                if interval is None
                else tuple(round(100.0 * x, 1) for x in (interval[0], rate, interval[1])),
                "median": cell.median,
                "time": _time(cell),
                "time_bar": (None, None, None)
                if cell.median is None
                else tuple(scaled(x) for x in (spread[0], middle, spread[1])),
                "compute": cell.compute,
                "thinking": "–"
                if cell.compute is None
                else f"{cell.compute:.2f} ms (machine {_number(cell.noise, 2)})",
                "categories": [_category(c) for c in cell.score.categories.values()],
                "causes": cell.causes[:_MOST_CAUSES],
                "flights": flights(cell.episodes),
            }
        )
    return found


def _category(placed: scoring.Placed) -> dict[str, Any]:
    return {
        "value": placed.value,
        "shown": _number(placed.value, 2),
        "points": f"{placed.points:g}" if placed.points else "",
    }


def _success(cell: Cell) -> str:
    text = f"{cell.successes}/{len(cell.episodes)}"
    if cell.interval is None:
        return text
    return f"{text} ({100 * cell.interval[0]:.0f}–{100 * cell.interval[1]:.0f} %)"


def _time(cell: Cell) -> str:
    if cell.median is None:
        return "–"
    text = f"{cell.median:.2f} s"
    return text if cell.spread is None else f"{text} ({cell.spread[0]:.2f}–{cell.spread[1]:.2f})"


def _number(value: float | None, digits: int) -> str:
    return "–" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"


def _team(
    results: Results,
    team: Team,
    maps: Mapping[str, _Map],
    own: Sequence[Mapping[str, Any]],
) -> dict[str, Any]:
    standings = results.standings
    by_points = results.tournament.rules.overall is Overall.POINTS
    blocks = {level.key: level.blocks for level in results.tournament.plan.levels}
    files = {(row["level"], row["draw"]): row["draw_file"] for row in own if row["draw_file"]}
    success = results.tournament.rules.qualification.success
    name = shlex.quote(Path(team.source).name)
    levels = []
    for level in results.levels:
        cell = results.cells.get((team.slug, level.key))
        if cell is None:
            continue
        episodes = []
        for e in cell.episodes:
            draw_file = None if e.get("trial") else files.get((level.key, e["draw"]))
            nth = 0
            for draws in blocks.get(level.key, ()):
                if e["draw"] in draws and len(draws) > 1:
                    nth = draws.index(e["draw"]) + 1
            episodes.append(
                {
                    "draw": e["draw"],
                    "anchor": f"{_id(level.key)}-{e['draw']}",
                    "success": scoring.is_success(e, success),
                    "outcome": e["outcome"],
                    "why": e["why"] or e["outcome"],
                    "time": e["flight_time"],
                    "time_shown": _number(e["flight_time"], 3),
                    "learning": e["learning_time"],
                    "learning_shown": _number(e["learning_time"], 3),
                    "gates_passed": e["gates_passed"],
                    "gates": e["gates"],
                    "compute": e["compute_ms"].get("p99", ""),
                    "compute_shown": f"{_number(e['compute_ms'].get('p50'), 2)} / "
                    f"{_number(e['compute_ms'].get('p99'), 2)}",
                    "noise": _number(e["noise_ms"].get("p99"), 2),
                    "place": None
                    if e["place"] is None
                    else ", ".join(f"{x:.2f}" for x in e["place"]),
                    "events": e["events"],
                    "notes": e.get("notes", []),
                    "error": e["error"],
                    "recording": e.get("recording"),
                    "draw_file": draw_file,
                    "nth": nth,
                    "replay": draw_file
                    and f"crazyarena dry-run {name} --draw {draw_file} --sandbox",
                    "flights": flights([e]),
                }
            )
        levels.append(
            {"key": _id(level.key), "name": level.name, "map": maps[level.key],
             "episodes": episodes}
        )  # fmt: skip
    total = (
        f"{standings.totals[team.slug]:g} points"
        if by_points
        else ("" if standings.values[team.slug] is None else f"{standings.values[team.slug]:.2f}")
    )
    place = f"place {standings.places[team.slug]}"
    qualified = standings.qualified[team.slug] > 0
    return {
        "team": team,
        "shown": f"{place}, {total}" if qualified else "not qualified on any level",
        "levels": levels,
        "maps": list(maps.values()),
    }


def _map(level: Level, results: Results) -> _Map:
    gates = []
    for x, y, yaw in level.gates:
        a, b = _GATE * math.cos(yaw), _GATE * math.sin(yaw)
        gates.append((*_cm(x - a, y - b), *_cm(x + a, y + b)))
    obstacles = [_cm(x, y) for x, y in level.obstacles]
    points = [*obstacles, *(g[:2] for g in gates), *(g[2:] for g in gates)]
    for (_, key), cell in results.cells.items():
        if key == level.key:
            points += [_cm(p[0], p[1]) for e in cell.episodes if e["clean"] for p in e["path"]]
    xs, ys = [p[0] for p in points] or [-100, 100], [p[1] for p in points] or [-100, 100]
    x, y = min(xs) - _EDGE, min(ys) - _EDGE
    return _Map(_id(level.key), x, y, max(xs) + _EDGE - x, max(ys) + _EDGE - y, gates, obstacles)


def _cm(x: float, y: float) -> tuple[int, int]:
    limit = _FARTHEST
    return (
        max(-limit, min(limit, round(100.0 * x))),
        max(-limit, min(limit, round(-100.0 * y))),
    )


def flights(episodes: Iterable[Mapping[str, Any]]) -> _Flights:
    """Paths of episodes as SVG path data, cm."""
    ok, no, end = [], [], []
    for e in episodes:
        points = [_cm(p[0], p[1]) for p in e["path"]]
        if not points:
            continue
        steps = [f"M{points[0][0]} {points[0][1]}l"]
        for (a, b), (c, d) in itertools.pairwise(points):
            steps.append(f"{c - a} {d - b} ")
        text = "".join(steps).rstrip("l ")
        if e["clean"]:
            ok.append(text)
        else:
            no.append(text)
            x, y = points[-1]
            k = _CROSS
            end.append(f"M{x - k} {y - k}l{2 * k} {2 * k}m0 {-2 * k}l{-2 * k} {2 * k}")
    return _Flights("".join(ok), "".join(no), "".join(end))
