"""Races of lsy_drone_racing: several controllers on one track, from level name to report."""

from __future__ import annotations

import contextlib
import datetime
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from crazyarena.clock import WallClock
from crazyarena.errors import CrazyarenaError, InputError
from crazyarena.levels.lsy import LsyLevel
from crazyarena.levels.lsy.draw import LsyDraw, LsyRandom
from crazyarena.plain_text import shown, shown_line
from crazyarena.runner.contestant.contract_lsy.submission import controller_file
from crazyarena.runner.contestant.interrupt import Interrupt
from crazyarena.runner.contestant.sandbox.lsy import LsySandboxed
from crazyarena.runner.judging.lsy_race_rules import RaceReferee
from crazyarena.runner.judging.result import INTERRUPTED
from crazyarena.runner.lsy_run import FORMAT, recording_metadata, remove_if_empty, settled_seed
from crazyarena.runner.records.lsy_scene import lsy_scene
from crazyarena.runner.records.outcome_table import computing
from crazyarena.runner.records.recorder import Recorder
from crazyarena.runner.records.report import machine, versions
from crazyarena.runner.records.run_folder import ResultFile, run_folder
from crazyarena.runner.trial.lsy_race_episode import PATIENCE, RaceEpisode, RaceResult
from crazyarena.runner.trial.lsy_race_showing import RaceShowing
from crazyarena.runner.trial.lsy_viewed import Viewed
from crazyarena.runner.warm_up import compile_missing
from crazyarena.sim_backend.successor import nominal
from crazyarena.sim_backend.successor_race import SuccessorRace
from crazyarena.viewer_process import ViewOptions

_THEIRS = Path("lsy_drone_racing", "control")
_ROOMY = 72  # characters that a table with times of computing needs


def race_controllers(given: Sequence[Path], level: LsyLevel, file: Path | None) -> list[Path]:
    """The file of each drone's controller.

    Parameters
    ----------
    given: one for each drone, or one for all; none: those that the level names.
    file: of the level, beside which these are looked for; None for a shipped one.

    Raises
    ------
    InputError: there are more or fewer, one is not there, or is no controller.
    """
    drones = level.drones
    if len(given) == 1:
        given = [given[0]] * drones
    elif not given:
        names = [controller.file for controller in level.controller]
        if file is None or len(names) != drones or not all(names):
            raise InputError(
                f"level {level.name}: pass the file of a controller for each of its {drones} "
                "drones, or one for all"
            )
        given = [_named(name, number, file) for number, name in enumerate(names)]
    elif len(given) != drones:
        raise InputError(
            f"level {level.name}: {len(given)} controllers for {drones} drones; pass one for each, "
            "or one for all"
        )
    return [controller_file(path, level.name) for path in given]


def _shown_name(file: Path) -> str:
    """For people: the file's, or its folder's where that says no more than what all are."""
    return file.parent.name if file.stem == "controller" and file.parent.name else file.stem


def _named(name: str, number: int, level: Path) -> Path:
    """A controller that a level file names, as it lies in a checkout of theirs."""
    folder = level.resolve().parent
    places = [folder, folder.parent / _THEIRS, folder / _THEIRS]
    for place in places:
        if (place / name).is_file():
            return place / name
    looked = ", ".join(map(str, places))
    raise InputError(f"{level}: controller[{number}].file: no {name} in {looked}")


@dataclass
class RaceOutcome:
    """All races of a run, a result a drone; cut_short: what ended it that was no part of it."""

    races: list[list[RaceResult]]
    requested: int
    drones: int
    seed: int
    cut_short: str | None = None

    @property
    def results(self) -> list[RaceResult]:
        """Of all races, one after the other."""
        return [result for race in self.races for result in race]

    @property
    def success_rate(self) -> float:
        """Share of the requested flights that passed all gates."""
        return sum(r.success for r in self.results) / (self.requested * self.drones)

    @property
    def clean(self) -> bool:
        """Every drone of every requested race passed all gates."""
        return self.success_rate == 1.0


class LsyRace(Viewed):
    """One run of several controllers through races of a level, each in a process of its own.

    Parameters
    ----------
    controllers: a file a drone, see :func:`race_controllers`.
    level: a race. seed: replaces the level's; -1 there means a new one, which is told.
    secret: draw from 128 bits that nobody can guess instead.
    out: results folder, or None for a new one under ``runs/``.
    record: write an MCAP file a drone and race into it.
    require_sandbox: refuse to fly without full walls.
    patience: s of wall time that a controller may take for an answer.
    view: show it in the browser, until :meth:`finish`; pace: times real time that it then flies at,
        0 for as fast as it goes.

    Raises
    ------
    InputError: the level or a controller is at fault.
    """

    def __init__(
        self,
        controllers: Sequence[Path],
        level: LsyLevel,
        *,
        episodes: int = 1,
        seed: int | None = None,
        secret: bool = False,
        out: Path | None = None,
        record: bool = True,
        require_sandbox: bool = False,
        console: Console | None = None,
        patience: float = PATIENCE,
        view: ViewOptions | None = None,
        pace: float = 1.0,
    ) -> None:
        super().__init__(console, view)
        self.level = level
        self.out = out
        self.seed = settled_seed(level, seed, secret)
        self._files = list(controllers)
        self._names = [_shown_name(file) for file in self._files]
        self._episodes = episodes
        self._record = record
        self._require = require_sandbox
        self._patience = patience
        self._pace = pace
        self._show: RaceShowing | None = None
        self._trouble: str | None = None

    def run(self) -> RaceOutcome:
        """Fly; write ``result.json``."""
        try:
            return self._run()
        except BaseException:
            self._close_view()
            raise

    def _open_show(self, stack: contextlib.ExitStack) -> None:
        view = self._open_view(self.level.drones)
        if view is None:
            return
        self._show = RaceShowing(view.live, self.level, self._episodes, self._pace)
        stack.callback(self._show.close)
        view.await_browser()

    def _run(self) -> RaceOutcome:
        console, level = self._console, self.level
        for warning in level.warnings:
            console.print(f"warning: {warning}", style="yellow", markup=False, soft_wrap=True)
        compile_missing(("successor",), console)
        world, referee = SuccessorRace(level), RaceReferee(level)
        random = LsyRandom(level, nominal(level), self.seed)
        outcome = RaceOutcome([], self._episodes, level.drones, self.seed)
        racers: list[LsySandboxed] = []
        self.out = run_folder(self.out, self._files[0], level.name)
        results = ResultFile(self.out, self._document(outcome, racers, False))
        try:
            with contextlib.ExitStack() as stack:
                self._seat(racers, stack)
                # Thinking costs no time here, so there is no step to wait for.
                stack.enter_context(stack.enter_context(Interrupt()).at_once())
                self._open_show(stack)
                for index in range(self._episodes):
                    race = self._fly(index, racers, world, referee, random.race())
                    outcome.races.append(race)
                    outcome.cut_short = self._trouble
                    for result in race:
                        results.add(asdict(result), self._document(outcome, racers, False))
                    stopped = any(result.termination == INTERRUPTED for result in race)
                    if outcome.cut_short or stopped:
                        break
        except BaseException:
            if not outcome.races:
                results.discard()
                remove_if_empty(self.out)
            raise
        results.finish(self._document(outcome, racers, True))
        return outcome

    def _seat(self, racers: list[LsySandboxed], stack: contextlib.ExitStack) -> None:
        """Start a process for every contestant."""
        for drone, file in enumerate(self._files):
            try:
                racer = LsySandboxed(file, self.level.sim.drone_model, require=self._require)
            except CrazyarenaError as error:
                raise InputError(f"drone {drone}: {error}") from error
            stack.callback(racer.close)
            racers.append(racer)
        told = dict.fromkeys(racer.announcement for racer in racers)
        for line in told:
            self._console.print(line, highlight=False, soft_wrap=True)

    def _fly(
        self,
        index: int,
        racers: Sequence[LsySandboxed],
        world: SuccessorRace,
        referee: RaceReferee,
        draws: Sequence[LsyDraw],
    ) -> list[RaceResult]:
        with contextlib.ExitStack() as stack:
            recorders = self._recorders(index, draws, stack) if self._record else []
            race = RaceEpisode(
                index,
                self.level,
                racers,
                self._names,
                world,
                referee,
                recorders=recorders,
                show=self._show,
                patience=self._patience,
            ).fly(draws)
        for result, recorder in zip(race, recorders, strict=False):
            assert recorder.file is not None
            if not len(recorder.states):
                recorder.file.unlink()  # one that never flew
                continue
            self._trouble = self._trouble or recorder.trouble
            result.files["recording"] = recorder.file.name
        return race

    def _recorders(
        self, index: int, draws: Sequence[LsyDraw], stack: contextlib.ExitStack
    ) -> list[Recorder]:
        assert self.out is not None
        scene = lsy_scene(draws[0].gates, draws[0].obstacles)
        recorders = []
        for drone, (file, draw) in enumerate(zip(self._files, draws, strict=True)):
            metadata = recording_metadata(self.level, self.seed, index, file, draw)
            metadata |= {"drone": str(drone), "drones": str(self.level.drones)}
            target = self.out / f"episode_{index:03d}_drone_{drone}.mcap"
            recorder = Recorder(target, metadata, scene, WallClock())
            stack.callback(recorder.close)
            recorders.append(recorder)
        return recorders

    def _document(
        self, outcome: RaceOutcome, racers: Sequence[LsySandboxed], finished: bool
    ) -> dict[str, Any]:
        walls = [racer.description for racer in racers]
        return {
            "format": FORMAT,
            "finished": finished,
            "isolated": bool(walls) and all(wall["isolated"] for wall in walls),
            "contract": "lsy_drone_racing",
            "race": True,
            "success_rate": outcome.success_rate,
            "successes": sum(result.success for result in outcome.results),
            "races_flown": len(outcome.races),
            "episodes_requested": outcome.requested,
            "drones": outcome.drones,
            "seed": outcome.seed,
            # While it flies they are added one by one.
            "episodes": [asdict(result) for result in outcome.results] if finished else [],
            "provenance": {
                "versions": versions(),
                "machine": machine(),
                "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
                "level": self.level.name,
                "level_file": self.level.config,
                "profile": "successor",
                "rng": self.level.rng.value,
                "seed": self.seed,
                "submissions": [str(file) for file in self._files],
                "submission_sha256": [racer.digest for racer in racers],
                "contestants": walls,
            },
        }


def race_table(outcome: RaceOutcome, width: int) -> Any:
    """Rich table, a row a drone and race; ``width``: characters, of the terminal.

    Where there is no room for all, times of computing are left to ``result.json``.
    """
    from rich import box
    from rich.markup import escape
    from rich.table import Table

    view = Table(box=box.SIMPLE, header_style="bold", collapse_padding=True, pad_edge=False)
    view.add_column("#", justify="right", no_wrap=True)
    view.add_column("drone", justify="right", no_wrap=True)
    view.add_column("controller", overflow="fold")
    view.add_column("outcome", overflow="fold", min_width=14)
    roomy = width >= _ROOMY
    for name in ("place", "time s", "gates", *(["ms\np50/max"] if roomy else [])):
        view.add_column(name, justify="right", no_wrap=True)
    for r in outcome.results:
        style = "green" if r.success else "red"
        view.add_row(
            str(r.index),
            str(r.drone),
            escape(shown_line(r.controller)),
            f"[{style}]{escape(shown_line(r.why or r.termination))}[/{style}]",
            "" if r.place is None else str(r.place),
            f"{r.time:.2f}",
            f"{r.gates_passed}/{r.gates}",
            *([computing(r.compute_ms)] if roomy else []),
        )
    return view


def tell_race(outcome: RaceOutcome, console: Console) -> None:
    """Print the table, notes and errors."""
    console.print(race_table(outcome, console.width))
    for r in outcome.results:
        for note in r.notes:
            text = shown(f"episode {r.index}, drone {r.drone}: {note}")
            console.print(text, style="yellow", markup=False, highlight=False, soft_wrap=True)
    for r in outcome.results:
        if r.error is not None:
            text = shown(f"episode {r.index}, drone {r.drone}: {r.error}")
            console.print(text, style="red", markup=False, highlight=False, soft_wrap=True)
