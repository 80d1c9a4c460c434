"""A tournament on the terminal: the table, and the same live while it flies."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from rich import box
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from crazyarena.runner.tournament.results import Cell, Results
from crazyarena.runner.tournament.rules import Overall
from crazyarena.runner.tournament.run import Tournament

_REDRAW = 1.0  # s
_MOST_CAUSES = 2


def leaderboard(results: Results) -> Table:
    """Teams by place, a column a level."""
    rules, standings = results.tournament.rules, results.standings
    by_points = rules.overall is Overall.POINTS
    table = Table(box=box.SIMPLE, header_style="bold", collapse_padding=True, pad_edge=False)
    table.add_column("", justify="right")
    table.add_column("team", overflow="fold")
    table.add_column("points" if by_points else "value", justify="right")
    for level in results.levels:
        table.add_column(escape(level.name), justify="right", no_wrap=True)
    for team in results.teams:
        value = standings.values[team.slug]
        shown = f"{standings.totals[team.slug]:g}" if by_points else _number(value)
        cells = [
            _short(results.cells.get((team.slug, level.key)), by_points) for level in results.levels
        ]
        nothing = standings.qualified[team.slug] == 0
        place = "-" if nothing else str(standings.places[team.slug])
        table.add_row(place, escape(team.name), shown, *cells, style="dim" if nothing else None)
    return table


def _short(cell: Cell | None, by_points: bool) -> str:
    if cell is None:
        return ""
    if cell.score.qualified:
        text = f"{cell.successes}/{len(cell.episodes)}"
        if cell.median is not None:
            text += f" {cell.median:.2f} s"
        if by_points and cell.score.points:
            text = f"[bold]+{cell.score.points:g}[/bold] {text}"
        return f"[green]{text}[/green]"
    return f"[red]{cell.successes}/{len(cell.episodes)}[/red]" if cell.episodes else "-"


def details(results: Results) -> list[Table]:
    """A table a level: rates, times, thinking and failures, with how sure they are."""
    return [_level_table(results, level.key, level.name) for level in results.levels]


def _level_table(results: Results, key: str, name: str) -> Table:
    table = Table(title=escape(name), title_justify="left", box=box.SIMPLE, header_style="bold",
                  collapse_padding=True, pad_edge=False)  # fmt: skip
    table.add_column("team", overflow="fold")
    for head in ("success", "95 %", "median s", "95 %", "thinking\np99 ms", "machine\np99 ms"):
        table.add_column(head, justify="right", no_wrap=True)
    for category in results.tournament.rules.categories:
        table.add_column(escape(category.name), justify="right")
    table.add_column("failures", overflow="fold")
    for team in results.teams:
        cell = results.cells.get((team.slug, key))
        if cell is None:
            continue
        scores = []
        for category in results.tournament.rules.categories:
            placed = cell.score.categories[category.name]
            points = f" +{placed.points:g}" if placed.points else ""
            scores.append("-" if placed.value is None else f"{placed.value:.3f}{points}")
        causes = "; ".join(f"{n} × {escape(c)}" for c, n in cell.causes[:_MOST_CAUSES])
        more = len(cell.causes) - _MOST_CAUSES
        table.add_row(
            escape(team.name),
            f"{cell.successes}/{len(cell.episodes)}",
            _range(cell.interval, 100.0, 0),
            _number(cell.median),
            _range(cell.spread, 1.0, 2),
            _number(cell.compute),
            _number(cell.noise),
            *scores,
            causes + (f"; {more} more" if more > 0 else ""),
        )
    return table


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _range(interval: tuple[float, float] | None, factor: float, digits: int) -> str:
    if interval is None:
        return "-"
    low, high = (factor * x for x in interval)
    return f"{low:.{digits}f}–{high:.{digits}f}"


def comparisons(results: Results) -> Table | None:
    """Each team and the next one on the same draws; None for a team alone."""
    if not results.comparisons:
        return None
    table = Table(title="On the same draws", title_justify="left", box=box.SIMPLE,
                  header_style="bold", collapse_padding=True, pad_edge=False)  # fmt: skip
    for head in ("team", "against", ""):
        table.add_column(head, overflow="fold")
    for first, second, comparison in results.comparisons:
        words = comparison.words
        winner = {"first": first.name, "second": second.name}.get(comparison.better or "")
        table.add_row(
            escape(first.name),
            escape(second.name),
            escape(f"{winner}: {words}" if winner else words),
        )
    return table


def tell(results: Results, console: Console, every_level: bool = True) -> None:
    """Print everything."""
    console.print(leaderboard(results))
    if every_level:
        for table in details(results):
            console.print(table)
    pairs = comparisons(results)
    if pairs is not None:
        console.print(pairs)
    for remark in results.remarks:
        console.print(remark, style="yellow", markup=False, highlight=False, soft_wrap=True)


class Watch:
    """The state of the work, per team and level, live on a terminal.

    Parameters
    ----------
    workers: how many fly at once. full: the table; otherwise one line.
    """

    def __init__(
        self,
        tournament: Tournament,
        console: Console,
        workers: int,
        full: bool,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._tournament = tournament
        self._workers = max(1, workers)
        self._full = full and console.is_terminal
        self._clock = clock
        self._began = clock()
        self._drawn = -_REDRAW
        self._fresh = 0
        self._console = console
        self._live = Live(Text(""), console=console, auto_refresh=False, transient=True)

    def __enter__(self) -> Watch:
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, *exc: object) -> None:
        if self._console.is_terminal:
            self._live.stop()

    def flown(self, lines: Sequence[Mapping[str, Any]]) -> None:
        """Episodes have come back."""
        self._fresh += len(lines)
        if self._console.is_terminal or not lines:
            return
        plan = self._tournament.plan
        team = next(t.name for t in plan.teams if t.slug == lines[0]["team"])
        clean = sum(bool(line["clean"]) for line in lines)
        text = f"{self.done()} of {self._tournament.total}: {team} on "
        text += f"{plan.level(lines[0]['level']).name}, {clean} of {len(lines)} clean"
        self._console.print(text, markup=False, highlight=False, soft_wrap=True)

    def tick(self) -> None:
        """Called often; draws now and then."""
        now = self._clock()
        if not self._console.is_terminal or now - self._drawn < _REDRAW:
            return
        self._drawn = now
        self._live.update(self.render(), refresh=True)

    def left(self) -> float | None:
        """s until all is flown, by how fast it went so far; None when nothing has."""
        if not self._fresh:
            return None
        missing = self._tournament.total - self.done()
        return missing * (self._clock() - self._began) / self._fresh

    def done(self) -> int:
        """Episodes flown, of submissions that can be."""
        teams = {t.slug for t in self._tournament.plan.teams if t.archive is not None}
        lines = self._tournament.journal.episodes.values()
        return sum(e["team"] in teams and not e.get("trial") for e in lines)

    def render(self) -> RenderableType:
        """What is shown."""
        left = self.left()
        rest = "" if left is None else f", about {_duration(left)} left"
        head = Text(f"{self.done()} of {self._tournament.total} episodes{rest}", style="bold")
        return Group(head, _progress_table(self._tournament)) if self._full else head


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes:02d} min"
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"


def _progress_table(tournament: Tournament) -> Table:
    """Per team and level: clean of flown of all."""
    results = assemble_progress(tournament)
    table = Table(box=box.SIMPLE, header_style="bold", collapse_padding=True, pad_edge=False)
    table.add_column("team", overflow="fold")
    for level in tournament.plan.levels:
        table.add_column(escape(level.name), justify="right", no_wrap=True)
    pairs = {(team.slug, level.key) for team, level in tournament.plan.pairs()}
    for team in tournament.plan.teams:
        cells = []
        for level in tournament.plan.levels:
            if (team.slug, level.key) not in pairs:
                cells.append("")
                continue
            clean, flown = results.get((team.slug, level.key), (0, 0))
            style = "dim" if not flown else "green" if clean == flown else "yellow"
            style = "red" if flown and not clean else style
            cells.append(f"[{style}]{clean}/{flown}[/{style}][dim] of {level.draws}[/dim]")
        table.add_row(escape(team.name), *cells)
    return table


def assemble_progress(tournament: Tournament) -> dict[tuple[str, str], tuple[int, int]]:
    """Clean and flown episodes by team and level."""
    found: dict[tuple[str, str], tuple[int, int]] = {}
    for line in tournament.journal.episodes.values():
        if not line.get("trial"):
            key = (line["team"], line["level"])
            clean, flown = found.get(key, (0, 0))
            found[key] = (clean + bool(line["clean"]), flown + 1)
    return found
