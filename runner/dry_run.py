"""A dry run from level name to report; what ``crazyarena dry-run`` does."""

from __future__ import annotations

import contextlib
import datetime
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from crazyarena.errors import InputError
from crazyarena.levels import load_level
from crazyarena.levels.draw import Draw
from crazyarena.levels.schema import Level, Profile
from crazyarena.plain_text import shown, shown_line
from crazyarena.runner.contestant.dialogue import Contestant
from crazyarena.runner.contestant.in_process import InProcess
from crazyarena.runner.contestant.submission import Submission, entry_file
from crazyarena.runner.judging.result import EpisodeResult, TrialResult
from crazyarena.runner.records.outcome_table import remarks, score_line, table
from crazyarena.runner.records.recorder import Recorder
from crazyarena.runner.records.report import NOT_ISOLATED, provenance, write_result
from crazyarena.runner.trial.control_loop import Deadlines
from crazyarena.runner.trial.options import FlightOptions
from crazyarena.runner.trial.staging import Staging
from crazyarena.runner.trial.trial import Trial
from crazyarena.runner.trial.world import World
from crazyarena.runner.warm_up import compile_missing, parts_of

# What only arena levels need is imported when one is flown: it would double the start-up.
if TYPE_CHECKING:
    from crazyarena.mocap.camera_model import CameraModel
    from crazyarena.runner.trial.checklist import FlightChecklist
    from crazyarena.runner.trial.injection import Injection
    from crazyarena.runner.trial.phase import MeasuredTrack
    from crazyarena.runner.trial.phases import Crew
    from crazyarena.runner.trial.tracked_world import TrackedWorld
    from crazyarena.safety.limits import Limits
    from crazyarena.sim_backend.vehicles import Vehicle, VehicleChoice, VehicleSupply

    Track = Draw | MeasuredTrack


def example_racer() -> Path:
    """Folder of the example that comes along; raises InputError if it did not."""
    package = Path(__file__).resolve().parent
    for root in (package.parent, package.parent / "crazyarena"):
        folder = root / "examples" / "racer"
        if folder.is_dir():
            return folder
    raise InputError("the example racer is not part of this installation. Pass a submission")


def make_world(
    level: Level,
    seed: int,
    limits: Limits | None = None,
    supply: VehicleSupply | None = None,
    cameras: CameraModel | None = None,
) -> World:
    """Return the simulated world of a level's profile; ``seed`` is that of its noise, ``limits``
    those of its watchdog, ``supply`` of the vehicles of an arena, ``cameras`` its own."""
    if level.profile is Profile.COMPETITION:
        from crazyarena.sim_backend.competition import CompetitionWorld

        return CompetitionWorld(level.control_frequency)
    from crazyarena.runner.rig.rig import simulated
    from crazyarena.runner.trial.tracked_world import TrackedWorld

    return TrackedWorld(simulated(level, seed, cameras, limits=limits, supply=supply))


def results_folder(out: Path | None, submission: Path, level: str) -> Path:
    """Make the folder of a run: ``out``, or a new one under ``runs/`` named after both."""
    if out is None:
        stamp = datetime.datetime.now().strftime("%Y%m%d-%H%M%S")
        stem = submission.stem if submission.suffix == ".py" else submission.name
        base = Path("runs") / f"{stamp}-{stem}-{level}"
        out, count = base, 1
        while out.exists():
            count += 1
            out = base.with_name(f"{base.name}-{count}")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"--out {out}: cannot make this folder: {error.strerror}") from error
    return out.resolve()


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
    cameras: of an arena, instead of the usual ones.
    seeds: one for each episode, which are then as many; ``level`` may then be a loaded one.
    on_episode: told of every episode's result, recorder and track, whatever is kept of it.
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
        figure: bool = True,
        console: Console | None = None,
        options: FlightOptions | None = None,
        noise_seed: int | None = None,
        vehicle: VehicleChoice | None = None,
        spread: bool | None = None,
        cameras: CameraModel | None = None,
        seeds: Sequence[int] | None = None,
        on_episode: Callable[[EpisodeResult, Recorder | None, Track], None] | None = None,
    ) -> None:
        self._cameras = cameras
        self._level = load_level(level, overrides) if isinstance(level, str) else level
        self._on_episode = on_episode
        self._vehicle: Vehicle | None = None
        self._choose(vehicle, spread)
        self._options = options or FlightOptions()
        self._options.check()
        self._noise_seed = noise_seed
        self._seeds = None if seeds is None else tuple(seeds)
        if self._seeds:
            seed, episodes = self._seeds[0], len(self._seeds)
        self._seed = self._options.seed(seed, self._level)
        path = example_racer() if submission is None else submission
        entry_file(path.expanduser())  # a wrong path must not leave a results folder behind
        self._path = path.expanduser().resolve()
        self._episodes = self._level.num_episodes if episodes is None else episodes
        self._wanted_out = out
        self._record = record
        self._figure = figure
        self._console = console if console is not None else Console()
        self._drawings: list[tuple[Any, ...]] = []
        self._preflight: FlightChecklist | None = None
        self._isolated = False

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
        """Fly, report, write ``result.json``; returns the result."""
        console = self._console
        level = self._level
        compile_missing(parts_of(level), console)
        world = self._make_world()
        self.out = results_folder(self._wanted_out, self._path, level.name)
        try:
            with contextlib.ExitStack() as stack:
                stack.callback(world.close)
                contestant = self._contestant()
                stack.callback(contestant.close)
                origin = provenance(level, self._seed, self._path, contestant.digest)
                origin["contestant"] = contestant.description
                if self._seeds:
                    origin["seeds"] = list(self._seeds)
                progress = stack.enter_context(self._progress())
                display = _Display(progress, level.episode_length, self._episodes)
                result = self._fly(world, contestant, display, origin, stack)
        except BaseException:
            self._remove_if_empty(self.out / "work", self.out)
            raise
        self._remove_if_empty(self.out / "work")
        self._draw_figures()
        write_result(self.out / "result.json", result, origin)
        console.print(table(result))
        seed = "that is secret" if self._options.secret else self._seed
        for line in (score_line(result), *remarks(result, level, seed)):
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
        for episode in result.episodes:
            if "figure" in episode.files:
                figure = self.out / episode.files["figure"]
                self._print(f"Figure: {shown_line(str(figure))}")
        return result

    def _print(self, text: str, style: str | None = None) -> None:
        self._console.print(text, style=style, markup=False, highlight=False, soft_wrap=True)

    def _make_world(self) -> World:
        seed = self._seed if self._noise_seed is None else self._noise_seed
        return make_world(self._level, seed, self._limits(), self.supply, self._cameras)

    def _limits(self) -> Limits:
        """Of the watchdog."""
        from crazyarena.runner.rig.safeguard import limits_for

        return limits_for(self._level.control_frequency, self._options.max_misses)

    def _contestant(self) -> Contestant:
        options = self._options
        if options.sandboxed(self._level):
            from crazyarena.runner.contestant.sandbox.process import Sandboxed

            contestant = Sandboxed(
                self._path,
                options.limits,
                require=options.require_sandbox,
                parameters=options.parameters,
            )
            self._print(contestant.announcement)
            return contestant
        return InProcess(Submission(self._path, self.out / "work"))

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
            "keep_states": self._figure or self._on_episode is not None,
            "on_step": display,
            "on_episode": self._keep,
        }
        deadlines = self._options.deadlines(self._level)
        origin["deadlines"] = {
            "compute": str(deadlines.compute),
            "late_commands": deadlines.policy.value,
            "max_misses": deadlines.max_misses,
        }
        staging = self._staging(world, contestant, deadlines, origin, stack)
        trial = Trial(
            self._level, contestant, world, staging=staging, deadlines=deadlines, **common
        )
        result = trial.run()
        result.isolated = bool(contestant.description["isolated"])
        self._isolated = result.isolated
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

        self._preflight = FlightChecklist(world.rig, self._level)
        return Crew(world.rig, world, self._level, checks=(self._preflight,), anywhere=True)

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
        if self._on_episode is not None:
            self._on_episode(result, recorder, track)
        if self._figure and recorder is not None:
            states = np.array(recorder.states)
            self._drawings.append((result, states, track.gates, track.obstacles))

    def _draw_figures(self) -> None:
        """Matplotlib is slow to import, so it comes last."""
        if not self._drawings:
            return
        from crazyarena.runner.records.figure import save_figure

        for result, states, gates, obstacles in self._drawings:
            file = self.out / f"episode_{result.index:03d}.png"
            save_figure(
                file, self._level, result, states, gates, obstacles, isolated=self._isolated
            )
            result.files["figure"] = file.name
