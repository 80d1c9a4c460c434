"""One submission with many values of its parameters, or of a level's: the same engine, a table and
a heat map. Every combination meets the same worlds."""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rich import box
from rich.markup import escape
from rich.table import Table

from crazyarena.errors import InputError
from crazyarena.levels.competition import owns
from crazyarena.levels.document import parse
from crazyarena.levels.lsy import is_lsy_level
from crazyarena.levels.schema import Level
from crazyarena.runner.tournament.entries import LSY, find_entries
from crazyarena.runner.tournament.journal import Journal
from crazyarena.runner.tournament.plan import (
    PLAN,
    SUBMISSIONS,
    Options,
    Plan,
    PlannedLevel,
    Team,
    now,
    plan_level,
    read_plan,
    secret_seeds,
    write_file,
    write_plan,
)
from crazyarena.runner.tournament.results import Results
from crazyarena.runner.tournament.rules import Lives, parse_rules
from crazyarena.runner.tournament.run import Tournament, pack_all

MOST = 1000
"""Combinations."""
SUMMARY, FIGURE = "sweep.json", "sweep.png"
_BLOCK = 10  # draws that one controller lives through
_LSY_SECTIONS = ("env", "sim", "deploy", "controller", "rng")
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_.\[\]]{0,99}")
_RULES = """\
name: sweep
controller: level
qualification: {rate: 0.0}
categories:
  - {name: successes, measure: success, episodes: all, statistic: mean, best: highest}
overall: value
"""


@dataclass(frozen=True)
class Axis:
    """A name and its values, as written. of_level: a field of the level, not the submission's."""

    name: str
    values: tuple[str, ...]
    of_level: bool


def parse_axis(text: str, lsy: bool = False) -> Axis:
    """``name=1,2,3``; commas in brackets or quotes belong to a value.

    A name whose first part is a field of levels is the level's; ``level.`` or ``submission.`` in
    front says which it is.

    Raises
    ------
    InputError: it is none.
    """
    name, equals, values = text.partition("=")
    name = name.strip()
    if not equals or not _NAME.fullmatch(name):
        raise InputError(f"--set {text[:80]}: expected name=value,value,...")
    found = tuple(_split(values))
    if not found or any(not value for value in found):
        raise InputError(f"--set {text[:80]}: a value is empty")
    if len(set(found)) < len(found):
        raise InputError(f"--set {text[:80]}: a value is there twice")
    for value in found:
        parse(value, f"--set {name}", lines=False)  # refuses what is no YAML
    owner, _, rest = name.partition(".")
    if owner in ("level", "submission") and rest:
        return Axis(rest, found, owner == "level")
    first = re.split(r"[.\[]", name)[0]
    fields = _LSY_SECTIONS if lsy else Level.model_fields
    return Axis(name, found, first in fields or (not lsy and owns(first)))


def _split(text: str) -> list[str]:
    parts, depth, quote, start = [], 0, "", 0
    for index, letter in enumerate(text):
        if quote:
            quote = "" if letter == quote else quote
        elif letter in "\"'":
            quote = letter
        elif letter in "[{(":
            depth += 1
        elif letter in "]})":
            depth -= 1
        elif letter == "," and depth == 0:
            parts.append(text[start:index].strip())
            start = index + 1
    return [*parts, text[start:].strip()]


def open_sweep(
    submission: Path,
    sets: Sequence[str],
    levels: Sequence[str] | None,
    out: Path,
    seeds: int = 50,
    compute: str = "free",
    record: bool = False,
) -> tuple[Tournament, list[Axis]]:
    """Begin a sweep in ``out``, or go on with the same one.

    Raises
    ------
    InputError: something is wrong; nothing has flown.
    """
    options = Options(seeds=seeds, compute=compute, record=record)
    options.check()
    entries = find_entries(submission)
    if len(entries) != 1:
        raise InputError(f"{submission}: {len(entries)} submissions; a sweep is of one")
    entry = entries[0]
    names = list(levels or (["lsy/level2"] if entry.contract == LSY else ["level2"]))
    lsy = entry.contract == LSY
    for name in names:
        if (is_lsy_level(name) or name.startswith("lsy/")) != lsy:
            raise InputError(f"--levels {name}: not a level of this submission's contract")
    axes = [parse_axis(text, lsy) for text in sets]
    if not axes:
        raise InputError("--set: nothing to sweep. Pass --set name=value,value")
    if len({(axis.name, axis.of_level) for axis in axes}) < len(axes):
        raise InputError("--set: a name is there twice")
    combinations = list(itertools.product(*(axis.values for axis in axes)))
    if len(combinations) > MOST:
        raise InputError(f"--set: {len(combinations)} combinations; at most {MOST}")
    try:
        (out / SUBMISSIONS).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"--out {out}: cannot make this folder: {error.strerror}") from error
    packed = pack_all([entry], out)[0]
    if packed.archive is None:
        raise InputError(str(packed.trouble))
    plan = _plan(packed, axes, combinations, names, options)
    if (out / PLAN).is_file():
        before = read_plan(out)
        same = (
            [(t.name, t.archive, t.levels) for t in before.teams],
            [level.name for level in before.levels],
            before.options,
        ) == (
            [(t.name, t.archive, t.levels) for t in plan.teams],
            [level.name for level in plan.levels],
            options,
        )
        if not same:
            raise InputError(f"--out {out}: another sweep was begun here. Pass another --out")
        plan = before
    else:
        write_plan(plan, out)
    return Tournament(out, plan, parse_rules(plan.rules), Journal(out)), axes


def _plan(
    packed: Team,
    axes: Sequence[Axis],
    combinations: Sequence[tuple[str, ...]],
    names: Sequence[str],
    options: Options,
) -> Plan:
    variants: dict[tuple[str, tuple[str, ...]], PlannedLevel] = {}
    seeds = {name: secret_seeds(options.seeds) for name in names}
    teams = []
    for index, values in enumerate(combinations):
        overrides = tuple(
            f"{axis.name}={value}"
            for axis, value in zip(axes, values, strict=True)
            if axis.of_level
        )
        parameters = {
            axis.name: parse(value, axis.name, lines=False).plain()
            for axis, value in zip(axes, values, strict=True)
            if not axis.of_level
        }
        keys = []
        for name in names:
            if (name, overrides) not in variants:
                base = plan_level(name, (0,), Lives.LEVEL).key
                number = sum(other == name for other, _ in variants)
                key = f"{base}-{number:03d}" if overrides else base
                level = plan_level(name, seeds[name], Lives.LEVEL, overrides, key, _BLOCK)
                shown = f"{level.name} {' '.join(overrides)}" if overrides else level.name
                variants[name, overrides] = replace(level, name=shown)
            keys.append(variants[name, overrides].key)
        label = ", ".join(f"{a.name}={v}" for a, v in zip(axes, values, strict=True))
        teams.append(
            replace(packed, name=label, slug=f"c{index:04d}", levels=tuple(keys),
                    parameters=parameters)
        )  # fmt: skip
    return Plan(
        tuple(teams), tuple(variants.values()), options, _RULES, f"sweep of {packed.name}", now()
    )


# What it comes to


@dataclass(frozen=True)
class Point:
    """A combination on a level: values as written, successes and times as in the tables."""

    values: tuple[str, ...]
    level: str
    flown: int
    successes: int
    interval: tuple[float, float] | None
    median: float | None
    spread: tuple[float, float] | None


def points(results: Results, axes: Sequence[Axis], levels: Sequence[str]) -> list[Point]:
    """In the order of the combinations, level by level."""
    combinations = itertools.product(*(axis.values for axis in axes))
    found = []
    for team, values in zip(results.tournament.plan.teams, combinations, strict=True):
        for name, key in zip(levels, team.levels, strict=True):
            cell = results.cells[team.slug, key]
            found.append(
                Point(
                    values,
                    name,
                    len(cell.episodes),
                    cell.successes,
                    cell.interval,
                    cell.median,
                    cell.spread,
                )
            )
    return found


def table(axes: Sequence[Axis], found: Sequence[Point]) -> Table:
    """A row a combination; the best of a level in bold."""
    levels = list(dict.fromkeys(point.level for point in found))
    best = {
        level: max(
            (p for p in found if p.level == level),
            key=lambda p: (p.successes / max(1, p.flown), -(p.median or 1e9)),
        )
        for level in levels
    }
    shown = Table(box=box.SIMPLE, header_style="bold", collapse_padding=True, pad_edge=False)
    for axis in axes:
        shown.add_column(escape(axis.name), justify="right")
    for level in levels:
        shown.add_column(f"{escape(level)}\nsuccess", justify="right", no_wrap=True)
        shown.add_column("95 %", justify="right", no_wrap=True)
        shown.add_column("median s", justify="right", no_wrap=True)
    rows: dict[tuple[str, ...], list[Point]] = {}
    for point in found:
        rows.setdefault(point.values, []).append(point)
    for values, own in rows.items():
        cells = []
        for point in own:
            low, high = point.interval or (0.0, 1.0)
            bold = "bold" if point is best[point.level] and point.successes else "default"
            time = "-" if point.median is None else f"{point.median:.2f}"
            cells += [
                f"[{bold}]{point.successes}/{point.flown}[/]",
                f"{100 * low:.0f}–{100 * high:.0f}",
                f"[{bold}]{time}[/]",
            ]
        shown.add_row(*map(escape, values), *cells)
    return shown


def write_summary(out: Path, axes: Sequence[Axis], found: Sequence[Point]) -> Path:
    """Write ``sweep.json``; raises InputError when there is no room."""
    document: dict[str, Any] = {
        "axes": [
            {
                "name": a.name,
                "values": list(a.values),
                "of": "level" if a.of_level else "submission",
            }
            for a in axes
        ],
        "points": [
            {
                "values": dict(zip((a.name for a in axes), p.values, strict=True)),
                "level": p.level,
                "flown": p.flown,
                "successes": p.successes,
                "success_interval": p.interval,
                "median_time": p.median,
                "median_interval": p.spread,
            }
            for p in found
        ],
    }
    write_file(out / SUMMARY, (json.dumps(document, indent=1) + "\n").encode())
    return out / SUMMARY


def save_figure(file: Path, axes: Sequence[Axis], found: Sequence[Point]) -> None:
    """A heat map a level: success rate by colour, with successes and median time written in.

    The first name goes along x; the others, if there are any, along y.
    """
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt
    import numpy as np

    levels = list(dict.fromkeys(point.level for point in found))
    across = axes[0].values
    down = list(itertools.product(*(axis.values for axis in axes[1:])))
    width, height = max(4.0, 1.0 + 0.95 * len(across)), max(2.2, 1.4 + 0.7 * len(down))
    figure, views = plt.subplots(
        1, len(levels), figsize=(width * len(levels), height), squeeze=False, layout="constrained"
    )
    image = None
    for view, level in zip(views[0], levels, strict=True):
        by_values = {p.values: p for p in found if p.level == level}
        rates = np.full((len(down), len(across)), np.nan)
        for i, rest in enumerate(down):
            for j, value in enumerate(across):
                point = by_values[(value, *rest)]
                if not point.flown:
                    continue
                rates[i, j] = point.successes / point.flown
                text = f"{point.successes}/{point.flown}"
                if point.median is not None:
                    text += f"\n{point.median:.2f} s"
                ink = "white" if rates[i, j] < 0.55 else "black"
                view.text(j, i, text, ha="center", va="center", color=ink, fontsize=8)
        image = view.imshow(rates, vmin=0.0, vmax=1.0, cmap="viridis", aspect="auto")
        view.set_title(level, fontsize=10)
        view.set_xticks(range(len(across)), across, fontsize=8)
        view.set_xlabel(axes[0].name)
        view.set_yticks(range(len(down)), [", ".join(rest) for rest in down], fontsize=8)
        view.set_ylabel(", ".join(axis.name for axis in axes[1:]))
    assert image is not None
    figure.colorbar(image, ax=views[0].tolist(), label="success rate")
    try:
        figure.savefig(file, dpi=120)
    except OSError as error:
        raise InputError(f"{file}: cannot write it: {error.strerror}") from error
    finally:
        plt.close(figure)
