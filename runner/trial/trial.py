"""A trial: the episodes that one contestant lives through, with deadlines and phases.

The one program behind ``dry-run``, ``bench`` and ``fly``. Order of an episode: connect,
pre-flight, survey, (controller is made), arm, countdown, run, complete or fail, return and land,
disarm. In the competition's own simulation an episode is nothing but its run, thinking is free,
and as in the competition later episodes begin with the last observation of the one before: a
reset tells the contestant nothing.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from crazyarena import __version__
from crazyarena.clock import Clock, WallClock
from crazyarena.errors import InputError
from crazyarena.levels import dump_level
from crazyarena.levels.draw import Draw, LevelRandom, SeparateDraws
from crazyarena.levels.schema import Level
from crazyarena.plain_text import shown
from crazyarena.runner.contestant.dialogue import Contestant
from crazyarena.runner.contestant.interrupt import Interrupt
from crazyarena.runner.judging.referee import Referee, Verdict, observation
from crazyarena.runner.judging.result import (
    ABORTED,
    CONTROLLER_ERROR,
    CONTROLLER_TIMEOUT,
    INTERRUPTED,
    SAFETY,
    EpisodeResult,
    TrialResult,
)
from crazyarena.runner.records.recorder import Recorder
from crazyarena.runner.records.scene import scene_update
from crazyarena.runner.trial.control_loop import ControlLoop, Deadlines
from crazyarena.runner.trial.options import FlightOptions
from crazyarena.runner.trial.phase import Aborted, MeasuredTrack, Phase
from crazyarena.runner.trial.staging import Staging
from crazyarena.runner.trial.world import World

_ENDS_TRIAL = (CONTROLLER_ERROR, CONTROLLER_TIMEOUT, INTERRUPTED, SAFETY, ABORTED)
# Of these, where the vehicle is new in every episode; a controller that failed is made anew, too.
_ENDS_RENEWED = (INTERRUPTED, ABORTED)
_FAILED = (CONTROLLER_ERROR, CONTROLLER_TIMEOUT)


def require_firmware(level: Level) -> None:
    """Raise InputError for a level that asks for the mode without firmware."""
    if not level.use_firmware:
        raise InputError(
            f"level {level.name}: use_firmware is false; only firmware mode (cmdFirmware) "
            "can be flown. Set use_firmware: true"
        )


class Trial:
    """Flies ``episodes`` episodes of a level with one contestant.

    Parameters
    ----------
    level: with ``use_firmware`` (the contestant's ``cmdSimOnly`` has no counterpart here).
    contestant: loaded; the caller closes it.
    world: not reset yet; the caller closes it.
    staging: what surrounds a run; nothing by default.
    deadlines: those of the level's profile by default.
    episodes: how many; default the level's own number.
    seed: replaces the level's own. seeds: one for each episode instead, which are then as many.
    out: existing folder for recordings, or None to record nothing.
    keep_states: keep the flight in memory for ``on_episode`` even if nothing is recorded.
    on_step: called with (episode, time s) after every control step.
    on_episode: called with each episode's result, recorder (or None) and track right after it.
    """

    def __init__(
        self,
        level: Level,
        contestant: Contestant,
        world: World,
        *,
        staging: Staging | None = None,
        deadlines: Deadlines | None = None,
        episodes: int | None = None,
        seed: int | None = None,
        seeds: Sequence[int] | None = None,
        out: Path | None = None,
        keep_states: bool = False,
        on_step: Callable[[int, float], None] | None = None,
        on_episode: Callable[[EpisodeResult, Recorder | None, Any], None] | None = None,
        wall: Clock | None = None,
    ) -> None:
        require_firmware(level)
        self._level = level
        self._contestant = contestant
        self._world = world
        self._staging = staging or Staging()
        self._deadlines = deadlines or FlightOptions().deadlines(level)
        self._episodes = level.num_episodes if episodes is None else episodes
        self._seed = level.seed if seed is None else seed
        self._seeds = seeds
        if seeds is not None:
            self._episodes = len(seeds)
        self._out = out.resolve() if out is not None else None
        self._keep_states = keep_states
        self._on_step = on_step
        self._on_episode = on_episode
        self._wall = wall if wall is not None else WallClock()
        self._made = self._flown = False
        self._last_endings = _ENDS_RENEWED if self._staging.renews else _ENDS_TRIAL
        self._thought = 0.0  # s of wall time, by the contestant

    def run(self) -> TrialResult:
        """Fly; raises InputError when the controller cannot be constructed."""
        random: LevelRandom | SeparateDraws
        if self._seeds is None:
            random = LevelRandom(self._level, self._seed)
        else:
            random = SeparateDraws(self._level, self._seeds)
        referee = Referee(self._level)
        results: list[EpisodeResult] = []
        obs: list[Any] = []
        with self._staging.interruptible() as interrupt:
            self._contestant.heed(interrupt)
            for index in range(self._episodes):
                result, obs = self._episode(index, random.reset(), referee, obs, interrupt)
                results.append(result)
                if interrupt.asked or result.termination in self._last_endings:
                    break
                if index + 1 < self._episodes:
                    if result.termination in _FAILED:
                        self._made = False
                        continue
                    flown = result.termination
                    self._hook("interEpisodeReset", result, interrupt)
                    if result.termination != flown:
                        break
        return TrialResult(results, self._episodes)

    def _episode(
        self,
        index: int,
        draw: Draw,
        referee: Referee,
        obs: list[Any],
        interrupt: Interrupt,
    ) -> tuple[EpisodeResult, list[Any]]:
        staging = self._staging
        self._world.reset(draw)
        try:
            track = staging.prepare(draw)
            referee.begin(track.gates, track.obstacles, staging.follow())
            start = staging.start(draw)
            referee.warm_up(start)
            if staging.fresh or not self._made:
                obs = observation(start)
            if not self._made:
                self._make(obs, start)
        except Aborted as error:
            return self._aborted(index, error), obs
        with staging.else_abort():
            recorder = self._recorder(index, draw, track, start)
        staging.announce(track, self._level, recorder)
        try:
            with staging.on_stage():
                result, obs = self._run(index, referee, obs, interrupt, recorder)
        except Aborted as error:
            return self._aborted(index, error), obs
        finally:
            if recorder is not None:
                staging.finish(recorder)
        result.reveals = staging.reveals
        result.phases = staging.durations
        if recorder is not None and recorder.file is not None:
            result.files["recording"] = recorder.file.name
        if result.termination not in _ENDS_TRIAL:
            result.interepisode_learning_time = self._hook("interEpisodeLearn", result, interrupt)
        if self._on_episode is not None:
            self._on_episode(result, recorder, track)
        return result, obs

    def _make(self, obs: list[Any], start: np.ndarray) -> None:
        with self._staging.else_abort():
            try:
                self._contestant.make(obs, self._level, start)
            except InputError as error:
                if not self._flown:
                    raise
                # It could be made once: what was flown since is not thrown away.
                raise Aborted(Phase.SURVEY, str(error)) from error
        self._made = self._flown = True

    def _run(
        self,
        index: int,
        referee: Referee,
        obs: list[Any],
        interrupt: Interrupt,
        recorder: Recorder | None,
    ) -> tuple[EpisodeResult, list[Any]]:
        staging, on_step = self._staging, self._on_step
        staging.begin()

        def judged(verdict: Verdict, time: float) -> None:
            staging.judged(verdict, time, recorder)

        loop = ControlLoop(
            index,
            self._contestant,
            self._world,
            referee,
            self._level.control_frequency,
            self._deadlines,
            interrupt,
            keep_alive=staging.keep_alive,
            recorder=recorder,
            watch=staging.watch,
            on_verdict=judged,
            on_step=None if on_step is None else lambda time: on_step(index, time),
            thought_before=self._thought,
        )
        try:
            result, obs = loop.fly(obs)
        except BaseException:
            staging.failed()
            raise
        self._thought += loop.thought
        staging.end(result, recorder)
        return result, obs

    def _aborted(self, index: int, error: Aborted) -> EpisodeResult:
        return EpisodeResult(
            index=index,
            termination=ABORTED,
            flight_time=0.0,
            gates_passed=0,
            gates=len(self._level.track.gates),
            completed=False,
            collisions=0,
            violations=0,
            reward=0.0,
            interstep_learning_time=0.0,
            interstep_learning_average=0.0,
            interepisode_learning_time=0.0,
            steps=0,
            gate_times=[],
            compute_ms={},
            over_period=0,
            late_ms={},
            skipped_steps=0,
            error=shown(str(error)),
            phases=self._staging.durations,
        )

    def _hook(self, name: str, result: EpisodeResult, interrupt: Interrupt) -> float:
        try:
            seconds, error = self._contestant.hook(name)
        except KeyboardInterrupt:
            interrupt.asked = True
            return 0.0
        if error is not None:
            result.error = shown(error)
            result.termination = CONTROLLER_ERROR
        self._thought += seconds
        return seconds

    def _recorder(
        self, index: int, draw: Draw, track: MeasuredTrack, start: np.ndarray
    ) -> Recorder | None:
        if self._out is None and not self._keep_states:
            return None
        metadata = {
            "crazyarena": __version__,
            "level": self._level.name,
            "level_file": dump_level(self._level),
            "seed": str(self._seed if self._seeds is None else self._seeds[index]),
            "episode": str(index),
            "submission_sha256": self._contestant.digest,
            "start": json.dumps(start.tolist()),
            "mass": repr(draw.mass),
            "inertia": json.dumps(draw.inertia.tolist()),
            "gates": json.dumps(track.gates.tolist()),
            "obstacles": json.dumps(track.obstacles.tolist()),
        }
        metadata |= self._staging.metadata(track)
        scene = scene_update(track.gates, track.obstacles, self._level)
        file = None if self._out is None else self._out / f"episode_{index:03d}.mcap"
        return Recorder(file, metadata, scene, self._wall, logs=self._staging.logs)
