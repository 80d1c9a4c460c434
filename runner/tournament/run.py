"""A tournament from a folder of submissions to its journal; resumable at any point."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from crazyarena.errors import InputError, StorageError
from crazyarena.levels.lsy import is_lsy_level
from crazyarena.runner.tournament.archive import pack
from crazyarena.runner.tournament.engine import Engine
from crazyarena.runner.tournament.entries import IROS, LSY, Entry, find_entries
from crazyarena.runner.tournament.flight import SUBMISSION_ERROR, Flown, Order
from crazyarena.runner.tournament.journal import Journal, full
from crazyarena.runner.tournament.plan import (
    PLAN,
    SUBMISSIONS,
    Options,
    Plan,
    PlannedLevel,
    Team,
    make_team,
    now,
    plan_level,
    publish,
    read_plan,
    secret_seeds,
    write_plan,
)
from crazyarena.runner.tournament.rules import Rules, load_rules, parse_rules
from crazyarena.runner.warm_up import compile_missing, parts_of
from crazyarena.whole_file import write_whole

DEFAULT_LEVELS = ("level0", "level1", "level2", "level3", "sim2real")
DEFAULT_LSY_LEVELS = ("lsy/level2",)
RECORDINGS = "recordings"
_RECORDED = 220e3  # bytes a second of flight, about
_TYPICAL = 12.0  # s
_BUSY = 0.5  # processors' worth of other work, above which measured times say little


class Tournament:
    """A results folder and what is to be flown into it.

    Attributes
    ----------
    out, plan, rules, journal. resumed: episodes that were there already.
    remarks: what the results have to say of themselves.
    """

    def __init__(self, out: Path, plan: Plan, rules: Rules, journal: Journal) -> None:
        self.out = out
        self.plan = plan
        self.rules = rules
        self.journal = journal
        self.resumed = len(journal.episodes)
        self.remarks: list[str] = []

    def close(self) -> None:
        """Let go of the folder."""
        self.journal.close()

    @property
    def total(self) -> int:
        """Episodes that there are to be, of submissions that can be flown."""
        return sum(level.draws for team, level in self.plan.pairs() if team.archive is not None)

    def warm_up(self, console: Console) -> None:
        """Compile here what the flights need, before workers side by side do the same."""
        missing = {order.level for order in self.missing()}
        parts = dict[str, None]()
        for level in self.plan.levels:
            if level.key in missing:
                own = ("successor",) if level.level is None else parts_of(level.level)
                parts |= dict.fromkeys(own)
        compile_missing(list(parts), console)

    def missing(self) -> list[Order]:
        """Blocks of which not every episode has been flown."""
        done = self.journal.episodes
        return [
            order
            for order in self.plan.orders()
            if any(f"{order.team}/{order.level}/{draw}" not in done for draw in order.draws)
        ]

    def fly(
        self,
        engine: Callable[[], Engine],
        on_episodes: Callable[[Sequence[Mapping[str, Any]]], None] = lambda lines: None,
        tick: Callable[[], None] = lambda: None,
        say: Callable[[str], None] = lambda text: None,
    ) -> list[str]:
        """Fly what is missing.

        Returns
        -------
        What could not be flown, in words; empty when all is there.

        Raises
        ------
        CrazyarenaError: the disk is full, the scheduler gone, no worker fit. What was flown before
            is safe.
        """
        self._note_broken()
        missing = self.missing()
        failed: list[str] = []
        if missing:
            self._check_room(missing)
            with engine() as cluster:
                if cluster.dashboard:
                    say(f"dask's own page: {cluster.dashboard}")

                def take(order: Order, flown: Flown, worker: Mapping[str, Any]) -> None:
                    on_episodes(self._keep(order, flown, worker))

                cluster.run(missing, self.out / SUBMISSIONS, take, tick)
                failed = [f"{order.key}: {reason}" for order, reason in cluster.failed]
        if not failed:
            publish(self.out)
        return failed

    def _keep(self, order: Order, flown: Flown, worker: Mapping[str, Any]) -> list[dict[str, Any]]:
        """Recordings first, then the lines that speak of them."""
        fresh = [e for e in flown.episodes if e["key"] not in self.journal.episodes]
        for episode in fresh:
            data = flown.recordings.get(episode["draw"])
            episode["recording"] = None
            if data is not None:
                place = Path(RECORDINGS, order.team, f"{order.level}-{episode['draw']:04d}.mcap")
                self._write(self.out / place, data)
                episode["recording"] = place.as_posix()
            episode["worker"] = {
                name: worker.get(name) for name in ("host", "cpu", "pid", "cores", "pinned")
            }
        self.journal.append(fresh)
        return fresh

    def _write(self, file: Path, data: bytes) -> None:
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            write_whole(file, data)
        except (OSError, StorageError) as error:
            why = error.__cause__ if isinstance(error, StorageError) else error
            raise full(file, why, len(self.journal.episodes)) from error

    def _note_broken(self) -> None:
        """A submission that cannot be read has its episodes, too: none was flown."""
        for team, level in self.plan.pairs():
            if team.archive is not None:
                continue
            lines = [
                _broken(team, level, draw)
                for draw in range(level.draws)
                if f"{team.slug}/{level.key}/{draw}" not in self.journal.episodes
            ]
            if lines:
                self.journal.append(lines)

    def _check_room(self, missing: Sequence[Order]) -> None:
        if not self.plan.options.record:
            return
        need = sum(len(order.draws) for order in missing) * _RECORDED * _TYPICAL
        free = shutil.disk_usage(self.out).free
        if need > free:
            raise InputError(
                f"--out {self.out}: recordings will take about {need / 1e9:.1f} GB, "
                f"{free / 1e9:.1f} GB are free. Make room, pass another --out, or fly with "
                "--no-record (any episode can be flown again from its draw file)"
            )


def _broken(team: Team, level: PlannedLevel, draw: int) -> dict[str, Any]:
    return {
        "key": f"{team.slug}/{level.key}/{draw}",
        "team": team.slug,
        "level": level.key,
        "draw": draw,
        "block": "",
        "outcome": SUBMISSION_ERROR,
        "why": team.trouble,
        "clean": False,
        "completed": False,
        "flight_time": 0.0,
        "learning_time": 0.0,
        "gates_passed": 0,
        "gates": len(level.gates),
        "collisions": 0,
        "violations": 0,
        "gate_times": [],
        "compute_ms": {},
        "noise_ms": {},
        "missed_ticks": 0,
        "events": [],
        "error": team.trouble,
        "path": [],
        "place": None,
        "recording": None,
        "wall": 0.0,
        "worker": {},
    }


def open_tournament(
    out: Path,
    source: Path | None,
    levels: Sequence[str] | None = None,
    options: Mapping[str, Any] | None = None,
    rules: str | None = None,
    title: str | None = None,
) -> Tournament:
    """Begin a tournament in ``out``, or go on with the one that is there.

    ``source``, ``levels``, ``options`` (fields of :class:`.Options`), ``rules`` of one that goes on
    must be those it began with; what is not given is not asked for.

    Raises
    ------
    InputError: something is wrong, or is not what it was; nothing has flown.
    """
    chosen = Options(**(options or {}))
    chosen.check()
    if (out / PLAN).is_file():
        plan = read_plan(out)
        _same(plan, out, source, levels, options or {}, rules)
        return _held(out, plan)
    if source is None:
        raise InputError(
            f"--out {out}: no tournament here to go on with. Pass a folder or a list of submissions"
        )
    entries = find_entries(source)
    planned, rule_text = settle(entries, levels, chosen, rules)
    try:
        out.mkdir(parents=True, exist_ok=True)
        (out / SUBMISSIONS).mkdir(exist_ok=True, mode=0o700)
    except OSError as error:
        raise InputError(f"--out {out}: cannot make this folder: {error.strerror}") from error
    if any(p.name not in (SUBMISSIONS, "draws", "lock", "episodes.jsonl") for p in out.iterdir()):
        raise InputError(f"--out {out}: the folder holds something else. Pass a new one")
    teams = pack_all(entries, out)
    plan = Plan(tuple(teams), tuple(planned), chosen, rule_text, title or source.name, now())
    write_plan(plan, out)
    return _held(out, plan)


def _held(out: Path, plan: Plan) -> Tournament:
    return Tournament(out, plan, parse_rules(plan.rules), Journal(out))


def settle(
    entries: Sequence[Entry], levels: Sequence[str] | None, options: Options, rules: str | None
) -> tuple[list[PlannedLevel], str]:
    """Levels with their draws, and the text of the rules."""
    contracts = {entry.contract for entry in entries if not entry.trouble}
    if levels is None:
        names = [
            *(DEFAULT_LEVELS if IROS in contracts else ()),
            *(DEFAULT_LSY_LEVELS if LSY in contracts else ()),
        ]
    else:
        names = list(levels)
    if not names:
        raise InputError("--levels: no level given")
    foreign = all(is_lsy_level(name) for name in names)
    rule_set, text = load_rules(rules or ("lsy" if foreign else "iros2022"))
    planned: list[PlannedLevel] = []
    for name in names:
        level = plan_level(name, secret_seeds(options.seeds), rule_set.controller)
        if any(other.key == level.key for other in planned):
            raise InputError(f"--levels: {name}: two levels are called {level.key}")
        planned.append(level)
    flown = {level.contract for level in planned}
    for entry in entries:
        if not entry.trouble and entry.contract not in flown:
            kind = "lsy/level0 ... lsy/level3" if entry.contract == LSY else "level0 ... level3"
            raise InputError(
                f"team {entry.name}: none of the levels is of its contract. Add one of {kind}, or "
                "leave the team out"
            )
    return planned, text


def pack_all(entries: Sequence[Entry], out: Path) -> list[Team]:
    """Archive every submission that can be."""
    teams = []
    for entry in entries:
        archive, place, trouble = None, "", entry.trouble
        if trouble is None:
            try:
                archive, place = pack(entry, out / SUBMISSIONS)
            except InputError as error:
                trouble = str(error)
            except OSError as error:
                raise InputError(
                    f"{out / SUBMISSIONS}: cannot write: {error.strerror}. Make room, or pass "
                    "another --out"
                ) from error
        teams.append(make_team(entry, archive, place, trouble))
    return teams


def _same(
    plan: Plan,
    out: Path,
    source: Path | None,
    levels: Sequence[str] | None,
    options: Mapping[str, Any],
    rules: str | None,
) -> None:
    def differs(what: str, now: object, then: object) -> InputError:
        return InputError(
            f"--out {out}: a tournament was begun here with {what} {then}, not {now}. Go on with "
            "that (leave the option out), or pass another --out"
        )

    for name, mine in options.items():
        theirs = getattr(plan.options, name)
        if mine != theirs:
            raise differs(f"--{name}", mine, theirs)
    if rules is not None and load_rules(rules)[1] != plan.rules:
        raise differs("--rules", rules, parse_rules(plan.rules).name)
    if levels is not None:
        lives = parse_rules(plan.rules).controller
        for name in levels:
            level = plan_level(name, (0,), lives)
            there = next((p for p in plan.levels if p.key == level.key), None)
            if there is None:
                raise differs("--levels", name, ", ".join(p.name for p in plan.levels))
            same = (level.level, level.toml, level.overrides)
            if same != (there.level, there.toml, there.overrides):
                raise differs("level", f"{name} as it is now", f"another {name}")
        if len(levels) != len(plan.levels):
            raise differs("--levels", ",".join(levels), ",".join(p.name for p in plan.levels))
    if source is not None:
        _same_teams(plan, out, source, differs)


def _same_teams(
    plan: Plan, out: Path, source: Path, differs: Callable[[str, object, object], InputError]
) -> None:
    then = {team.slug: team for team in plan.teams}
    entries = find_entries(source)
    names = [entry.name for entry in entries]
    if sorted(entry.slug for entry in entries) != sorted(then):
        raise differs("the teams", ", ".join(names), ", ".join(t.name for t in plan.teams))
    for team in pack_all(entries, out):
        before = then[team.slug]
        if (team.archive, team.place) != (before.archive, before.place):
            raise InputError(
                f"team {team.name}: its submission has changed since the tournament was begun in "
                f"{out}. Leave it as it was (start without the folder or list), or pass another "
                "--out"
            )


def load() -> float:
    """Processors' worth of work that others have now."""
    return os.getloadavg()[0]


def measured_remark(plan: Plan) -> str | None:
    """Why measured times say little even before anything is flown."""
    if plan.options.compute != "measured" or load() <= _BUSY:
        return None
    return (
        f"thinking was measured while others kept {load():.1f} processors busy: times are not "
        "comparable"
    )
