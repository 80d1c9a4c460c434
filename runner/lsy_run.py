"""Runs of lsy_drone_racing's controllers, from level name to report: dry runs and evaluations."""

from __future__ import annotations

import contextlib
import datetime
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from crazyarena.clock import WallClock
from crazyarena.errors import InputError
from crazyarena.levels.lsy import LsyLevel, load_lsy_level
from crazyarena.levels.lsy.draw import LsyDraw, LsyRandom, fresh_seed, refuse_short_keys
from crazyarena.levels.lsy.schema import LsyProfile
from crazyarena.plain_text import shown, shown_line
from crazyarena.runner.contestant.compute import Budget
from crazyarena.runner.contestant.contract_lsy.dialogue import LsyContestant
from crazyarena.runner.contestant.contract_lsy.pilot import LsyInProcess
from crazyarena.runner.contestant.contract_lsy.submission import (
    LsySubmission,
    controller_file,
    controller_hash,
)
from crazyarena.runner.contestant.interrupt import Interrupt
from crazyarena.runner.contestant.prints import PrintsShown
from crazyarena.runner.judging.lsy_rules import LsyReferee
from crazyarena.runner.judging.result import (
    CONTROLLER_ERROR,
    CONTROLLER_TIMEOUT,
    INTERRUPTED,
)
from crazyarena.runner.records.ground import lsy_ground
from crazyarena.runner.records.lsy_scene import lsy_scene
from crazyarena.runner.records.outcome_table import computing
from crazyarena.runner.records.pages.write import leave_page
from crazyarena.runner.records.pictures import Figures, Pictures
from crazyarena.runner.records.recorder import SINCE, Recorder
from crazyarena.runner.records.report import machine, versions
from crazyarena.runner.records.run_folder import ResultFile, run_folder
from crazyarena.runner.trial.lsy_episode import COMMAND_LAYOUT, LsyEpisode, LsyEpisodeResult
from crazyarena.runner.trial.lsy_showing import LsyShowing
from crazyarena.runner.trial.lsy_viewed import Viewed
from crazyarena.runner.trial.options import secret_seed
from crazyarena.runner.warm_up import compile_missing
from crazyarena.sim_backend.successor import SuccessorWorld, nominal
from crazyarena.viewer_process import ViewOptions

FORMAT = 1
_ENDS_RUN = (CONTROLLER_ERROR, CONTROLLER_TIMEOUT, INTERRUPTED)
DEFAULT_LEVEL = "lsy/level2"
ENOUGH = 0.5
"""Share of successful runs below which an evaluation fails."""


@dataclass
class LsyResult:
    """All episodes of a run; cut_short: what ended it that was no part of the flight."""

    episodes: list[LsyEpisodeResult]
    requested: int
    seed: int
    cut_short: str | None = None

    @property
    def success_rate(self) -> float:
        """Share of the requested episodes that passed all gates."""
        return sum(e.success for e in self.episodes) / self.requested

    @property
    def mean_time(self) -> float | None:
        """Mean time of the successful ones, s, as lsy_drone_racing counts it."""
        times = [e.time for e in self.episodes if e.success]
        return float(np.mean(times)) if times else None

    @property
    def clean(self) -> bool:
        """Every requested episode passed all gates."""
        return len(self.episodes) == self.requested and all(e.success for e in self.episodes)

    @property
    def error(self) -> str | None:
        """Traceback of the controller's failure, if it failed."""
        return next((e.error for e in self.episodes if e.error is not None), None)


class LsyRun(Viewed):
    """One run of a controller through episodes of a level.

    Parameters
    ----------
    submission: file of a controller of lsy_drone_racing, or a folder with exactly one.
    level: ``lsy/level0`` ... or a TOML file; overrides: see :func:`load_lsy_level`.
    seed: replaces the level's; -1 there means a new one, which is told.
    secret: draw from 128 bits that nobody can guess instead; in a process of its own.
    out: results folder, or None for none at all, unless ``keep``: then a new one under ``runs/``.
    record: write an MCAP file an episode into it.
    sandbox: run the controller in a process of its own; require: refuse to without full walls.
    seeds: one for each episode, which are then as many, and as large as one likes.
    parameters: told to a sandboxed controller, see :class:`.Sandboxed`; budget: its wall time.
    on_episode: told of every episode's result, recorder and draw, whatever is kept of it.
    view: show it in the browser, until :meth:`finish`; pace: times real time that it then flies at,
        0 for as fast as it goes.

    Raises
    ------
    InputError: the level or the controller is at fault.
    """

    def __init__(
        self,
        submission: Path,
        level: str | LsyLevel = DEFAULT_LEVEL,
        overrides: Sequence[str] = (),
        *,
        episodes: int = 1,
        seed: int | None = None,
        secret: bool = False,
        out: Path | None = None,
        keep: bool = False,
        record: bool = True,
        sandbox: bool = False,
        require_sandbox: bool = False,
        console: Console | None = None,
        seeds: Sequence[int] | None = None,
        parameters: Mapping[str, object] | None = None,
        budget: Budget | None = None,
        on_episode: Callable[[LsyEpisodeResult, Recorder | None, LsyDraw], None] | None = None,
        view: ViewOptions | None = None,
        pace: float = 1.0,
        figure: Figures | bool | str = False,
        report: bool = False,
    ) -> None:
        super().__init__(console, view)
        self._figure, self._report = Figures.of(figure), report
        self._told: list[tuple[str, str | None]] = []
        self._pace = pace
        self._show: LsyShowing | None = None
        self._parameters = parameters
        self._budget = budget
        self._on_episode = on_episode
        self._seeds = None if seeds is None else tuple(seeds)
        self.level = level if isinstance(level, LsyLevel) else load_lsy_level(level, overrides)
        if self.level.profile is LsyProfile.ARENA:
            raise InputError(
                f"level {self.level.name}: profile arena is flown by crazyarena dry-run, bench "
                "and fly; an evaluation is one in lsy_drone_racing's own simulation"
            )
        named = level if isinstance(level, str) else level.name
        self._file = controller_file(submission, named)
        self.seed = settled_seed(self.level, seed, secret)
        self._episodes = episodes
        if self._seeds:
            self.seed, self._episodes = self._seeds[0], len(self._seeds)
        self.out = out
        self._keep = keep
        self._path = submission.expanduser()
        self._file_of_results: ResultFile | None = None
        self._pictures = Pictures(Figures.NONE, 0, False)
        self._cut_short: str | None = None
        self._record = record
        self.isolated = False
        self._sandbox = sandbox or secret
        self._require = require_sandbox

    def run(self) -> LsyResult:
        """Fly; write ``result.json`` if there is a folder for it."""
        try:
            return self._run()
        except BaseException:
            self._pictures.close()
            self._close_view()
            raise

    def _open_show(self, stack: contextlib.ExitStack) -> None:
        view = self._open_view()
        if view is None:
            return
        self._show = LsyShowing(view.live, self.level, self._episodes, self._pace)
        stack.callback(self._show.close)
        view.await_browser()

    def _run(self) -> LsyResult:
        console, level = self._console, self.level
        for warning in level.warnings:
            console.print(f"warning: {warning}", style="yellow", markup=False, soft_wrap=True)
        compile_missing(("successor",), console)
        world = SuccessorWorld(level)
        model = nominal(level)
        if self._seeds is None:
            randoms = [LsyRandom(level, model, self.seed)] * self._episodes
        else:
            randoms = [LsyRandom(level, model, seed) for seed in self._seeds]
        referee = LsyReferee(level)
        outcome = LsyResult([], self._episodes, self.seed)
        if self.out is not None or self._keep:
            self.out = run_folder(self.out, self._path, level.name)
            self._file_of_results = ResultFile(self.out, self._document(outcome, None, False))
            self._pictures = Pictures(self._figure, self._episodes, True)
            self._pictures.begin()
        try:
            with contextlib.ExitStack() as stack:
                contestant = self._contestant(stack)
                stack.callback(contestant.close)
                self.isolated = bool(contestant.description["isolated"])
                if not self._sandbox:
                    stack.callback(PrintsShown(lambda: True).close)
                # Thinking costs no time here, so there is no step to wait for.
                stack.enter_context(stack.enter_context(Interrupt()).at_once())
                self._open_show(stack)
                for index, random in enumerate(randoms):
                    result = self._episode(index, contestant, world, referee, random.reset())
                    outcome.episodes.append(result)
                    outcome.cut_short = self._cut_short
                    if self._file_of_results is not None:
                        document = self._document(outcome, contestant, False)
                        self._file_of_results.add(asdict(result), document)
                    if outcome.cut_short or result.termination in _ENDS_RUN:
                        break
        except BaseException:
            if not outcome.episodes and self._file_of_results is not None:
                assert self.out is not None
                self._file_of_results.discard()
                remove_if_empty(self.out)
            raise
        if self._file_of_results is not None:
            self._file_of_results.finish(self._document(outcome, contestant, True))
            self._drawn(outcome, contestant)
        return outcome

    def _drawn(self, outcome: LsyResult, contestant: LsyContestant) -> None:
        """Write the report while the rest is drawn, then wait for that."""
        assert self.out is not None
        assert self._file_of_results is not None
        self._pictures.end(self.out, self.isolated)
        said = [leave_page(self.out)] if self._report else []
        drawn = self._pictures.finish()
        for reason in self._pictures.refused[:1]:
            outcome.cut_short = outcome.cut_short or reason
        self._told = [*((line, None) for line in self._pictures.told(drawn)), *said]
        if drawn:
            self._file_of_results.finish(self._document(outcome, contestant, True))

    @property
    def told(self) -> list[tuple[str, str | None]]:
        """What is said of pictures and report once it has run: lines and their styles."""
        return list(self._told)

    def _contestant(self, stack: contextlib.ExitStack) -> LsyContestant:
        model = self.level.sim.drone_model
        if self._sandbox:
            from crazyarena.runner.contestant.sandbox.lsy import LsySandboxed

            sandboxed = LsySandboxed(
                self._file,
                model,
                require=self._require,
                parameters=self._parameters,
                patience=None if self._budget is None else self._budget.step,
            )
            self._console.print(sandboxed.announcement, highlight=False, soft_wrap=True)
            return sandboxed
        work = self._file.parent if self.out is None else self.out / "work"
        if self.out is not None:
            stack.callback(remove_if_empty, work)
        return LsyInProcess(LsySubmission(self._file, work, model))

    def _episode(
        self,
        index: int,
        contestant: LsyContestant,
        world: SuccessorWorld,
        referee: LsyReferee,
        draw: LsyDraw,
    ) -> LsyEpisodeResult:
        kept = self._record and self.out is not None
        wanted = kept or self._on_episode is not None or self._pictures.wanted
        recorder = self._recorder(index, draw) if wanted else None
        try:
            episode = LsyEpisode(
                index,
                self.level,
                contestant,
                world,
                referee,
                recorder=recorder,
                most=math.inf if self._budget is None else self._budget.episode,
                show=self._show,
            )
            result = episode.fly(draw)
        finally:
            if recorder is not None:
                recorder.close()
        if recorder is not None and recorder.file is not None:
            self._cut_short = recorder.trouble
            result.files["recording"] = recorder.file.name
        if self._on_episode is not None:
            self._on_episode(result, recorder, draw)
        if self._pictures.wanted and recorder is not None:
            assert self.out is not None
            ground = lsy_ground(self.level, draw.gates, draw.nominal_gates, draw.obstacles)
            self._pictures.add(self.out, result, recorder, ground, self.isolated)
        return result

    def _recorder(self, index: int, draw: LsyDraw) -> Recorder:
        seed = self.seed if self._seeds is None else self._seeds[index]
        metadata = recording_metadata(self.level, seed, index, self._file, draw)
        scene = lsy_scene(draw.gates, draw.obstacles)
        file = None
        if self._record and self.out is not None:
            file = self.out / f"episode_{index:03d}.mcap"
        return Recorder(file, metadata, scene, WallClock())

    def _document(
        self, result: LsyResult, contestant: LsyContestant | None, finished: bool
    ) -> dict[str, Any]:
        return {
            "format": FORMAT,
            "finished": finished,
            "isolated": self.isolated,
            "contract": "lsy_drone_racing",
            **summary(result),
            # While it flies they are added one by one.
            "episodes": [asdict(episode) for episode in result.episodes] if finished else [],
            "provenance": {
                "versions": versions(),
                "machine": machine(),
                "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
                "level": self.level.name,
                "level_file": self.level.config,
                "profile": "successor",
                "rng": self.level.rng.value,
                "seed": self.seed,
                **({"seeds": list(self._seeds)} if self._seeds else {}),
                "submission": str(self._file),
                "submission_sha256": contestant.digest if contestant is not None else None,
                "contestant": contestant.description if contestant is not None else None,
            },
        }


def settled_seed(level: LsyLevel, given: int | None, secret: bool) -> int:
    """The seed of the draws; raises InputError for a secret one that cannot be."""
    if secret:
        if given is not None:
            raise InputError("--seed and --secret exclude each other")
        refuse_short_keys(level)
        return secret_seed()
    wanted = level.env.seed if given is None else given
    return fresh_seed() if wanted < 0 else wanted


def recording_metadata(
    level: LsyLevel, seed: int, index: int, controller: Path, draw: LsyDraw
) -> dict[str, str]:
    """What a recording says of its flight."""
    return {
        "crazyarena": SINCE,
        "level": level.name,
        "level_file": json.dumps(level.config),
        "rng": str(level.rng.value),
        "seed": str(seed),
        "episode": str(index),
        "submission_sha256": controller_hash(controller),
        "command_layout": COMMAND_LAYOUT[level.env.control_mode],
        "start": json.dumps(draw.start.tolist()),
        "mass": repr(draw.mass),
        "inertia": json.dumps(draw.inertia.tolist()),
        "gates": json.dumps(draw.gates.tolist()),
        "obstacles": json.dumps(draw.obstacles.tolist()),
    }


def summary(result: LsyResult) -> dict[str, Any]:
    """What an evaluation comes to, as plain data."""
    return {
        "success_rate": result.success_rate,
        "mean_time": result.mean_time,
        "successes": sum(e.success for e in result.episodes),
        "episodes_flown": len(result.episodes),
        "episodes_requested": result.requested,
        "seed": result.seed,
    }


def remove_if_empty(folder: Path) -> None:
    """Remove a folder that holds nothing."""
    with contextlib.suppress(OSError):
        folder.rmdir()


def lsy_table(result: LsyResult) -> Any:
    """Rich table, a row an episode."""
    from rich import box
    from rich.markup import escape
    from rich.table import Table

    view = Table(box=box.SIMPLE, header_style="bold", collapse_padding=True, pad_edge=False)
    view.add_column("#", justify="right", no_wrap=True)
    view.add_column("outcome", overflow="fold", min_width=14)
    for name in ("time s", "gates", "compute ms\np50/max"):
        view.add_column(name, justify="right", no_wrap=True)
    for e in result.episodes:
        style = "green" if e.success else "red"
        view.add_row(
            str(e.index),
            f"[{style}]{escape(shown_line(e.why or e.termination))}[/{style}]",
            f"{e.time:.2f}",
            f"{e.gates_passed}/{e.gates}",
            computing(e.compute_ms),
        )
    return view


def tell(result: LsyResult, console: Console) -> None:
    """Print the table, notes and errors."""
    console.print(lsy_table(result))
    for episode in result.episodes:
        for note in episode.notes:
            text = shown(f"episode {episode.index}: {note}")
            console.print(text, style="yellow", markup=False, highlight=False, soft_wrap=True)
    if result.error is not None:
        console.print(
            shown(result.error), style="red", markup=False, highlight=False, soft_wrap=True
        )
