"""One episode of lsy_drone_racing: its loop, as its scripts run it, on virtual time."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyarena.clock import Clock, WallClock
from crazyarena.crazyswarm_compat import commands as cs
from crazyarena.errors import InputError
from crazyarena.levels.lsy.draw import LsyDraw
from crazyarena.levels.lsy.schema import LsyLevel
from crazyarena.runner.contestant.contract_2022.command_check import Asked
from crazyarena.runner.contestant.contract_lsy.dialogue import (
    EPISODE_HOOKS,
    Drawing,
    LsyContestant,
    LsyQuestion,
    Told,
)
from crazyarena.runner.judging import verdict_row as vd
from crazyarena.runner.judging.lsy_rules import (
    GATES_PASSED,
    LsyEvent,
    LsyReferee,
    LsyVerdict,
    lsy_why,
)
from crazyarena.runner.judging.result import (
    CONTROLLER_ERROR,
    CONTROLLER_TIMEOUT,
    INTERRUPTED,
    percentiles_ms,
)
from crazyarena.runner.records.lsy_scene import drawn_scene
from crazyarena.runner.records.recorder import Recorder
from crazyarena.runner.trial.lsy_showing import LsyShowing
from crazyarena.sim_backend.successor import SuccessorWorld
from crazyarena.sim_backend.trace import TR_CONTACT, TR_TIME

Array = NDArray[np.float64]

CONTROLLER_FINISHED = "CONTROLLER FINISHED"
_FULLSTATE = 1  # the number of that verb in recordings
COMMAND_LAYOUT = {
    "state": "asked_args, sent_args: a full state",
    "attitude": "asked_args, sent_args: roll, pitch, yaw (rad) in 6 to 8, thrust (N) in 10",
}
"""What commands look like in recordings, by control mode."""
_DRAWN_EVERY = 5  # steps
_QUICK = 3  # steps: one that finishes so soon has most likely forgotten step_callback


@dataclass
class LsyEpisodeResult:
    """Summary of an episode. Times in s.

    why: the termination with what the referee knows of it.
    time: as lsy_drone_racing counts it: the index of the last step over the rate.
    flight_time: the same with the last step. notes: where our rules, or the real race, would have
    decided otherwise, and hints.
    """

    index: int
    termination: str
    success: bool
    time: float
    flight_time: float
    gates_passed: int
    gates: int
    steps: int
    gate_times: list[float]
    compute_ms: dict[str, float]
    construct_ms: float
    wall_time: float
    error: str | None = None
    notes: list[str] = field(default_factory=list)
    events: list[LsyEvent] = field(default_factory=list)
    files: dict[str, str] = field(default_factory=dict)
    why: str = ""

    @property
    def clean(self) -> bool:
        """It passed all gates."""
        return self.success


class LsyEpisode:
    """Flies one episode; the caller closes contestant and recorder.

    most: s of wall time that all its answers together may take. show: to viewers, as it flies.
    """

    def __init__(
        self,
        index: int,
        level: LsyLevel,
        contestant: LsyContestant,
        world: SuccessorWorld,
        referee: LsyReferee,
        *,
        recorder: Recorder | None = None,
        on_step: Callable[[int, float], None] | None = None,
        wall: Clock | None = None,
        most: float = math.inf,
        show: LsyShowing | None = None,
    ) -> None:
        self._show = show
        self._most = most
        self._index = index
        self._level = level
        self._contestant = contestant
        self._world = world
        self._referee = referee
        self._recorder = recorder
        self._on_step = on_step
        self._wall = wall if wall is not None else WallClock()
        self._seconds: list[float] = []
        self._events: list[LsyEvent] = []
        self._error: str | None = None

    def fly(self, draw: LsyDraw) -> LsyEpisodeResult:
        """Reset, construct, fly; raises InputError when the first controller cannot be made."""
        started = self._wall.now()
        self._world.reset(draw)
        if self._show is not None:
            self._show.begin(self._index, draw)
        obs = self._referee.begin(draw, self._world.state)
        construct = self._wall.now()
        try:
            self._contestant.make(obs, self._level.config)
        except InputError as error:
            if self._index == 0:
                raise
            self._error = str(error)
            return self._result(CONTROLLER_ERROR, started, 0.0)
        built = self._wall.now() - construct
        try:
            reason = self._loop(obs)
            if reason not in (CONTROLLER_ERROR, CONTROLLER_TIMEOUT):
                for name in EPISODE_HOOKS:
                    _, trouble = self._contestant.hook(name)
                    if trouble is not None:
                        self._error, reason = trouble, CONTROLLER_ERROR
                        break
        except KeyboardInterrupt:
            reason = INTERRUPTED
        return self._result(reason, started, built)

    def _loop(self, obs: dict[str, Any]) -> str:
        rate = self._level.env.freq
        told: Told | None = None
        verdict: LsyVerdict | None = None
        step, thought = 0, 0.0
        while True:
            over = verdict is not None and (verdict.terminated or verdict.truncated)
            kept = self._recorder is not None or self._show is not None
            draw = kept and step % _DRAWN_EVERY == 0
            asked = None if over else obs
            answer = self._contestant.ask(LsyQuestion(step, told, asked, draw))
            if answer.error is not None:
                self._error = answer.error
                return CONTROLLER_ERROR
            thought += answer.seconds
            if thought > self._most:
                self._error = (
                    f"step {step}: its answers took {thought:.0f} s of wall time; "
                    f"{self._most:g} s are allowed in an episode"
                )
                return CONTROLLER_TIMEOUT
            if over:
                assert verdict is not None
                assert verdict.reason is not None
                return verdict.reason
            if answer.finished:
                return CONTROLLER_FINISHED
            assert answer.command is not None
            self._seconds.append(answer.command_seconds)
            # Commands travel in single precision there.
            command = answer.command.astype(np.float32)
            rows = self._world.step(command.astype(np.float64))
            verdict = self._referee.judge(rows)
            self._events += verdict.events
            obs = verdict.obs
            told = Told(command, obs, verdict.reward, verdict.terminated, verdict.truncated)
            if self._recorder is not None:
                record_command(self._recorder, step / rate, answer.command)
                ticks = self._referee.steps * len(rows)
                record_step(self._recorder, step / rate, ticks, rows, verdict, answer.drawings)
            step += 1
            if self._show is not None:
                self._show.step(step / rate, rows[-1], verdict, answer.drawings)
            if self._on_step is not None:
                self._on_step(self._index, step / rate)

    def _result(self, reason: str, started: float, built: float) -> LsyEpisodeResult:
        referee, rate = self._referee, self._level.env.freq
        success = referee.passed == referee.gates
        ended = referee.steps / rate
        why = lsy_why(reason, self._events, self._error, referee.passed, referee.gates, ended)
        if self._show is not None:
            self._show.end(ended, reason, why, success)
        return LsyEpisodeResult(
            index=self._index,
            termination=reason,
            success=success,
            time=max(0, referee.steps - 1) / rate,
            flight_time=ended,
            gates_passed=referee.passed,
            gates=referee.gates,
            steps=referee.steps,
            gate_times=list(referee.gate_times),
            compute_ms=percentiles_ms(np.array(self._seconds)),
            construct_ms=built * 1e3,
            wall_time=self._wall.now() - started,
            error=self._error,
            notes=[*referee.notes, *hints(reason, referee.steps, self._seconds, rate)],
            events=self._events,
            why=why,
        )


def record_command(recorder: Recorder, time: float, c: Array) -> None:
    """Record a command (13,) or (4,) of the step that begins at ``time`` s."""
    command: cs.Command
    if len(c) == 13:
        command = cs.FullState(c[:3], c[3:6], c[6:9], float(c[9]), c[10:13])
    else:
        # See COMMAND_LAYOUT: the recording's commands have places for full states only.
        nothing = np.full(3, np.nan)
        command = cs.FullState(nothing, nothing, c[:3], float("nan"), np.array([c[3], 0, 0]))
    recorder.command(time, Asked(_FULLSTATE, command), command)


def record_step(
    recorder: Recorder,
    time: float,
    ticks: int,
    rows: Array,
    verdict: LsyVerdict,
    drawings: Sequence[Drawing],
) -> None:
    """Record the ticks (k, TRACE_SIZE) of the step that began at ``time`` s, what the referee says
    of them, and what was drawn before; ``ticks``: since the episode began."""
    row = np.full(vd.SIZE, np.nan)
    row[vd.VD_TIME], row[vd.VD_TICKS] = rows[-1, TR_TIME], ticks
    row[vd.VD_GATE] = int(verdict.obs["target_gate"])
    row[vd.VD_COMPLETED] = verdict.reason == GATES_PASSED
    row[vd.VD_CONTACT] = rows[-1, TR_CONTACT]
    row[vd.VD_REWARD] = verdict.reward
    row[vd.VD_DONE], row[vd.VD_TRUNCATED] = verdict.terminated, verdict.truncated
    recorder.step(rows, row)
    for event in verdict.events:
        recorder.event(event.time, ticks, event.name, event.detail)
    if drawings:
        recorder.scene(time, drawn_scene(drawings, time))


def hints(reason: str, steps: int, seconds: Sequence[float], rate: int) -> list[str]:
    """What its contestant should know of an episode: that it ended it at once, or is slow.

    seconds: of each step's computing; rate: steps a second.
    """
    found = []
    usual = float(np.median(seconds)) if len(seconds) else 0.0
    if usual > 1.0 / rate:
        found.append(
            f"slow: a step takes {usual * 1e3:.0f} ms, and has {1e3 / rate:.0f}; in an arena its "
            "commands would come late"
        )
    if reason != CONTROLLER_FINISHED or steps > _QUICK:
        return found
    return [
        *found,
        "the controller ended the episode at once: step_callback answers True where it is not "
        "overridden. Write one that returns False",
    ]
