"""The control loop of a trial: absolute ticks, deadlines for the contestant, on any clock.

At tick k the contestant is asked with the latest observation. An answer within the period is
sent as soon as it is there. One that misses its tick is sent at the first tick it is ready for,
and meanwhile a policy decides what the vehicle hears. Too many misses in a row end the run.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

import numpy as np

from crazyarena.crazyswarm_compat import commands as cs
from crazyarena.errors import BackendError, CommandError
from crazyarena.plain_text import shown
from crazyarena.runner.contestant.compute import Compute, make_waiter
from crazyarena.runner.contestant.contract_2022.command_check import FINISHED as FINISHED_VERB
from crazyarena.runner.contestant.contract_2022.command_check import NONE
from crazyarena.runner.contestant.contract_lsy.dialogue import Drawing
from crazyarena.runner.contestant.dialogue import Answer, Contestant, Learn, Question
from crazyarena.runner.contestant.interrupt import Interrupt
from crazyarena.runner.judging.referee import Event, Verdict
from crazyarena.runner.judging.result import (
    CONTROLLER_ERROR,
    CONTROLLER_TIMEOUT,
    FINISHED,
    INTERRUPTED,
    SAFETY,
    EpisodeResult,
    percentiles_ms,
)
from crazyarena.runner.records.recorder import Recorder
from crazyarena.runner.rig.watch import Watch
from crazyarena.runner.timing.scheduler import Scheduler
from crazyarena.runner.trial.contract import Contract
from crazyarena.runner.trial.world import World
from crazyarena.sim_backend.trace import TR_POS, TRACE_SIZE


class LatePolicy(StrEnum):
    """What a vehicle that follows streamed setpoints hears while the contestant is late."""

    HOLD = "hold"
    """The last setpoint again."""
    EXTRAPOLATE = "extrapolate"
    """The last setpoint moved on along its own velocity and acceleration."""
    HOVER = "hover"
    """Stay where the last pose was."""


@dataclass(frozen=True, slots=True)
class Deadlines:
    """policy: see :class:`LatePolicy`; max_misses: so many missed ticks in a row end the run;
    compute: how thinking is charged to a virtual clock."""

    policy: LatePolicy = LatePolicy.HOLD
    max_misses: int = 15
    compute: Compute = field(default_factory=Compute)


class ControlLoop:
    """Flies one episode.

    Parameters
    ----------
    index: number of the episode, from 0.
    world: its episode time begins when :meth:`fly` is called.
    referee: already begun. rate: control ticks per second.
    contract: whose contestant flies.
    keep_alive: a setpoint is repeated at every tick at which the contestant asks for nothing
        new: vehicles do not fly on with a stream that fell silent, and the contract has them.
    watch: asked at every tick; its verdict ends the run.
    on_verdict: called with every verdict and the time (s) at which it is told.
    on_step: called with the time (s) after every tick.
    on_drawings: called with all that the contestant has drawn, and the time, when that has changed.
    thought_before: s of wall time that the contestant has taken earlier in the trial.
    """

    def __init__(
        self,
        index: int,
        contestant: Contestant,
        world: World,
        referee: Any,
        rate: float,
        deadlines: Deadlines,
        interrupt: Interrupt,
        contract: Contract,
        *,
        keep_alive: bool,
        recorder: Recorder | None = None,
        watch: Watch | None = None,
        on_verdict: Callable[[Verdict, float], None] = lambda verdict, time: None,
        on_step: Callable[[float], None] | None = None,
        on_drawings: Callable[[list[Drawing], float], None] = lambda drawings, time: None,
        thought_before: float = 0.0,
    ) -> None:
        budget = deadlines.compute.budget
        self._thought_before = thought_before
        self._thought = 0.0
        self._most_thought = min(budget.episode, budget.trial - thought_before)
        self._index = index
        self._contestant = contestant
        self._world = world
        self._referee = referee
        self._rate = rate
        self._deadlines = deadlines
        self._interrupt = interrupt
        self._contract = contract
        self._keep_alive = keep_alive
        self._recorder = recorder
        self._watch = watch
        self._on_verdict = on_verdict
        self._on_step = on_step
        self._on_drawings = on_drawings
        patience = deadlines.max_misses / rate
        self._waiter = make_waiter(contestant, world.clock, deadlines.compute, patience)
        self._scheduler = Scheduler(world.clock, rate)
        self._events: list[Event] = []
        self._seconds: list[float] = []
        self._command_seconds: list[float] = []
        self._learned = 0
        self._learn_seconds = 0.0
        self._last: cs.Command | None = None
        self._sent_at = 0.0
        self._collisions = self._violations = self._steps = 0
        self._missed = self._late = self._consecutive = self._overruns = 0
        self._reward = 0.0
        self._flight_time = 0.0
        self._completed = False
        self._error: str | None = None
        self._rows = np.empty((0, TRACE_SIZE))
        self._highest = -np.inf
        self._first: str | None = None

    def fly(self, obs: Any) -> tuple[EpisodeResult, Any]:
        """Fly until the referee, the contestant, the watchdog or Ctrl-C ends it.

        ``obs`` is what the contestant is told first; returns the result and the last ``obs``.
        """
        self._obs = obs
        self._scheduler.start()
        try:
            reason = self._loop()
        except KeyboardInterrupt:
            reason = INTERRUPTED
        return self._result(reason), self._obs

    @property
    def row(self) -> np.ndarray | None:
        """(TRACE_SIZE,) the last that was judged; None before the first."""
        return self._rows[-1] if len(self._rows) else None

    @property
    def missed(self) -> int:
        """Ticks so far at which no command was sent."""
        return self._missed

    @property
    def thought(self) -> float:
        """s of wall time that the contestant has taken for its answers."""
        return self._thought

    def _loop(self) -> str:
        period = 1.0 / self._rate
        scheduler, waiter, world = self._scheduler, self._waiter, self._world
        learns = self._contestant.learns
        reward: float = 0
        done = False
        info: dict[str, Any] = {}
        learn: Learn | None = None
        pending: int | None = None
        verdict: Verdict | None = None
        while True:
            step = scheduler.step
            time = step * period
            if self._interrupt.asked:
                return INTERRUPTED
            if self._watch is not None and self._is_stopped():
                return SAFETY
            applied = False
            if pending is not None:
                answer = waiter.wait(world.clock.now())
                if answer is not None:
                    pending = None
                    applied = True
                    self._late += 1
                    self._note("late command", step, f"asked at step {answer.step}")
                    end = self._take(answer, step, time)
                    if end is not None:
                        return end
                else:
                    try:
                        self._fill_in(period)
                    except (BackendError, CommandError) as error:
                        return self._refused(error, step, time)
            if pending is None:
                pending = step
                self._contestant.ask(Question(step, time, self._obs, reward, done, info, learn))
                waiter.asked(step)
                learn = None
                answer = waiter.wait(scheduler.deadline(step + 1))
                if answer is not None:
                    pending = None
                    applied = True
                    end = self._take(answer, step, time)
                    if end is not None:
                        return end
            late = scheduler.wait()
            if self._watch is not None:
                self._watch.late(late)
                if late * self._rate >= 1.0 and self._is_stopped():
                    # Away for so long, what it sees now is what the watchdog has done.
                    return SAFETY
            if not applied:
                self._missed += 1
                self._consecutive += 1
                self._note("deadline missed", step, f"{self._consecutive} in a row")
                if self._consecutive >= self._deadlines.max_misses:
                    self._error = (
                        f"no command for {self._consecutive} ticks "
                        f"({self._consecutive * period:.2f} s), asked at step {pending}"
                    )
                    return CONTROLLER_TIMEOUT
            rows = world.poll()
            if len(rows) == 0 and verdict is None:
                continue
            verdict = self._judge(rows, time)
            self._obs, reward, done, info = verdict.obs, verdict.reward, verdict.done, verdict.info
            if learns:
                learn = Learn(world.motor_forces(), verdict.state(), reward, done, info)
            if self._on_step is not None:
                self._on_step(time)
            if done:
                if learn is not None and pending is None:
                    trouble = self._learn_last(learn, scheduler.step)
                    if trouble is not None:
                        return trouble
                return self._referee.reason(verdict)

    def _judge(self, rows: np.ndarray, time: float) -> Verdict:
        verdict = self._referee.judge(rows)
        self._steps += 1
        self._flight_time = time
        self._collisions += verdict.collided
        self._violations += verdict.violated
        self._reward += verdict.reward
        self._completed = verdict.completed
        if len(rows):
            self._rows = rows
            self._highest = max(self._highest, float(rows[-1, TR_POS + 2]))
        if self._recorder is not None:
            self._recorder.step(rows, verdict.row)
            for event in verdict.events:
                self._recorder.event(event.time, event.tick, event.name, event.detail)
        self._events.extend(verdict.events)
        self._on_verdict(verdict, self._scheduler.step / self._rate)
        return verdict

    def _take(self, answer: Answer, step: int, time: float) -> str | None:
        """Act on an answer; returns the reason if the run ends with it."""
        self._seconds.append(answer.seconds)
        self._command_seconds.append(answer.command_seconds)
        if answer.learn_seconds > 0.0:
            self._learned += 1
            self._learn_seconds += answer.learn_seconds
        self._overruns += answer.seconds * self._rate > 1.0
        self._consecutive = 0
        if answer.drawings is not None:
            self._on_drawings(answer.drawings, time)
        if self._watch is not None:
            self._watch.answered()
        if answer.timed_out:
            return self._timed_out(answer.error or "no answer", time)
        if answer.error is not None or answer.asked is None:
            return self._failed(answer.error or "no command", time)
        self._thought += answer.seconds
        if self._thought > self._most_thought:
            return self._timed_out(self._over_budget(answer.step), time)
        asked = answer.asked
        verb, sent = asked.verb, asked.command
        if self._first is None:
            self._first = asked.name
        if verb == NONE and self._keep_alive:
            sent = self._last
        if verb == FINISHED_VERB:
            sent = None
        elif sent is not None:
            try:
                self._world.send(sent)
            except (BackendError, CommandError) as error:
                return self._refused(error, step, time)
        if asked.command is not None:
            # High-level commands are carried out by the vehicle itself, once.
            streamed = isinstance(asked.command, cs.STREAMED)
            self._last = asked.command if streamed else None
            self._sent_at = time
        if self._recorder is not None:
            self._recorder.command(time, asked, sent)
        return FINISHED if verb == FINISHED_VERB else None

    def _over_budget(self, step: int) -> str:
        budget = self._deadlines.compute.budget
        spent, limit, what = self._thought, budget.episode, "this episode"
        if spent <= limit:
            spent, limit, what = self._thought_before + spent, budget.trial, "this trial"
        return (
            f"step {step}: it has taken {spent:.0f} s of wall time for its answers in {what}; "
            f"{limit:g} s are allowed"
        )

    def _timed_out(self, text: str, time: float) -> str:
        self._failed(text, time)
        return CONTROLLER_TIMEOUT

    def _is_stopped(self) -> bool:
        stopped = None if self._watch is None else self._watch.verdict()
        if stopped is not None:
            self._error = stopped
        return stopped is not None

    def _refused(self, error: BackendError | CommandError, step: int, time: float) -> str:
        """A command was refused: the watchdog may have been faster, or the link is gone; else it
        was a bad one."""
        return SAFETY if self._is_stopped() else self._failed(f"step {step}: {error}", time)

    def _fill_in(self, period: float) -> None:
        """What a vehicle on a stream hears at a tick without a command."""
        last = self._last
        if last is None or not self._keep_alive:
            return
        command = last
        if not isinstance(last, cs.FullState):
            pass  # an attitude leads on by itself, and is best held
        elif self._deadlines.policy is LatePolicy.EXTRAPOLATE:
            position, velocity = np.asarray(last.position), np.asarray(last.velocity)
            push = np.asarray(last.acceleration)
            command = cs.FullState(
                position + velocity * period + 0.5 * period**2 * push,
                velocity + push * period,
                push,
                last.yaw,
                last.omega,
            )
        elif self._deadlines.policy is LatePolicy.HOVER and len(self._rows):
            rest = np.zeros(3)
            command = cs.FullState(self._rows[-1, TR_POS : TR_POS + 3], rest, rest, last.yaw, rest)
        self._last = command
        self._world.send(command)

    def _learn_last(self, learn: Learn, step: int) -> str | None:
        """Tell of the last step, for which no command is asked."""
        question = Question(step, step / self._rate, None, 0.0, True, {}, learn)
        self._contestant.ask(question)
        limit = self._deadlines.compute.budget.step
        answer = self._contestant.wait(limit)
        if answer is None or answer.timed_out:
            self._error = f"interStepLearn did not return within {limit:g} s after the last step"
            return CONTROLLER_TIMEOUT
        self._learned += answer.learn_seconds > 0.0
        self._learn_seconds += answer.learn_seconds
        return None if answer.error is None else self._failed(answer.error, step / self._rate)

    def _note(self, name: str, step: int, detail: str) -> None:
        event = Event(name, self._referee.ticks, step / self._rate, detail)
        self._events.append(event)
        if self._recorder is not None:
            self._recorder.event(event.time, event.tick, name, detail)

    def _failed(self, text: str, time: float) -> str:
        text = shown(text)  # the contestant's words, wherever they came from
        self._error = text
        if self._recorder is not None:
            lines = text.splitlines() or [""]
            self._recorder.event(time, self._referee.ticks, "controller error", lines[-1])
        return CONTROLLER_ERROR

    def _result(self, reason: str) -> EpisodeResult:
        total, learned = self._learn_seconds, self._learned
        machine, own = self._scheduler.shares
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
            interstep_learning_average=total / learned if learned else 0.0,
            interepisode_learning_time=0.0,
            steps=self._steps,
            gate_times=[e.time for e in self._events if e.name == "gate passed"],
            compute_ms=percentiles_ms(np.array(self._command_seconds)),
            over_period=self._overruns,
            late_ms=percentiles_ms(self._scheduler.lateness),
            skipped_steps=self._scheduler.skipped,
            skipped_own_steps=self._scheduler.skipped_own,
            late_machine_ms=percentiles_ms(machine),
            late_own_ms=percentiles_ms(own),
            standstill_ms=percentiles_ms(self._scheduler.standstill),
            missed_ticks=self._missed,
            late_commands=self._late,
            answer_ms=percentiles_ms(np.array(self._seconds)),
            error=self._error,
            events=self._events,
            why=self._why(reason),
        )

    def _why(self, reason: str) -> str:
        return self._contract.why(
            self._referee,
            reason,
            self._events,
            self._rows,
            self._highest,
            self._first,
            self._error,
        )
