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

from crazyarena.clock import Clock, WallClock
from crazyarena.errors import InputError
from crazyarena.levels.draw import Draw, SeparateDraws
from crazyarena.levels.schema import Level
from crazyarena.plain_text import shown
from crazyarena.runner.contestant.contract_lsy.dialogue import Drawing
from crazyarena.runner.contestant.dialogue import Contestant
from crazyarena.runner.contestant.interrupt import Interrupt
from crazyarena.runner.judging.referee import Verdict
from crazyarena.runner.judging.result import (
    ABORTED,
    CONTROLLER_ERROR,
    CONTROLLER_TIMEOUT,
    INTERRUPTED,
    SAFETY,
    EpisodeResult,
    TrialResult,
)
from crazyarena.runner.records.recorder import SINCE, Recorder
from crazyarena.runner.trial.contract import Contract, Contract2022, Draws
from crazyarena.runner.trial.control_loop import ControlLoop, Deadlines
from crazyarena.runner.trial.options import FlightOptions
from crazyarena.runner.trial.phase import Aborted, MeasuredTrack, Phase
from crazyarena.runner.trial.showing import Showing
from crazyarena.runner.trial.staging import Staging
from crazyarena.runner.trial.world import World

_ENDS_TRIAL = (CONTROLLER_ERROR, CONTROLLER_TIMEOUT, INTERRUPTED, SAFETY, ABORTED)
# Of these, where the vehicle is new in every episode; a controller that failed is made anew, too.
_ENDS_RENEWED = (INTERRUPTED, ABORTED)
_FAILED = (CONTROLLER_ERROR, CONTROLLER_TIMEOUT)


class Trial:
    """Flies ``episodes`` episodes of a level with one contestant.

    Parameters
    ----------
    level: what is flown.
    contestant: loaded; the caller closes it.
    world: not reset yet; the caller closes it.
    contract: how worlds are drawn, judged and told of; that of 2022 by default.
    staging: what surrounds a run; nothing by default.
    deadlines: those of the level's profile by default.
    episodes: how many; default the level's own number.
    seed: replaces the level's own. seeds: one for each episode instead, which are then as many.
    out: existing folder for recordings, or None to record nothing.
    keep_states: keep the flight in memory for ``on_episode`` even if nothing is recorded.
    on_step: called with (episode, time s) after every control step.
    on_episode: called with each episode's result, recorder (or None) and track right after it.
    show: for viewers.
    """

    def __init__(
        self,
        level: Level,
        contestant: Contestant,
        world: World,
        *,
        contract: Contract | None = None,
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
        show: Showing | None = None,
    ) -> None:
        self._level = level
        self._contestant = contestant
        self._world = world
        self._contract = contract or Contract2022(level)
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
        self._show = show
        self._made = self._flown = False
        self._last_endings = _ENDS_RENEWED if self._staging.renews else _ENDS_TRIAL
        self._thought = 0.0  # s of wall time, by the contestant
        self._cut_short: str | None = None

    def run(self) -> TrialResult:
        """Fly; raises InputError when the controller cannot be constructed."""
        random: Draws
        if self._seeds is None:
            random = self._contract.draws(self._seed)
        else:
            random = SeparateDraws(self._level, self._seeds)
        referee = self._contract.referee()
        results: list[EpisodeResult] = []
        obs: Any = []
        with self._staging.interruptible() as interrupt:
            self._contestant.heed(interrupt)
            for index in range(self._episodes):
                result, obs = self._episode(index, random.reset(), referee, obs, interrupt)
                results.append(result)
                if interrupt.asked or self._cut_short or result.termination in self._last_endings:
                    break
                if index + 1 < self._episodes:
                    if result.termination in _FAILED:
                        self._made = False
                        continue
                    flown = result.termination
                    self._hooks(self._contract.between, result, interrupt)
                    if result.termination != flown:
                        break
        return TrialResult(results, self._episodes, cut_short=self._cut_short)

    def _episode(
        self,
        index: int,
        draw: Draw,
        referee: Any,
        obs: Any,
        interrupt: Interrupt,
    ) -> tuple[EpisodeResult, Any]:
        staging, contract = self._staging, self._contract
        self._world.reset(draw)
        try:
            track = staging.prepare(draw)
            start = staging.start(draw)
            contract.begin(referee, draw, track, staging.follow(), start)
            if staging.fresh or contract.renews or not self._made:
                obs = contract.first(referee, start)
            if contract.renews or not self._made:
                self._make(obs, start)
        except Aborted as error:
            return self._aborted(index, error), obs
        with staging.else_abort():
            recorder = self._recorder(index, draw, track, start)
        staging.announce(track, self._level, recorder)
        if self._show is not None:
            self._show.begin(index, track.gates, track.obstacles)
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
            self._cut_short = recorder.trouble
            result.files["recording"] = recorder.file.name
        if result.termination not in _ENDS_TRIAL:
            result.interepisode_learning_time = self._hooks(contract.after, result, interrupt)
        if self._on_episode is not None:
            self._on_episode(result, recorder, track)
        return result, obs

    def _make(self, obs: Any, start: np.ndarray) -> None:
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
        referee: Any,
        obs: Any,
        interrupt: Interrupt,
        recorder: Recorder | None,
    ) -> tuple[EpisodeResult, Any]:
        staging, on_step, show = self._staging, self._on_step, self._show
        staging.begin()
        if show is not None:
            show.running()

        def judged(verdict: Verdict, time: float) -> None:
            staging.judged(verdict, time, recorder)
            if show is not None:
                show.step(verdict, time, loop.row, loop.missed)

        def drew(drawings: list[Drawing], time: float) -> None:
            from crazyarena.runner.records.lsy_scene import drawn_scene

            scene = drawn_scene(drawings, time)
            if recorder is not None:
                recorder.scene(time, scene)
            if show is not None:
                show.drawn(scene["entities"])

        loop = ControlLoop(
            index,
            self._contestant,
            self._world,
            referee,
            self._level.control_frequency,
            self._deadlines,
            interrupt,
            self._contract,
            keep_alive=staging.keep_alive,
            recorder=recorder,
            watch=staging.watch,
            on_verdict=judged,
            on_step=None if on_step is None else lambda time: on_step(index, time),
            on_drawings=drew,
            thought_before=self._thought,
        )
        try:
            result, obs = loop.fly(obs)
        except BaseException:
            staging.failed()
            raise
        self._thought += loop.thought
        if show is not None:
            show.end(result)
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

    def _hooks(self, names: tuple[str, ...], result: EpisodeResult, interrupt: Interrupt) -> float:
        """Call some of the contestant's hooks, up to the first that fails; s that they took."""
        flown, spent = result.termination, 0.0
        for name in names:
            spent += self._hook(name, result, interrupt)
            if result.termination != flown or interrupt.asked:
                break
        return spent

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
            "crazyarena": SINCE,
            **self._contract.metadata(draw, track, start),
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
        scene = self._contract.scene(track)
        file = None if self._out is None else self._out / f"episode_{index:03d}.mcap"
        return Recorder(file, metadata, scene, self._wall, logs=self._staging.logs)
