"""Whether a submission keeps its contract, is in time and flies; what ``crazyarena check`` does.

It is flown in this process and behind walls, more than once, and what is compared are the
recordings: by the same level, seed and submission they are the same to the byte.
"""

from __future__ import annotations

import contextlib
import functools
import io
import itertools
import shlex
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from crazyarena.errors import CrazyarenaError, InputError
from crazyarena.levels import load_level
from crazyarena.plain_text import shown_line
from crazyarena.runner.check import source
from crazyarena.runner.check.source import Finding
from crazyarena.runner.contestant.contract_2022.command_check import VERBS
from crazyarena.runner.contestant.contract_lsy.submission import find_controller
from crazyarena.runner.records import export

LEVELS = {
    "2022": ("level0", "level1", "level2", "level3"),
    "lsy": ("lsy/level0", "lsy/level1", "lsy/level2", "lsy/level3"),
}
_SHOWN = 3  # levels that are always flown
_EPISODES = 3  # of each
_SEED = 7
_MANY = 0.01  # share of steps over the period that is too much
_MUCH = 64 * 1024  # bytes printed in an episode
_STREAM, _NEEDS_NOTICE = VERBS["FULLSTATE"], (VERBS["LAND"], VERBS["GOTO"], VERBS["TAKEOFF"])
_NOTICE = VERBS["NOTIFYSETPOINTSTOP"]


@dataclass
class _Flown:
    """Episodes of one level: what each ended with, whether it counts, and the slowest of it."""

    outcomes: list[str]
    completed: list[bool]
    times: list[float]
    p50: float
    longest: float
    slow: int
    steps: int
    printed: int
    seconds: float
    recordings: list[Path]
    error: str | None


def check(
    submission: Path,
    need: str | None = None,
    say: Callable[[str], None] = lambda text: None,
    overrides: Sequence[str] = (),
) -> list[Finding]:
    """Look at a submission of either contract, fly it, and say what was found.

    Parameters
    ----------
    need: hardest level that has to be completed; the contract's level 0 by default.
    say: told what happens now.
    overrides: ``FIELD=VALUE`` of every level, such as ``env.control_mode=attitude``.

    Raises
    ------
    InputError: it cannot be loaded at all, or ``need`` is none of the contract's levels.
    """
    path = submission.expanduser()
    contract = "2022" if find_controller(path) is None else "lsy"
    levels = LEVELS[contract]
    wanted = levels[0] if need is None else need
    if wanted not in levels:
        raise InputError(f"--need {wanted}: expected one of {', '.join(levels)}")
    last = max(_SHOWN, levels.index(wanted) + 1)
    with tempfile.TemporaryDirectory(prefix="crazyarena-check-") as folder:
        return list(_findings(path, contract, levels[:last], wanted, Path(folder), say, overrides))


def _findings(
    path: Path,
    contract: str,
    levels: Sequence[str],
    wanted: str,
    folder: Path,
    say: Callable[[str], None],
    overrides: Sequence[str],
) -> Iterator[Finding]:
    yield from source.findings(path, contract)
    if contract == "2022":
        overrides = ("reseed_on_reset=false", *overrides)
    fly = functools.partial(_fly_2022 if contract == "2022" else _fly_lsy, overrides)
    flights: dict[str, _Flown] = {}
    for level in levels:
        say(f"flying {level}")
        flights[level] = fly(path, level, folder / level.replace("/", "-"), _EPISODES, False)
    first = flights[levels[0]]
    if first.error is None:
        say("flying once more")
        again = fly(path, levels[0], folder / "again", _EPISODES, False)
        yield _repeatable(first, again)
        if sys.platform == "linux":
            say("flying behind walls")
            yield _behind_walls(first, path, levels[0], folder / "walls", fly)
    yield _in_time(list(flights.values()), contract)
    yield from _habits(first, contract)
    need_index = levels.index(wanted)
    for index, (level, flown) in enumerate(flights.items()):
        yield _level(level, flown, index <= need_index, path, overrides)


def _fly_2022(
    overrides: Sequence[str], path: Path, level: str, out: Path, episodes: int, sandbox: bool
) -> _Flown:
    from crazyarena.runner.dry_run import DryRun
    from crazyarena.runner.trial.options import FlightOptions

    period = 1.0 / load_level(level).control_frequency
    with _listening() as heard:
        run = DryRun(
            path,
            level,
            overrides=overrides,
            episodes=episodes,
            seed=_SEED,
            out=out,
            figure=False,
            console=Console(file=io.StringIO()),
            options=FlightOptions(sandbox=sandbox),
        )
        result = run.run()
    return _Flown(
        [e.why or e.termination for e in result.episodes],
        [e.clean for e in result.episodes],
        [e.flight_time for e in result.episodes],
        max((e.compute_ms.get("p50", 0.0) for e in result.episodes), default=0.0),
        max((e.compute_ms.get("max", 0.0) for e in result.episodes), default=0.0),
        sum(e.over_period for e in result.episodes),
        sum(e.steps for e in result.episodes),
        heard.tell(),
        period,
        sorted(out.glob("*.mcap")),
        result.error,
    )


def _fly_lsy(
    overrides: Sequence[str], path: Path, level: str, out: Path, episodes: int, sandbox: bool
) -> _Flown:
    from crazyarena.runner.lsy_run import LsyRun

    with _listening() as heard:
        run = LsyRun(
            path,
            level,
            overrides,
            episodes=episodes,
            seed=_SEED,
            out=out,
            sandbox=sandbox,
            console=Console(file=io.StringIO()),
        )
        result = run.run()
    period = 1e3 / run.level.env.freq
    return _Flown(
        ["; ".join([e.why or e.termination, *e.notes[:1]]) for e in result.episodes],
        [e.success for e in result.episodes],
        [e.time for e in result.episodes],
        max((e.compute_ms.get("p50", 0.0) for e in result.episodes), default=0.0),
        max((e.compute_ms.get("max", 0.0) for e in result.episodes), default=0.0),
        # How many is not counted there: a percentile beyond the period means a hundredth of them.
        sum(round(e.steps * _MANY) + 1 for e in result.episodes if _slow(e.compute_ms, period)),
        sum(e.steps for e in result.episodes),
        heard.tell(),
        period / 1e3,
        sorted(out.glob("*.mcap")),
        result.error,
    )


def _slow(compute_ms: dict[str, float], period: float) -> bool:
    return compute_ms.get("p99", 0.0) > period


@contextlib.contextmanager
def _listening() -> Iterator[io.TextIOBase]:
    """Count what a submission prints, and keep it off the table."""
    heard = io.StringIO()
    with contextlib.redirect_stdout(heard), contextlib.redirect_stderr(heard):
        yield heard


def _repeatable(first: _Flown, again: _Flown) -> Finding:
    same = [a.read_bytes() == b.read_bytes() for a, b in zip(*_pairs(first, again), strict=True)]
    if all(same) and len(first.recordings) == len(again.recordings):
        return Finding("repeatable", True, "the same flight, byte for byte, when flown again")
    return Finding(
        "repeatable",
        None,
        "another flight when flown again",
        "Draw random numbers from numpy.random.default_rng(SEED), and never plan by the clock.",
    )


def _pairs(first: _Flown, other: _Flown) -> tuple[list[Path], list[Path]]:
    count = min(len(first.recordings), len(other.recordings))
    return first.recordings[:count], other.recordings[:count]


def _behind_walls(
    first: _Flown, path: Path, level: str, out: Path, fly: Callable[..., _Flown]
) -> Finding:
    name = "behind walls"
    remedy = "Where results count it has its own folder alone: no other files, no network."
    try:
        flown = fly(path, level, out, 1, True)
    except CrazyarenaError as error:
        return Finding(name, False, shown_line(str(error), 400), remedy)
    if flown.completed[:1] == first.completed[:1]:
        return Finding(name, True, "flies as well in the sandbox")
    found = f"in the sandbox: {shown_line((flown.error or flown.outcomes[0]).splitlines()[-1])}"
    return Finding(name, False, found, remedy)


def _in_time(flights: list[_Flown], contract: str) -> Finding:
    steps = sum(f.steps for f in flights)
    slow = sum(f.slow for f in flights)
    period = flights[0].seconds * 1e3
    found = (
        f"{max(f.p50 for f in flights):.2g} ms a step, {max(f.longest for f in flights):.2g} at "
        f"most; {period:.0f} ms there are"
    )
    if slow > _MANY * max(steps, 1):
        return Finding(
            "in time",
            False,
            f"{found}; too slow in {slow} of {steps} steps",
            "A late command is flown a step later, in the arena too. Plan in the constructor, or "
            "a piece at a time.",
        )
    if slow:
        return Finding("in time", None, f"{found}; too slow in {slow} of {steps} steps")
    return Finding("in time", True, found)


def _habits(first: _Flown, contract: str) -> Iterator[Finding]:
    """What can be seen in how it flew."""
    per_episode = first.printed / max(len(first.outcomes), 1)
    if per_episode > _MUCH:
        yield Finding(
            "prints",
            None,
            f"{per_episode / 1024:.0f} KiB an episode",
            "Print when something happens, not at every step: it takes time.",
        )
    if contract == "2022" and first.recordings:
        asked = _asked(first.recordings[0])
        for before, after in itertools.pairwise(asked):
            if before == _STREAM and after in _NEEDS_NOTICE:
                yield Finding(
                    "hand-over",
                    False,
                    "LAND, GOTO or TAKEOFF right after FULLSTATE",
                    "Send NOTIFYSETPOINTSTOP first: the vehicle ignores the others while it is "
                    "on a stream of setpoints.",
                )
                break
    if len(first.completed) > 1 and first.completed[0] and not all(first.completed[1:]):
        yield Finding(
            "later episodes",
            False,
            "the first episode is completed, a later one is not",
            "One Controller flies all episodes: at time 0 forget the last one, whose end is the "
            "first observation.",
        )


def _asked(recording: Path) -> list[int]:
    """Numbers of the verbs that were asked for, without the steps that asked for nothing."""
    table: Any = export.read(recording)
    column = table.columns["command"].index("asked")
    verbs = [int(verb) for verb in table.tables["command"][:, column]]
    return [verb for verb in verbs if verb != VERBS["NONE"]]


def _level(
    level: str, flown: _Flown, needed: bool, path: Path, overrides: Sequence[str]
) -> Finding:
    done = sum(flown.completed)
    if done == _EPISODES:
        seconds = sum(flown.times) / len(flown.times)
        return Finding(level, True, f"{done} of {_EPISODES} completed, {seconds:.1f} s each")
    worst = next(o for o, good in zip(flown.outcomes, flown.completed, strict=True) if not good)
    found = f"{done} of {_EPISODES} completed; {shown_line(worst, 300)}"
    error = "" if flown.error is None else flown.error.strip().splitlines()[-1]
    if error not in worst:
        found = f"{found}: {shown_line(error, 300)}"
    settings = "".join(f" --set {shlex.quote(override)}" for override in overrides)
    remedy = (
        f"See it: crazyarena dry-run {path} --level {level} --seed {_SEED} --episodes "
        f"{_EPISODES}{settings}"
    )
    return Finding(level, False if needed else None, found, remedy)
