"""A dry run from level name to report; what ``crazyarena dry-run`` does."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from crazyarena.errors import InputError, StorageError
from crazyarena.levels.draw import Draw
from crazyarena.levels.schema import Level, Profile
from crazyarena.plain_text import shown, shown_line
from crazyarena.runner.contestant.dialogue import Contestant
from crazyarena.runner.contestant.in_process import InProcess
from crazyarena.runner.contestant.shipped import example_racer
from crazyarena.runner.judging.result import EpisodeResult, TrialResult
from crazyarena.runner.records.outcome_table import table
from crazyarena.runner.records.pages.write import leave_page
from crazyarena.runner.records.pictures import Figures, Pictures
from crazyarena.runner.records.recorder import Recorder
from crazyarena.runner.records.report import NOT_ISOLATED, result_document
from crazyarena.runner.records.run_folder import ResultFile, run_folder
from crazyarena.runner.trial.control_loop import Deadlines
from crazyarena.runner.trial.entry import enter
from crazyarena.runner.trial.make_world import make_world
from crazyarena.runner.trial.options import FlightOptions
from crazyarena.runner.trial.staging import Staging
from crazyarena.runner.trial.trial import Trial
from crazyarena.runner.trial.world import World
from crazyarena.runner.warm_up import compile_missing, parts_of
from crazyarena.viewer_process import View, ViewOptions

# What only arena levels need is imported when one is flown: it would double the start-up.
if TYPE_CHECKING:
    from crazyarena.mocap.camera_model import CameraModel
    from crazyarena.runner.trial.checklist import FlightChecklist
    from crazyarena.runner.trial.injection import Injection
    from crazyarena.runner.trial.phase import MeasuredTrack, Phase
    from crazyarena.runner.trial.phases import Crew
    from crazyarena.runner.trial.showing import Showing
    from crazyarena.runner.trial.tracked_world import TrackedWorld
    from crazyarena.safety.limits import Limits
    from crazyarena.sim_backend.vehicles import Vehicle, VehicleChoice, VehicleSupply

    Track = Draw | MeasuredTrack


class _Display:
    """Moves the progress bar, twice a second of flight: more would cost more than flying."""

    def __init__(self, progress: Progress, length: float, episodes: int) -> None:
        self._progress = progress
        self._task = progress.add_task("", total=length)
        self._episodes = episodes
        self._shown = -1

    def __call__(self, episode: int, time: float) -> None:
        half_seconds = int(time * 2)
        if half_seconds != self._shown:
            self._shown = half_seconds
            text = f"episode {episode} ({episode + 1} of {self._episodes})"
            self._progress.update(self._task, completed=time, description=text)


class DryRun:
    """One call of the command; arguments as there.

    noise_seed: of the rig's measurement noise; that of the level's draws by default.
    vehicle: which vehicle flies, on arena levels; that of the level by default.
    spread: whether a vehicle is drawn from the spread of the model; as the level says by default.
    cameras: of an arena, instead of the usual ones. deck: on the vehicle, instead of cameras.
    view: show it in the browser; pace: times real time that it then flies at, 0 for as fast as it
        goes.
    seeds: one for each episode, which are then as many; ``level`` may then be a loaded one.
    on_episode: told of every episode's result, recorder and track, whatever is kept of it.
    report: write ``report.html`` too.
    """

    def __init__(
        self,
        submission: Path | None,
        level: str | Level,
        overrides: Sequence[str] = (),
        episodes: int | None = None,
        seed: int | None = None,
        out: Path | None = None,
        record: bool = True,
        figure: Figures | bool | str = True,
        report: bool = False,
        console: Console | None = None,
        options: FlightOptions | None = None,
        noise_seed: int | None = None,
        vehicle: VehicleChoice | None = None,
        spread: bool | None = None,
        cameras: CameraModel | None = None,
        deck: str | None = None,
        view: View | ViewOptions | None = None,
        pace: float = 1.0,
        seeds: Sequence[int] | None = None,
        on_episode: Callable[[EpisodeResult, Recorder | None, Track], None] | None = None,
    ) -> None:
        self._deck = deck
        self._cameras = cameras
        self._on_episode = on_episode
        self._wanted_view = view
        self._view: View | None = None
        self._pace = pace
        self._show: Showing | None = None
        path = example_racer() if submission is None else submission
        self.entry = enter(path, level, overrides)
        self._level = self.entry.level
        self._vehicle: Vehicle | None = None
        self._choose(vehicle, spread)
        self._options = options or FlightOptions()
        self._options.check()
        self.entry.check(self._options)
        self._noise_seed = noise_seed
        self._seeds = None if seeds is None else tuple(seeds)
        if self._seeds:
            seed, episodes = self._seeds[0], len(self._seeds)
        self._seed = self._options.seed(seed, self._level)
        self._path = self.entry.path
        self._episodes = self._level.num_episodes if episodes is None else episodes
        self._wanted_out = out
        self._report_wanted = report
        self._record = record
        self._pictures = Pictures(Figures.of(figure), self._episodes, not self._controlled)
        self._console = console if console is not None else Console()
        self._preflight: FlightChecklist | None = None

    @property
    def seed(self) -> int:
        """What the level is drawn with."""
        return self._seed

    def _choose(self, choice: VehicleChoice | None, spread: bool | None) -> None:
        """Settle the vehicle of an arena level, and what the level says of it."""
        level = self._level
        if level.profile is Profile.COMPETITION:
            if (choice is not None and (choice.name or choice.overrides)) or spread is not None:
                raise InputError(
                    f"--vehicle: level {level.name} runs in the competition's simulation, which "
                    "has a vehicle of its own. Add --set profile=arena"
                )
            return
        from crazyarena.sim_backend.vehicles import VehicleChoice, resolve

        self._level, self._vehicle = resolve(level, choice or VehicleChoice())
        self.entry.settle(self._level)
        self._spread = level.vehicle.spread if spread is None else spread

    @property
    def model(self) -> Vehicle | None:
        """The vehicle of an arena level."""
        return self._vehicle

    @property
    def supply(self) -> VehicleSupply | None:
        """The vehicles of a new rig; the first depends on the seed alone."""
        if self._vehicle is None:
            return None
        from crazyarena.sim_backend.vehicles import VehicleSupply

        return VehicleSupply(self._vehicle, self._seed if self._spread else None)

    def run(self) -> TrialResult:
        """Fly, report, write ``result.json``; returns the result.

        Raises
        ------
        InputError: nothing has flown. StorageError: the disk takes no more; what was flown before
            is reported and kept.
        """
        try:
            return self._run()
        except BaseException:
            self._pictures.close()
            if self._view is not None and self._view is not self._wanted_view:
                self._view.close()
            raise

    def _run(self) -> TrialResult:
        console = self._console
        level = self._level
        compile_missing(parts_of(level), console)
        world = self._make_world()
        self._flown = TrialResult([], self._episodes)
        self._origin: dict[str, Any] = {}
        try:
            self.out = run_folder(self._wanted_out, self._path, level.name)
            beginning = result_document(self._flown, self._origin, finished=False)
            self._results = ResultFile(self.out, beginning)
        except BaseException:
            world.close()
            raise
        try:
            with contextlib.ExitStack() as stack:
                stack.callback(world.close)
                self._pictures.begin()
                self._open_show(world, stack)
                contestant = self._contestant()
                stack.callback(contestant.close)
                origin = self._origin
                origin |= self.entry.provenance(self._seed, contestant.digest)
                origin["contestant"] = contestant.description
                self._flown.isolated = bool(contestant.description["isolated"])
                if self._seeds:
                    origin["seeds"] = list(self._seeds)
                progress = stack.enter_context(self._progress())
                display = _Display(progress, level.episode_length, self._episodes)
                result = self._fly(world, contestant, display, origin, stack)
        except BaseException:
            self._left_by_error()
            raise
        self._remove_if_empty(self.out / "work")
        self._report(result)
        if result.cut_short is not None:
            raise StorageError(result.cut_short)
        if self._view is not None and self._view is not self._wanted_view:
            self._view.finish()
        return result

    def _left_by_error(self) -> None:
        """Keep what was flown before an error, or leave nothing."""
        if self._flown.episodes:
            self._remove_if_empty(self.out / "work")
            with contextlib.suppress(StorageError):  # the error that led here is told
                self._report(self._flown)
            return
        self._results.discard()
        self._remove_if_empty(self.out / "work", self.out)

    def _report(self, result: TrialResult) -> None:
        console, origin = self._console, self._origin
        self._look_again(result)
        document = result_document(result, origin)
        try:
            self._results.finish(document)
        except StorageError as error:
            result.cut_short = result.cut_short or str(error)
        console.print(table(result))
        seed = "that is secret" if self._options.secret else self._seed
        for line in self.entry.told(result, seed):
            console.print(line, highlight=False, markup=False)
        if origin.get("rig", {}).get("vehicles"):
            done = sum(episode.completed for episode in result.episodes)
            console.print(
                f"Vehicles drawn from the spread of {origin['rig']['vehicle']}: {done} of "
                f"{len(result.episodes)} completed",
                highlight=False,
            )
        if result.error is not None:
            self._print(shown(result.error), style="red")
        if not result.isolated:
            self._print(NOT_ISOLATED)
        self._print(f"Results in {shown_line(str(self.out))}")
        self._pictures.end(self.out, result.isolated)
        report = leave_page(self.out) if self._report_wanted else None
        drawn = self._draw_figures(result)
        if report is not None:
            self._print(*report)
        if drawn:
            self._results.finish(result_document(result, origin))

    def _opened_view(self) -> View | None:
        """Where viewers look; None if nobody is to."""
        wanted = self._wanted_view
        return View(wanted, self._print) if isinstance(wanted, ViewOptions) else wanted

    _controlled = False
    """A viewer may stop and land what flies."""

    def _open_show(self, world: World, stack: contextlib.ExitStack) -> None:
        self._view = self._opened_view()
        if self._view is None:
            return
        from crazyarena.runner.trial.showing import Showing
        from crazyarena.runner.trial.tracked_world import TrackedWorld

        self._show = Showing(
            self._view.live,
            self._level,
            self._episodes,
            limits=self._limits(),
            pace=self._pace,
            control=self._controlled,
        )
        stack.callback(self._show.close)
        if isinstance(world, TrackedWorld):
            self._show.attach(world.rig)
        if not self._controlled:
            self._view.await_browser()

    def _look_again(self, result: TrialResult) -> None:
        """Where the contestant could write the result, ask its recordings."""
        recorded = [episode for episode in result.episodes if "recording" in episode.files]
        claims = any(episode.completed for episode in recorded)
        if result.isolated or not claims or self._level.profile is not Profile.COMPETITION:
            return
        from crazyarena.runner.records.second_look import look_again

        for doubt in look_again(self._level, self.out, recorded):
            self._print(doubt, "red")

    def _print(self, text: str, style: str | None = None) -> None:
        self._console.print(text, style=style, markup=False, highlight=False, soft_wrap=True)

    def _make_world(self) -> World:
        seed = self._seed if self._noise_seed is None else self._noise_seed
        return make_world(
            self._level,
            seed,
            self._limits(),
            self.supply,
            self._cameras,
            self._deck,
            self.entry,
        )

    def _limits(self) -> Limits:
        """Of the watchdog, for the vehicle as its model has it, whatever is drawn."""
        from crazyarena.runner.rig.safeguard import limits_for

        flown = None
        if self._vehicle is not None:
            from crazyarena.runner.rig.flight_model import flight_model

            flown = flight_model(self._vehicle)
        limits = limits_for(self._level.control_frequency, self._options.max_misses, flown)
        return self.entry.limits(limits)

    def _contestant(self) -> Contestant:
        options = self._options
        sandboxed = options.sandboxed(self._level)
        contestant = self.entry.contestant(options, self.out / "work", sandboxed)
        if sandboxed:
            from crazyarena.runner.contestant.sandbox.announcement import announcement

            self._print(announcement(contestant.description))
        return contestant

    def _fly(
        self,
        world: World,
        contestant: Contestant,
        display: Callable[[int, float], None],
        origin: dict[str, Any],
        stack: contextlib.ExitStack,
    ) -> TrialResult:
        common: dict[str, Any] = {
            "episodes": self._episodes,
            "seed": self._seed,
            "seeds": self._seeds,
            "out": self.out if self._record else None,
            "keep_states": self._pictures.wanted or self._on_episode is not None,
            "on_step": display,
            "on_episode": self._keep,
            "show": self._show,
        }
        deadlines = self._options.deadlines(self._level)
        origin["deadlines"] = {
            "compute": str(deadlines.compute),
            "late_commands": deadlines.policy.value,
            "max_misses": deadlines.max_misses,
        }
        staging = self._staging(world, contestant, deadlines, origin, stack)
        trial = Trial(
            self._level,
            contestant,
            world,
            contract=self.entry.contract,
            staging=staging,
            deadlines=deadlines,
            **common,
        )
        result = trial.run()
        result.isolated = self._flown.isolated
        if self._preflight is not None:
            origin["preflight"] = self._preflight.record()
        if staging.in_force:
            origin["real_time"] = staging.in_force
        return result

    _real_time = False

    def _staging(
        self,
        world: World,
        contestant: Contestant,
        deadlines: Deadlines,
        origin: dict[str, Any],
        stack: contextlib.ExitStack,
    ) -> Staging:
        if self._level.profile is Profile.COMPETITION:
            # As in the competition, a contestant whose thinking is free is told by its info alone.
            plain = isinstance(contestant, InProcess) and not deadlines.compute.counts
            return Staging() if plain else Staging(self._injection(stack))
        from crazyarena.runner.trial.arena_staging import ArenaStaging
        from crazyarena.runner.trial.tracked_world import TrackedWorld

        assert isinstance(world, TrackedWorld)
        origin["rig"] = world.rig.description
        if self._vehicle is not None:
            from crazyarena.sim_backend.vehicles import dump_vehicle
            from crazyarena.sim_backend.vehicles.hover import advice

            origin["vehicle_file"] = dump_vehicle(self._vehicle)
            if (told := advice(self._vehicle)) is not None:
                self._console.print(told, highlight=False, markup=False, soft_wrap=True)
        crew = self._crew(world)
        return ArenaStaging(
            crew,
            world,
            self._level,
            world.rig.safeguard,
            self._injection(stack),
            real_time=self._real_time,
        )

    def _crew(self, world: TrackedWorld) -> Crew:
        from crazyarena.runner.trial.checklist import FlightChecklist
        from crazyarena.runner.trial.phases import Crew

        site = self.entry.site()
        landmarks = None if site is None else site.landmarks
        self._preflight = FlightChecklist(world.rig, self._level, landmarks=landmarks)
        return Crew(
            world.rig,
            world,
            self._level,
            on_phase=self._tell,
            checks=(self._checked,),
            anywhere=True,
            site=site,
        )

    def _tell(self, phase: Phase, text: str) -> None:
        """A phase has begun, or has found something."""
        if self._show is not None:
            self._show.phase(phase, text)

    def _checked(self) -> list[str]:
        """Go through the checklist, for viewers to see; returns what grounds the vehicle."""
        assert self._preflight is not None
        problems = self._preflight()
        if self._show is not None:
            self._show.checklist(
                (line.name, line.ok, line.found, line.remedy, line.waived)
                for line in self._preflight.lines
            )
        return problems

    def _injection(self, stack: contextlib.ExitStack) -> Injection:
        from crazyarena.runner.trial.injection import Injection

        return Injection()

    @staticmethod
    def _remove_if_empty(*folders: Path) -> None:
        for folder in folders:
            with contextlib.suppress(OSError):
                folder.rmdir()

    def _progress(self) -> Progress:
        return Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.completed:.1f} s"),
            TimeElapsedColumn(),
            console=self._console,
            transient=True,
            disable=not self._console.is_terminal,
        )

    def _keep(self, result: EpisodeResult, recorder: Recorder | None, track: Track) -> None:
        """After every episode: whatever ends the run later, this one was flown."""
        if self._on_episode is not None:
            self._on_episode(result, recorder, track)
        if self._pictures.wanted and recorder is not None:
            ground = self.entry.ground(track.gates, track.obstacles)
            self._pictures.add(self.out, result, recorder, ground, self._flown.isolated)
        self._flown.episodes.append(result)
        document = result_document(self._flown, self._origin, finished=False)
        self._results.add(result.as_dict(), document)

    def _draw_figures(self, result: TrialResult) -> bool:
        """Wait for the pictures; whether there is any."""
        drawn = self._pictures.finish()
        for reason in self._pictures.refused[:1]:
            result.cut_short = result.cut_short or reason
        for line in self._pictures.told(drawn):
            self._print(line)
        return bool(drawn)
