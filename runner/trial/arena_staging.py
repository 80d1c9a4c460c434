"""A vehicle that is brought up, watched, brought home and disarmed, simulated or real."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator
from typing import Any

import numpy as np

from crazyarena.errors import CrazyarenaError
from crazyarena.levels.draw import Draw
from crazyarena.levels.schema import Level
from crazyarena.runner.contestant.interrupt import Interrupt
from crazyarena.runner.judging.referee import Event, Verdict
from crazyarena.runner.judging.result import CONTROLLER_TIMEOUT, EpisodeResult
from crazyarena.runner.records.recorder import Recorder
from crazyarena.runner.rig.watch import Watch
from crazyarena.runner.timing.realtime import quiet_collector
from crazyarena.runner.timing.steady import steady
from crazyarena.runner.trial.injection import Injection
from crazyarena.runner.trial.moving_gates import MovingGates
from crazyarena.runner.trial.phase import Aborted, MeasuredTrack, Phase
from crazyarena.runner.trial.phases import Crew
from crazyarena.runner.trial.staging import Staging, note
from crazyarena.runner.trial.tracked_world import TrackedWorld
from crazyarena.safety.estop import interrupt_policy


class ArenaStaging(Staging):
    """Connect, pre-flight, survey, arm, countdown; and after the run return, land, disarm.

    Parameters
    ----------
    crew: does it.
    world: that the run is flown in.
    watch: ends runs for safety's sake.
    real_time: ask for locked memory and real-time scheduling during runs.
    """

    keep_alive = True
    fresh = True
    logs = True

    def __init__(
        self,
        crew: Crew,
        world: TrackedWorld,
        level: Level,
        watch: Watch | None = None,
        injection: Injection | None = None,
        real_time: bool = False,
    ) -> None:
        super().__init__(injection or Injection())
        self.watch = watch
        self._crew = crew
        self._world = world
        self._steady = real_time
        self._began = 0.0
        self.renews = world.rig.renews
        self._gates = MovingGates(level, world.rig) if level.track.tracked else None

    @contextlib.contextmanager
    def interruptible(self) -> Iterator[Interrupt]:
        """Ctrl-C ends the run; once more stops the motors."""
        interrupt = Interrupt()
        self._crew.interrupted = lambda: interrupt.asked
        main = threading.current_thread() is threading.main_thread()
        if self.watch is None or not main:
            with interrupt:
                yield interrupt
            return

        def land(name: str) -> None:
            interrupt.asked = True

        with interrupt_policy(land, self.watch.stop):
            yield interrupt

    def metadata(self, track: MeasuredTrack) -> dict[str, str]:
        vehicle = self._world.rig.description.get("vehicle")
        named = {} if vehicle is None else {"vehicle": str(vehicle)}
        return {**super().metadata(track), **named}

    def prepare(self, draw: Draw) -> MeasuredTrack:
        track = self._crew.prepare()
        if self._gates is not None:
            self._gates.begin(track.gates)
        return track

    def follow(self) -> Any:
        return None if self._gates is None else self._gates.at

    def start(self, draw: Draw) -> np.ndarray:
        state = self._world.state()
        if state is None:
            raise Aborted(Phase.SURVEY, "the vehicle was never seen")
        return state

    @contextlib.contextmanager
    def else_abort(self) -> Iterator[None]:
        try:
            yield
        except BaseException:
            self._crew.abort()
            raise

    @contextlib.contextmanager
    def on_stage(self) -> Iterator[None]:
        with contextlib.ExitStack() as quiet:
            # Before the motors turn: both take long enough to be missed in the air.
            quiet.enter_context(quiet_collector())
            if self._steady:
                self.in_force = quiet.enter_context(steady(self._world.clock))
            self._crew.launch()
            yield

    def begin(self) -> None:
        epoch = self._world.begin()
        if self._gates is not None:
            self._gates.start(epoch)
        if self.watch is not None:
            self.watch.begin()
        self._began = self._world.clock.now()

    def judged(self, verdict: Verdict, time: float, recorder: Recorder | None) -> None:
        super().judged(verdict, time, recorder)
        if recorder is not None:
            recorder.vehicle(self._world.logged())
        if self._gates is not None:
            assert self._injection is not None
            self._gates.tell(time, recorder, self._injection)

    def failed(self) -> None:
        if self.watch is not None:
            self.watch.end()
        self._crew.abort()

    def end(self, result: EpisodeResult, recorder: Recorder | None) -> None:
        crew, watch = self._crew, self.watch
        if self._gates is not None:
            result.events = [*result.events, *self._gates.events]
        crew.durations[Phase.RUN.value] = self._world.clock.now() - self._began
        crew.announce(Phase.COMPLETE if result.completed else Phase.FAIL, result.termination)
        taken = False
        if watch is not None:
            if result.termination == CONTROLLER_TIMEOUT:
                watch.hand_over("controller_timeout")
            taken = watch.end()
            self._take_events(result, recorder)
        try:
            if taken:
                crew.stand_down()
            else:
                crew.bring_home()
        except CrazyarenaError as error:
            crew.abort()
            result.error = "\n".join(filter(None, (result.error, str(error))))
            self._note(recorder, result, "return aborted", str(error))
        self._take_events(result, recorder)
        for phase, seconds in crew.durations.items():
            self._note(recorder, result, "phase", f"{phase}: {seconds:.2f} s")

    def finish(self, recorder: Recorder) -> None:
        rows = self._world.poll()
        if len(rows):
            recorder.epilogue(rows)
        recorder.vehicle(self._world.logged())
        super().finish(recorder)

    @property
    def durations(self) -> dict[str, float]:
        return dict(self._crew.durations)

    def _take_events(self, result: EpisodeResult, recorder: Recorder | None) -> None:
        if self.watch is not None:
            for event in self.watch.events():
                note(recorder, result, event)

    @staticmethod
    def _note(recorder: Recorder | None, result: EpisodeResult, name: str, detail: str) -> None:
        note(recorder, result, Event(name, 0, result.flight_time, detail))
