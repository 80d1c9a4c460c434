"""One episode: the control loop of the competition on any world."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
from typing import Any

import numpy as np

from crazyarena.clock import Clock
from crazyarena.errors import CommandError
from crazyarena.runner.asked import FINISHED as FINISHED_VERB
from crazyarena.runner.asked import checked
from crazyarena.runner.contestant import own_traceback
from crazyarena.runner.recording import Recorder
from crazyarena.runner.referee import Event, Referee
from crazyarena.runner.result import (
    CONTROLLER_ERROR,
    FINISHED,
    INTERRUPTED,
    EpisodeResult,
    percentiles_ms,
)
from crazyarena.runner.scheduler import Scheduler
from crazyarena.runner.world import World


class Interrupt:
    """Ctrl-C as a wish to end at the next control step, so that no step is half recorded.

    Only while the controller's own code runs (which may never return) it interrupts at once.
    """

    def __init__(self) -> None:
        self.asked = False
        self.in_controller = False
        self._previous: Any = None

    def __enter__(self) -> Interrupt:
        if threading.current_thread() is threading.main_thread():
            self._previous = signal.signal(signal.SIGINT, self._handle)
        return self

    def __exit__(self, *exc: object) -> None:
        if self._previous is not None:
            signal.signal(signal.SIGINT, self._previous)
            self._previous = None

    def _handle(self, signum: int, frame: object) -> None:
        again = self.asked
        self.asked = True
        if self.in_controller or again:
            raise KeyboardInterrupt


class _Stopwatch:
    """Wall times of one kind of call, in s."""

    def __init__(self, capacity: int) -> None:
        self._times = np.empty(capacity)
        self.count = 0

    def add(self, seconds: float) -> None:
        if self.count == len(self._times):
            self._times = np.concatenate([self._times, np.empty_like(self._times)])
        self._times[self.count] = seconds
        self.count += 1

    @property
    def times(self) -> np.ndarray:
        return self._times[: self.count]


class Episode:
    """Flies one episode.

    Parameters
    ----------
    index: number of the episode, from 0.
    controller: the contestant's object.
    world: already reset.
    referee: already begun.
    rate: control steps per second.
    wall: measures the contestant's compute time.
    recorder: or None.
    on_step: called with the time (s) after every step, for a progress display.
    """

    def __init__(
        self,
        index: int,
        controller: Any,
        world: World,
        referee: Referee,
        rate: float,
        wall: Clock,
        interrupt: Interrupt,
        recorder: Recorder | None = None,
        on_step: Callable[[float], None] | None = None,
    ) -> None:
        self._index = index
        self._controller = controller
        self._world = world
        self._referee = referee
        self._rate = rate
        self._wall = wall
        self._interrupt = interrupt
        self._recorder = recorder
        self._on_step = on_step
        self._compute = _Stopwatch(1024)
        self._learning = _Stopwatch(1024)
        self._events: list[Event] = []
        self._collisions = 0
        self._violations = 0
        self._reward = 0.0
        self._steps = 0
        self._flight_time = 0.0
        self._completed = False
        self._error: str | None = None
        self._scheduler = Scheduler(world.clock, rate)

    def fly(self, obs: list[Any]) -> tuple[EpisodeResult, list[Any]]:
        """Fly until the referee, the controller or Ctrl-C ends it.

        ``obs`` is what the controller is told first; returns the result and the last ``obs``.
        """
        self._scheduler.start()
        try:
            reason, obs = self._loop(obs)
        except KeyboardInterrupt:
            reason = INTERRUPTED
        return self._result(reason), obs

    def _loop(self, obs: list[Any]) -> tuple[str, list[Any]]:
        command_of = self._controller.cmdFirmware
        learn = getattr(self._controller, "interStepLearn", None)
        send = self._world.send
        poll, judge = self._world.poll, self._referee.judge
        forces = self._world.motor_forces
        now, wait = self._wall.now, self._scheduler.wait
        recorder, interrupt, on_step = self._recorder, self._interrupt, self._on_step
        compute, learning = self._compute, self._learning
        # As the competition computed it: int(time * rate) is one too low at some steps.
        period = 1.0 / self._rate
        reward: float = 0
        done = False
        info: dict[str, Any] = {}
        step = 0
        while True:
            if interrupt.asked:
                return INTERRUPTED, obs
            time = step * period
            try:
                interrupt.in_controller = True
                started = now()
                returned = command_of(time, obs, reward, done, info)
                compute.add(now() - started)
                interrupt.in_controller = False
                asked = checked(returned, step)
                if asked.verb == FINISHED_VERB:
                    if recorder is not None:
                        recorder.command(time, asked, None)
                    return FINISHED, obs
                if asked.command is not None:
                    send(asked.command)
            except CommandError as error:
                return self._failed(str(error), time), obs
            except (Exception, SystemExit) as error:
                return self._failed(own_traceback(error), time, "cmdFirmware", step), obs
            finally:
                interrupt.in_controller = False
            if recorder is not None:
                recorder.command(time, asked, asked.command)
            wait()
            rows = poll()
            verdict = judge(rows)
            self._steps += 1
            self._flight_time = time
            self._collisions += verdict.collided
            self._violations += verdict.violated
            self._reward += verdict.reward
            self._completed = verdict.completed
            obs, reward, done, info = verdict.obs, verdict.reward, verdict.done, verdict.info
            if recorder is not None:
                recorder.step(rows, verdict.row)
            if verdict.events:
                self._events.extend(verdict.events)
                if recorder is not None:
                    for event in verdict.events:
                        recorder.event(event.time, event.tick, event.name, event.detail)
            if learn is not None:
                try:
                    interrupt.in_controller = True
                    started = now()
                    learn(forces(), verdict.state(), reward, done, info)
                    learning.add(now() - started)
                except (Exception, SystemExit) as error:
                    return self._failed(own_traceback(error), time, "interStepLearn", step), obs
                finally:
                    interrupt.in_controller = False
            if on_step is not None:
                on_step(time)
            if done:
                return self._referee.reason(verdict), obs
            step = self._scheduler.step

    def _failed(self, text: str, time: float, method: str = "", step: int = 0) -> str:
        self._error = f"step {step}: {method} raised\n{text}" if method else text
        if self._recorder is not None:
            self._recorder.event(
                time, self._referee.ticks, "controller error", text.splitlines()[-1]
            )
        return CONTROLLER_ERROR

    def _result(self, reason: str) -> EpisodeResult:
        learned = self._learning.times
        total = float(learned.sum())
        compute = self._compute.times
        return EpisodeResult(
            index=self._index,
            termination=reason,
            flight_time=self._flight_time,
            gates_passed=self._referee.gates_passed,
            gates=self._referee.gates,
            completed=self._completed,
            collisions=self._collisions,
            violations=self._violations,
            reward=self._reward,
            interstep_learning_time=total,
            interstep_learning_average=total / len(learned) if len(learned) else 0.0,
            interepisode_learning_time=0.0,
            steps=self._steps,
            gate_times=[e.time for e in self._events if e.name == "gate passed"],
            compute_ms=percentiles_ms(compute),
            over_period=int((compute > 1.0 / self._rate).sum()),
            late_ms=percentiles_ms(self._scheduler.lateness),
            skipped_steps=self._scheduler.skipped,
            error=self._error,
            events=self._events,
        )
