"""Points from episodes, by a rule set. Nothing here depends on the order of teams."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from crazyarena.runner.tournament.rules import (
    Best,
    Category,
    Measure,
    Overall,
    Rules,
    Statistic,
    Success,
    Ties,
    Which,
)

_SAME = 1e-9  # of times in s: below that two are equal

Episode = Mapping[str, Any]
"""A line of the journal."""


@dataclass(frozen=True, slots=True)
class Placed:
    """What a team got in a category: value, place (from 1) and points. All None, None, 0.0 for
    one that did not qualify."""

    value: float | None = None
    place: int | None = None
    points: float = 0.0


@dataclass
class TeamLevel:
    """A team on a level. categories: by name."""

    flown: int
    successes: int
    qualified: bool
    categories: dict[str, Placed] = field(default_factory=dict)

    @property
    def points(self) -> float:
        return sum(placed.points for placed in self.categories.values())


@dataclass
class Standings:
    """levels: teams by level; totals, values, qualified: by team (values of ``overall: value``);
    places: from 1, by team. order: teams, best first, equal ones by name."""

    levels: dict[str, dict[str, TeamLevel]]
    totals: dict[str, float]
    values: dict[str, float | None]
    qualified: dict[str, int]
    places: dict[str, int]
    order: list[str]


def is_success(episode: Episode, success: Success) -> bool:
    """Whether an episode counts as one."""
    return bool(episode["clean"] if success is Success.CLEAN else episode["completed"])


def score(
    rules: Rules,
    teams: Sequence[str],
    levels: Sequence[str],
    episodes: Mapping[tuple[str, str], Sequence[Episode]],
    planned: Mapping[tuple[str, str], int],
) -> Standings:
    """Who is where.

    Parameters
    ----------
    episodes: by (team, level), in the order of the draws. planned: how many there are to be; a
        team that has flown fewer does not qualify, and pairs that are missing are not flown at all.
    """
    table = {
        level: {
            team: _team_level(rules, episodes.get((team, level), ()), planned[team, level])
            for team in teams
            if (team, level) in planned
        }
        for level in levels
    }
    for rows in table.values():
        for category in rules.categories:
            values = {t: row.categories[category.name].value for t, row in rows.items()}
            for team, placed in place(category, values, rules.ties).items():
                rows[team].categories[category.name] = placed
    totals = {t: sum(r[t].points for r in table.values() if t in r) for t in teams}
    qualified = {t: sum(r[t].qualified for r in table.values() if t in r) for t in teams}
    first = rules.categories[0]
    values = {t: _sum([r[t].categories[first.name].value for r in table.values() if t in r])
              for t in teams}  # fmt: skip
    keys = {t: _key(rules, t, totals, values, qualified) for t in teams}
    order = sorted(teams, key=lambda t: (*keys[t], t))
    return Standings(table, totals, values, qualified, _places(order, keys), order)


def _key(
    rules: Rules,
    team: str,
    totals: Mapping[str, float],
    values: Mapping[str, float | None],
    qualified: Mapping[str, int],
) -> tuple[float, ...]:
    """Smaller is better."""
    if rules.overall is Overall.POINTS:
        return (-round(totals[team], 6),)
    value = values[team]
    sign = 1.0 if rules.categories[0].best is Best.LOWEST else -1.0
    return (-qualified[team], math.inf if value is None else round(sign * value, 9))


def _places(order: Sequence[str], keys: Mapping[str, tuple[float, ...]]) -> dict[str, int]:
    places: dict[str, int] = {}
    for index, team in enumerate(order):
        tied = index > 0 and keys[order[index - 1]] == keys[team]
        places[team] = places[order[index - 1]] if tied else index + 1
    return places


def _sum(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) if known else None


def _team_level(rules: Rules, episodes: Sequence[Episode], planned: int) -> TeamLevel:
    q = rules.qualification
    successes = sum(is_success(e, q.success) for e in episodes)
    looked_at = episodes[-1:] if q.episodes is Which.LAST else episodes
    complete = len(episodes) >= planned and len(episodes) > 0
    good = sum(is_success(e, q.success) for e in looked_at)
    qualified = complete and good >= q.rate * len(looked_at) - _SAME
    row = TeamLevel(len(episodes), successes, qualified)
    for category in rules.categories:
        value = _value(category, episodes, q.success) if qualified else None
        row.categories[category.name] = Placed(value)
    return row


def _value(category: Category, episodes: Sequence[Episode], success: Success) -> float | None:
    if category.episodes is Which.LAST:
        episodes = episodes[-1:]
    elif category.episodes is Which.SUCCESSFUL:
        episodes = [e for e in episodes if is_success(e, success)]
    values = [measured(category.measure, e, success) for e in episodes]
    known = [value for value in values if value is not None]
    if not known or len(known) < len(values):
        return None
    match category.statistic:
        case Statistic.MEAN:
            return statistics.fmean(known)
        case Statistic.MEDIAN:
            return statistics.median(known)
        case Statistic.SUM:
            return math.fsum(known)
    lowest = (category.best is Best.LOWEST) == (category.statistic is Statistic.BEST)
    return min(known) if lowest else max(known)


def measured(measure: Measure, episode: Episode, success: Success) -> float | None:
    """A measure of one episode; None where it was not taken."""
    match measure:
        case Measure.FLIGHT_TIME:
            return float(episode["flight_time"])
        case Measure.TOTAL_TIME:
            return float(episode["flight_time"]) + float(episode["learning_time"])
        case Measure.LEARNING_TIME:
            return float(episode["learning_time"])
        case Measure.COMPUTE_TIME:
            p99 = episode["compute_ms"].get("p99")
            return None if p99 is None else float(p99)
        case Measure.GATES:
            return float(episode["gates_passed"])
        case Measure.SUCCESS:
            return float(is_success(episode, success))


def place(
    category: Category, values: Mapping[str, float | None], ties: Ties = Ties.SAME
) -> dict[str, Placed]:
    """Places and points of the teams that have a value; the others get none.

    Equal values share a place, and the next one leaves out as many.
    """
    sign = 1.0 if category.best is Best.LOWEST else -1.0
    order = sorted((sign * v, team) for team, v in values.items() if v is not None)
    result = {team: Placed() for team in values}
    start = 0
    while start < len(order):
        end = start + 1
        # To the first of them: a chain of near ones must not tie what lies apart.
        while end < len(order) and order[end][0] - order[start][0] <= _SAME:
            end += 1
        worth = [category.points[k] if k < len(category.points) else 0.0 for k in range(start, end)]
        points = worth[0] if ties is Ties.SAME else math.fsum(worth) / len(worth)
        for _, team in order[start:end]:
            result[team] = Placed(values[team], start + 1, category.weight * points)
        start = end
    return result
