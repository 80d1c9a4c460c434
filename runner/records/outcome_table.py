"""What became of a trial, for a terminal of any width: a table, its score, and what stands out."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from crazyarena.levels.schema import Level
from crazyarena.plain_text import shown_line
from crazyarena.runner.judging.result import EpisodeResult, TrialResult

_OUT_AFTER = 15  # missed ticks in a row, as fly and bench have it by default
_MANY = 0.01  # share of slow steps that is worth a line


def table(result: TrialResult) -> Any:
    """Rich table, a row an episode. What names the result is folded, never cut."""
    from rich import box
    from rich.markup import escape
    from rich.table import Table

    shown = Table(
        box=box.SIMPLE,
        header_style="bold",
        collapse_padding=True,
        pad_edge=False,
        caption=None if result.isolated else "not isolated",
    )
    shown.add_column("#", justify="right", no_wrap=True)
    shown.add_column("outcome", overflow="fold", min_width=14)
    for name in ("time s", "gates", "coll.", "viol."):
        shown.add_column(name, justify="right", no_wrap=True)
    shown.add_column("ms\np50/max", justify="right", no_wrap=True)
    for e in result.episodes:
        style = "green" if e.clean else "red"
        shown.add_row(
            str(e.index),
            f"[{style}]{escape(shown_line(e.why or e.termination))}[/{style}]",
            f"{e.flight_time:.3f}",
            f"{e.gates_passed}/{e.gates}",
            str(e.collisions),
            str(e.violations),
            computing(e.compute_ms),
        )
    return shown


def computing(milliseconds: Mapping[str, float] | None) -> str:
    """Median and largest time of computing, ms, to two digits or the unit."""
    if not milliseconds:
        return "-"
    times = (milliseconds["p50"], milliseconds["max"])
    return "/".join(f"{t:.2g}" if t < 99.5 else f"{t:.0f}" for t in times)


def score_line(result: TrialResult) -> str:
    """The competition's two measures, or why there are none."""
    score = result.score()
    if score["qualified"]:
        return (
            f"Score: A {score['A_flight_time']:.3f} s (flight time of the last episode), "
            f"B {score['B_total_time']:.3f} s (all flight and learning)"
        )
    if len(result.episodes) < result.requested:
        flown = f"{len(result.episodes)} of {result.requested} episodes were flown"
        return f"Score: none, {flown}"
    return "Score: none, the last episode was not completed without collision and violation"


def remarks(result: TrialResult, level: Level, seed: int | str) -> list[str]:
    """What a contestant should know of these flights, in plain sentences."""
    found = []
    slow = [e for e in result.episodes if e.steps and e.over_period > _MANY * e.steps]
    if slow:
        found.append(_slow(max(slow, key=lambda e: e.over_period / e.steps), level))
    if len(result.episodes) > 1 and level.reseed_on_reset:
        found.append(
            f"Same draw in all episodes (seed {seed}). Other ones: --seed N, or "
            "--set reseed_on_reset=false"
        )
    return found


def _slow(episode: EpisodeResult, level: Level) -> str:
    tick = 1.0 / level.control_frequency
    text = (
        f"Slow: {episode.over_period} of {episode.steps} steps took longer than a tick "
        f"({tick * 1e3:.0f} ms)"
    )
    if episode.missed_ticks:
        return f"{text}; {episode.missed_ticks} ticks passed without a command"
    if episode.compute_ms.get("p50", 0.0) * 1e-3 > _OUT_AFTER * tick:
        return f"{text}: on sim2real it would be out after {_OUT_AFTER * tick:.1f} s"
    return f"{text}: on sim2real its commands would come late"
