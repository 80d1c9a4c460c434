"""A trial with deadlines, phases and a contestant that may live in a process of its own.

The one program behind ``dry-run`` (arena levels, or with a sandbox or charged compute time),
``bench`` and ``fly``. Order of an episode: connect, pre-flight, survey, (controller is made),
arm, countdown, run, complete or fail, return and land, disarm.
"""

from __future__ import annotations

import contextlib
import json
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from crazyarena import __version__
from crazyarena.clock import Clock, WallClock
from crazyarena.errors import CrazyarenaError, InputError
from crazyarena.levels import dump_level
from crazyarena.levels.draw import Draw, LevelRandom
from crazyarena.levels.schema import Level
from crazyarena.runner.contender import Contender
from crazyarena.runner.control_loop import ControlLoop, Deadlines
from crazyarena.runner.crew import Aborted, Crew, MeasuredTrack, OnPhase, Phase
from crazyarena.runner.episode import Interrupt
from crazyarena.runner.injection import Injection
from crazyarena.runner.moving_gates import MovingGates
from crazyarena.runner.realtime import quiet_collector
from crazyarena.runner.recording import Recorder
from crazyarena.runner.referee import Event, Referee, Verdict, observation
from crazyarena.runner.result import (
    ABORTED,
    CONTROLLER_ERROR,
    CONTROLLER_TIMEOUT,
    INTERRUPTED,
    SAFETY,
    EpisodeResult,
    TrialResult,
)
from crazyarena.runner.scene import scene_update
from crazyarena.runner.steady import steady
from crazyarena.runner.tracked_world import TrackedWorld
from crazyarena.runner.trial import require_firmware
from crazyarena.runner.world import World
from crazyarena.safety.estop import interrupt_policy

_ENDS_TRIAL = (CONTROLLER_ERROR, CONTROLLER_TIMEOUT, INTERRUPTED, SAFETY, ABORTED)
# Of these, where the vehicle is new in every episode; a controller that failed is made anew, too.
_ENDS_RENEWED = (INTERRUPTED, ABORTED)
_FAILED = (CONTROLLER_ERROR, CONTROLLER_TIMEOUT)


class Watch(Protocol):
    """Whoever may take the vehicle from the contestant during a run."""

    def begin(self) -> None:
        """The run begins now."""
        ...

    def answered(self) -> None:
        """The contestant has answered."""
        ...

    def late(self, seconds: float) -> None:
        """How late a tick began."""
        ...

    def verdict(self) -> str | None:
        """Why the run must end, or None; asked at every tick."""
        ...

    def hand_over(self, rule: str) -> None:
        """Take the vehicle, for the reason ``rule``."""
        ...

    def end(self) -> bool:
        """The run is over. True if the vehicle was taken; it is down then, or as good as."""
        ...

    def events(self) -> list[Event]:
        """What happened since the last call."""
        ...

    def stop(self, source: str, reason: str) -> None:
        """Stop the motors at once; any thread."""
        ...


class FlightTrial:
    """Flies ``episodes`` episodes of a level with one contestant.

    Parameters
    ----------
    contender: loaded; the caller closes it.
    world: the caller closes it.
    crew: for worlds with a vehicle that must be brought up and down; None for the competition's
        own simulation, where an episode is nothing but its run.
    watch: ends runs for safety's sake.
    real_time: ask for locked memory and real-time scheduling during runs; ``in_force`` says
        afterwards what was granted.
    injection: told of the measured track and of every verdict, and publishes them.
    """

    def __init__(
        self,
        level: Level,
        contender: Contender,
        world: World,
        *,
        crew: Crew | None = None,
        watch: Watch | None = None,
        injection: Injection | None = None,
        deadlines: Deadlines | None = None,
        real_time: bool = False,
        episodes: int | None = None,
        seed: int | None = None,
        out: Path | None = None,
        keep_states: bool = False,
        on_step: Callable[[int, float], None] | None = None,
        on_episode: Callable[[EpisodeResult, Recorder | None, Any], None] | None = None,
        wall: Clock | None = None,
    ) -> None:
        require_firmware(level)
        self._level = level
        self._contender = contender
        self._world = world
        self._crew = crew
        self._watch = watch
        self._injection = injection or Injection()
        self._gates: MovingGates | None = None
        if level.track.tracked and isinstance(world, TrackedWorld):
            self._gates = MovingGates(level, world.rig)
        self._deadlines = deadlines or Deadlines()
        self._episodes = level.num_episodes if episodes is None else episodes
        self._seed = level.seed if seed is None else seed
        self._out = out.resolve() if out is not None else None
        self._keep_states = keep_states
        self._on_step = on_step
        self._on_episode = on_episode
        self._wall = wall if wall is not None else WallClock()
        self._made = self._flown = False
        renews = isinstance(world, TrackedWorld) and world.rig.renews
        self._last_endings = _ENDS_RENEWED if renews else _ENDS_TRIAL
        self._steady = real_time
        self.in_force: list[str] = []

    def run(self) -> TrialResult:
        """Fly; raises InputError when the controller cannot be constructed."""
        random = LevelRandom(self._level, self._seed)
        referee = Referee(self._level)
        results: list[EpisodeResult] = []
        obs: list[Any] = []
        with self._interruptible() as interrupt:
            if self._crew is not None:
                self._crew.interrupted = lambda: interrupt.asked
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
                    self._hook("interEpisodeReset", result)
                    if result.termination != flown:
                        break
        return TrialResult(results, self._episodes)

    @contextlib.contextmanager
    def _interruptible(self) -> Iterator[Interrupt]:
        """Ctrl-C ends the run; where there is a vehicle, once more stops its motors."""
        interrupt = Interrupt()
        main = threading.current_thread() is threading.main_thread()
        if self._watch is None or not main:
            with interrupt:
                yield interrupt
            return

        def land(name: str) -> None:
            interrupt.asked = True

        with interrupt_policy(land, self._watch.stop):
            yield interrupt

    def _episode(
        self,
        index: int,
        draw: Draw,
        referee: Referee,
        obs: list[Any],
        interrupt: Interrupt,
    ) -> tuple[EpisodeResult, list[Any]]:
        self._world.reset(draw)
        try:
            track = self._prepare(draw)
            if self._gates is not None:
                self._gates.begin(track.gates)
            follow = None if self._gates is None else self._gates.at
            referee.begin(track.gates, track.obstacles, follow)
            start = self._start(draw)
            referee.warm_up(start)
            if not self._made:
                obs = observation(start)
                self._make(obs, start)
            elif self._crew is not None:
                obs = observation(start)
        except Aborted as error:
            return self._aborted(index, referee, error), obs
        with self._else_abort():
            recorder = self._recorder(index, draw, track, start)
        self._injection.begin(track, self._level, recorder)
        try:
            with contextlib.ExitStack() as quiet:
                # Before the motors turn: both take long enough to be missed in the air.
                quiet.enter_context(quiet_collector())
                if self._steady:
                    self.in_force = quiet.enter_context(steady(self._world.clock))
                if self._crew is not None:
                    self._crew.launch()
                result, obs = self._run(index, referee, obs, interrupt, recorder)
        except Aborted as error:
            return self._aborted(index, referee, error), obs
        finally:
            if recorder is not None:
                self._finish(recorder)
        result.reveals = self._injection.reveals
        if self._crew is not None:
            result.phases = dict(self._crew.durations)
        if recorder is not None and recorder.file is not None:
            result.files["recording"] = recorder.file.name
        if result.termination not in _ENDS_TRIAL:
            result.interepisode_learning_time = self._hook("interEpisodeLearn", result)
        if self._on_episode is not None:
            self._on_episode(result, recorder, track)
        return result, obs

    def _prepare(self, draw: Draw) -> MeasuredTrack:
        if self._crew is not None:
            return self._crew.prepare()
        return MeasuredTrack(draw.gates, draw.obstacles, "drawn")

    def _start(self, draw: Draw) -> np.ndarray:
        """(12,) state at the start, as far as anybody can know it."""
        if isinstance(self._world, TrackedWorld):
            state = self._world.state()
            if state is None:
                raise Aborted(Phase.SURVEY, "the vehicle was never seen")
            return state
        return draw.start

    def _make(self, obs: list[Any], start: np.ndarray) -> None:
        with self._else_abort():
            try:
                self._contender.make(obs, self._level, start)
            except InputError as error:
                if not self._flown:
                    raise
                # It could be made once: what was flown since is not thrown away.
                raise Aborted(Phase.SURVEY, str(error)) from error
        self._made = self._flown = True

    @contextlib.contextmanager
    def _else_abort(self) -> Iterator[None]:
        """Disarm if something that has to be there before the start is not."""
        try:
            yield
        except BaseException:
            if self._crew is not None:
                self._crew.abort()
            raise

    def _run(
        self,
        index: int,
        referee: Referee,
        obs: list[Any],
        interrupt: Interrupt,
        recorder: Recorder | None,
    ) -> tuple[EpisodeResult, list[Any]]:
        crew, watch, on_step = self._crew, self._watch, self._on_step
        if isinstance(self._world, TrackedWorld):
            epoch = self._world.begin()
            if self._gates is not None:
                self._gates.start(epoch)
        if watch is not None:
            watch.begin()
        began = self._world.clock.now()

        def judged(verdict: Verdict, time: float) -> None:
            self._injection.judged(verdict, time)
            if self._gates is not None:
                self._gates.tell(time, recorder, self._injection)

        loop = ControlLoop(
            index,
            self._contender,
            self._world,
            referee,
            self._level.control_frequency,
            self._deadlines,
            interrupt,
            keep_alive=crew is not None,
            recorder=recorder,
            watch=watch,
            on_verdict=judged,
            on_step=None if on_step is None else lambda time: on_step(index, time),
        )
        try:
            result, obs = loop.fly(obs)
        except BaseException:
            if watch is not None:
                watch.end()
            if crew is not None:
                crew.abort()
            raise
        if self._gates is not None:
            result.events = [*result.events, *self._gates.events]
        if crew is not None:
            crew.durations[Phase.RUN.value] = self._world.clock.now() - began
            crew.announce(Phase.COMPLETE if result.completed else Phase.FAIL, result.termination)
        taken = False
        if watch is not None:
            if result.termination == CONTROLLER_TIMEOUT:
                watch.hand_over("controller_timeout")
            taken = watch.end()
            self._take_events(watch, result, recorder)
        if crew is not None:
            try:
                if taken:
                    crew.stand_down()
                else:
                    crew.bring_home()
            except CrazyarenaError as error:
                crew.abort()
                result.error = "\n".join(filter(None, (result.error, str(error))))
                self._note(recorder, result, "return aborted", str(error))
            if watch is not None:
                self._take_events(watch, result, recorder)
            for phase, seconds in crew.durations.items():
                self._note(recorder, result, "phase", f"{phase}: {seconds:.2f} s")
        return result, obs

    @staticmethod
    def _take_events(watch: Watch, result: EpisodeResult, recorder: Recorder | None) -> None:
        for event in watch.events():
            result.events = [*result.events, event]
            if recorder is not None:
                recorder.event(event.time, event.tick, event.name, event.detail)

    def _note(
        self, recorder: Recorder | None, result: EpisodeResult, name: str, detail: str
    ) -> None:
        event = Event(name, 0, result.flight_time, detail)
        result.events = [*result.events, event]
        if recorder is not None:
            recorder.event(event.time, event.tick, name, detail)

    def _finish(self, recorder: Recorder) -> None:
        if isinstance(self._world, TrackedWorld):
            rows = self._world.poll()
            if len(rows):
                recorder.epilogue(rows)
        recorder.close()

    def _aborted(self, index: int, referee: Referee, error: Aborted) -> EpisodeResult:
        result = EpisodeResult(
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
            error=str(error),
        )
        if self._crew is not None:
            result.phases = dict(self._crew.durations)
        return result

    def _hook(self, name: str, result: EpisodeResult) -> float:
        seconds, error = self._contender.hook(name)
        if error is not None:
            result.error = error
            result.termination = CONTROLLER_ERROR
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
            "seed": str(self._seed),
            "episode": str(index),
            "submission_sha256": self._contender.digest,
            "start": json.dumps(start.tolist()),
            "mass": repr(draw.mass),
            "inertia": json.dumps(draw.inertia.tolist()),
            "gates": json.dumps(track.gates.tolist()),
            "obstacles": json.dumps(track.obstacles.tolist()),
            "track_source": track.source,
        }
        scene = scene_update(track.gates, track.obstacles, self._level)
        file = None if self._out is None else self._out / f"episode_{index:03d}.mcap"
        return Recorder(file, metadata, scene, self._wall)


__all__ = ["FlightTrial", "OnPhase", "Watch"]
