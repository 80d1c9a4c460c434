"""The whole hardware path without hardware; what ``crazyarena bench`` does.

A virtual arena runs in a process of its own; the trial reaches its vehicle through cflib over
UDP, or over a virtual Crazyradio, and sees it through cameras on zenoh, in real time. Each run is
then flown as a dry run with the same seed, and the two groups are compared.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console

from crazyarena.errors import InputError
from crazyarena.levels import load_level
from crazyarena.levels.draw import LevelRandom
from crazyarena.levels.schema import Level
from crazyarena.mocap.onboard import KIND as ONBOARD
from crazyarena.mocap.survey import write_taped
from crazyarena.plain_text import shown_line
from crazyarena.runner.dry_run import DryRun
from crazyarena.runner.fly import Fly
from crazyarena.runner.judging.result import ABORTED, TrialResult
from crazyarena.runner.records.compare import Comparison, compare
from crazyarena.runner.records.run_folder import refuse_older_run
from crazyarena.runner.rig.flight_process.client import connected
from crazyarena.runner.rig.rig import Rig
from crazyarena.runner.rig.stops import StopOptions
from crazyarena.runner.rig.virtual_arena import VirtualArena
from crazyarena.runner.trial.options import FlightOptions
from crazyarena.runner.warm_up import compile_missing
from crazyarena.safety.limits import Limits
from crazyarena.sim_backend.arena_world import feet, track_truth
from crazyarena.sim_backend.crazyradio.environment import with_dongles
from crazyarena.sim_backend.vehicles import VehicleChoice
from crazyarena.viewer_process import View, ViewOptions


@dataclass
class BenchResult:
    """Results of the real-time runs, of the dry runs beside them, and their difference.

    aborted: why a run never flew, which ends the bench; the pairs before it are compared.
    uncompared: why the flights could not be.
    """

    flown: list[TrialResult] = field(default_factory=list)
    dry: list[TrialResult] = field(default_factory=list)
    arenas: list[dict[str, Any]] = field(default_factory=list)
    comparison: Comparison | None = None
    aborted: str | None = None
    uncompared: str | None = None

    @property
    def clean(self) -> bool:
        told = self.aborted is None and self.uncompared is None
        return told and all(result.clean for result in (*self.flown, *self.dry))


def aborted(flown: TrialResult) -> str | None:
    """Why a trial of one episode never flew, in one line; None if it did."""
    for episode in flown.episodes:
        if episode.termination == ABORTED:
            return shown_line(episode.error or "nobody knows why")
    return None if flown.episodes else "it was ended before the flight"


class Bench:
    """One call of the command.

    Parameters
    ----------
    out: results folder; ``bench_<i>`` and ``dry_<i>`` are made in it.
    runs: how many of each, all on the same draw of the level; measurement noise differs.
    dry: fly the dry runs and compare.
    stops: what stops the flights in real time besides the watchdog.
    waive: lines of the pre-flight checklist that must not ground those.
    radio: over a virtual Crazyradio instead of UDP. cameras: fields of CameraModel.
    vehicle, spread: as for :class:`~crazyarena.runner.dry_run.DryRun`; both sides fly the same.
    mocap: what the cameras speak, one of
        :data:`~crazyarena.runner.rig.arena_cameras.PROTOCOLS`; mocap_options: of the source that
        sees through them. Or ``onboard``: a deck on the vehicle (option ``deck``) and no cameras;
        the track is then known from a file, as if measured by hand.
    view: show the flights in the browser.
    """

    def __init__(
        self,
        submission: Path | None,
        level: str,
        out: Path,
        *,
        overrides: list[str] | None = None,
        runs: int = 1,
        seed: int = 0,
        dry: bool = True,
        options: FlightOptions | None = None,
        real_time: bool = True,
        figure: bool | str = True,
        console: Console | None = None,
        stops: StopOptions | None = None,
        waive: Sequence[str] = (),
        radio: bool = False,
        cameras: dict[str, Any] | None = None,
        vehicle: VehicleChoice | None = None,
        spread: bool | None = None,
        mocap: str = "zenoh",
        mocap_options: dict[str, Any] | None = None,
        view: ViewOptions | None = None,
    ) -> None:
        self._view_options = view
        self._view: View | None = None
        self._mocap = mocap
        self._mocap_options = mocap_options
        self._deck = None
        if mocap == ONBOARD:
            self._deck = str((mocap_options or {}).get("deck", "lighthouse"))
        self._radio = radio
        self._cameras = cameras
        self._submission = submission
        self._level = level
        self._out = out
        self._runs = runs
        self._seed = seed
        self._dry = dry
        self._real_time = real_time
        self._stops = stops
        self._waive = waive
        self._console = console if console is not None else Console()
        self._common: dict[str, Any] = {
            "overrides": overrides or [],
            "episodes": 1,
            "options": options,
            "figure": figure,
            "console": self._console,
            "vehicle": vehicle,
            "spread": spread,
        }

    def run(self) -> BenchResult:
        """Fly everything."""
        if self._view_options is not None:
            self._view = View(
                self._view_options,
                lambda text: self._console.print(text, highlight=False, soft_wrap=True),
            )
        try:
            result = self._run()
        except BaseException:
            if self._view is not None:
                self._view.close()
            raise
        return result

    def finish(self) -> None:
        """Let the viewer stay as long as somebody looks."""
        if self._view is not None:
            self._view.finish()

    def _run(self) -> BenchResult:
        refuse_older_run(self._out)
        compile_missing(("arena", "estimator", "referee"), self._console)
        result = BenchResult()
        for index in range(self._runs):
            seed = self._seed
            folder = self._out / f"bench_{index:02d}"
            folder.mkdir(parents=True, exist_ok=True)
            flown = self._fly(folder, seed, result)
            result.flown.append(flown)
            reason = aborted(flown)
            if reason is not None:
                # Nothing has changed since: the next run would end the same way.
                result.aborted = f"run {index} was aborted: {reason}"
                break
            if self._dry:
                dry = DryRun(
                    self._submission,
                    self._level,
                    seed=seed,
                    out=self._out / f"dry_{index:02d}",
                    noise_seed=seed + index,
                    deck=self._deck,
                    **self._common,
                )
                result.dry.append(dry.run())
        if result.dry:
            pairs = range(len(result.dry))
            try:
                result.comparison = compare(
                    [self._out / f"dry_{i:02d}" for i in pairs],
                    [self._out / f"bench_{i:02d}" for i in pairs],
                    ("dry run", "bench"),
                )
            except InputError as error:
                result.uncompared = str(error)
        return result

    def _fly(self, folder: Path, seed: int, result: BenchResult) -> TrialResult:
        arenas: list[VirtualArena] = []

        def open_rig(level: Level, limits: Limits) -> Rig:
            arena = VirtualArena(
                level,
                seed,
                folder,
                radio=self._radio,
                cameras=self._cameras,
                mocap=self._mocap,
                mocap_options=self._mocap_options,
                supply=fly.supply,
                lsy=fly.entry.arena,
            )
            arenas.append(arena)
            try:
                rig = connected(
                    level,
                    arena.uri,
                    arena.source,
                    limits=limits,
                    real_time=self._real_time,
                    description={"mocap": f"{self._mocap} {arena.endpoint}", "world": "bench"},
                    environment=with_dongles(arena.air) if self._radio else None,
                    model=fly.model,
                    params=fly.entry.params,
                )
            except BaseException:
                arena.close()
                raise
            rig.closers.insert(0, arena.close)
            return rig

        surveyed = None
        if self._mocap == ONBOARD:
            loaded = load_level(self._level, self._common["overrides"])
            draw = LevelRandom(loaded, seed).reset()
            surveyed = str(folder / "track.json")
            write_taped(surveyed, track_truth(feet(draw), draw.obstacles), loaded.name)
        fly = Fly(
            self._submission,
            self._level,
            seed=seed,
            out=folder,
            open_rig=open_rig,
            yes=True,
            real_time=self._real_time,
            stops=self._stops,
            waive=self._waive,
            surveyed=surveyed,
            onboard=self._mocap == ONBOARD,
            view=self._view,
            **self._common,
        )
        flown = fly.run()
        result.arenas += [arena.report for arena in arenas]
        return flown
