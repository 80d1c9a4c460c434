"""One race of lsy_drone_racing: its loop for several drones, as its scripts run it.

A controller is asked at its own rate while its drone is in the race; in between its last command
holds. It sees the observations of all drones, and is told its own number as ``info["rank"]``. What
ends one contestant (its drone is out, its code fails) ends nothing for the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from crazyarena.clock import Clock, WallClock
from crazyarena.errors import CrazyarenaError, InputError
from crazyarena.levels.lsy.draw import LsyDraw
from crazyarena.levels.lsy.schema import LsyLevel
from crazyarena.runner.contestant.contract_lsy.dialogue import (
    EPISODE_HOOKS,
    Drawing,
    LsyAnswer,
    LsyQuestion,
    Observation,
    Told,
)
from crazyarena.runner.judging.lsy_race_rules import RaceReferee, RaceVerdict
from crazyarena.runner.judging.lsy_rules import TIME_LIMIT, LsyEvent, lsy_why
from crazyarena.runner.judging.result import CONTROLLER_ERROR, INTERRUPTED, percentiles_ms
from crazyarena.runner.records.recorder import Recorder
from crazyarena.runner.trial.lsy_episode import (
    CONTROLLER_FINISHED,
    LsyEpisodeResult,
    hints,
    record_command,
    record_step,
)
from crazyarena.runner.trial.lsy_race_showing import RaceShowing
from crazyarena.sim_backend.successor_race import SuccessorRace

Array = NDArray[np.float64]

PATIENCE = 30.0
"""s of wall time for one answer; on virtual time nobody waits for it."""
_DRAWN_EVERY = 5  # steps


class Racer(Protocol):
    """A contestant: a controller in a process of its own; one question at a time."""

    digest: str
    description: dict[str, Any]

    def make(
        self, obs: Observation, config: dict[str, Any], info: dict[str, Any] | None = None
    ) -> None: ...

    def put(self, question: LsyQuestion) -> None: ...

    def take(self, timeout: float) -> LsyAnswer | None: ...

    def hook(self, name: str) -> tuple[float, str | None]: ...

    def kill(self) -> None: ...

    def close(self) -> None: ...


@dataclass
class RaceResult(LsyEpisodeResult):
    """What a race was for one drone; times as there: that of the step that passed the last gate.

    drone: its number, from 0. place: among those that passed all gates, from 1; equal times share
    one.
    """

    drone: int = 0
    controller: str = ""
    place: int | None = None


@dataclass
class _Flown:
    """What is known of a contestant while it flies."""

    reason: str | None = None
    error: str | None = None
    finished: bool = False
    command: NDArray[np.float32] | None = None
    built: float = 0.0
    seconds: list[float] = field(default_factory=list)
    events: list[LsyEvent] = field(default_factory=list)
    drawings: list[Drawing] = field(default_factory=list)


class RaceEpisode:
    """Flies one race; the caller closes contestants and recorders.

    Parameters
    ----------
    names: of the controllers, for people. recorders: one a drone, or none at all.
    show: to viewers, as it flies. patience: s of wall time for one answer.
    """

    def __init__(
        self,
        index: int,
        level: LsyLevel,
        racers: Sequence[Racer],
        names: Sequence[str],
        world: SuccessorRace,
        referee: RaceReferee,
        *,
        recorders: Sequence[Recorder] = (),
        show: RaceShowing | None = None,
        patience: float = PATIENCE,
        wall: Clock | None = None,
    ) -> None:
        self._index = index
        self._level = level
        self._racers = racers
        self._names = names
        self._world = world
        self._referee = referee
        self._recorders = recorders
        self._show = show
        self._patience = patience
        self._wall = wall if wall is not None else WallClock()
        self._flown = [_Flown() for _ in racers]

    def fly(self, draws: Sequence[LsyDraw]) -> list[RaceResult]:
        """Reset, construct all, fly; raises InputError when not one controller can be made for
        the first race."""
        started = self._wall.now()
        self._world.reset(draws)
        if self._show is not None:
            self._show.begin_race(self._index, draws)
        obs = self._referee.begin(draws, self._world.states)
        try:
            self._make(obs)
            if any(self._referee.racing):
                self._loop()
                self._call_hooks()
        except KeyboardInterrupt:
            for flown in self._flown:
                flown.reason = flown.reason or INTERRUPTED
        results = self._results(self._wall.now() - started)
        if self._show is not None:
            self._show_end(results)
        return results

    def _show_end(self, results: Sequence[RaceResult]) -> None:
        assert self._show is not None
        told = ", ".join(f"drone {r.drone}: {r.termination}" for r in results)
        last = max(r.steps for r in results) / self._level.env.freq
        self._show.end(last, told, told, all(r.success for r in results))

    def _make(self, obs: Observation) -> None:
        failed: list[CrazyarenaError] = []
        for drone, (racer, flown) in enumerate(zip(self._racers, self._flown, strict=True)):
            begun = self._wall.now()
            try:
                racer.make(obs, self._level.config_of(drone), {"rank": drone})
            except CrazyarenaError as error:
                failed.append(error)
                self._fail(drone, str(error))
            flown.built = self._wall.now() - begun
        if self._index == 0 and len(failed) == len(self._racers):
            raise InputError(str(failed[0]))

    def _loop(self) -> None:
        periods, referee = self._level.periods, self._referee
        step = 0
        while True:
            asked = [d for d in self._racing() if step % periods[d] == 0]
            obs = referee.obs
            answers = self._answers({d: LsyQuestion(step, None, obs) for d in asked})
            for drone, answer in answers.items():
                flown = self._flown[drone]
                if answer.command is None:
                    self._fail(drone, answer.error or f"step {step}: it sent no command")
                    continue
                flown.seconds.append(answer.command_seconds)
                # Commands travel in single precision there.
                flown.command = answer.command.astype(np.float32)
            if not any(referee.racing):
                return
            commands: list[Array | None] = [None] * len(self._racers)
            for drone in self._racing():
                command = self._flown[drone].command
                assert command is not None  # all are asked in the first step
                commands[drone] = command.astype(np.float64)
            rows = self._world.step(commands)
            flew = [d for d in asked if rows[d] is not None]
            verdict = referee.judge(rows)
            self._take_down(step, flew, rows, verdict)
            self._tell(step, flew, verdict)
            step += 1
            if self._show is not None:
                drawn = {d: f.drawings for d, f in enumerate(self._flown) if f.drawings}
                self._show.step_race(step / self._level.env.freq, rows, verdict, drawn)
            if verdict.terminated or verdict.truncated or self._all_finished():
                break
        for drone in self._racing():
            flown = self._flown[drone]
            flown.reason = flown.reason or (
                TIME_LIMIT if verdict.truncated else CONTROLLER_FINISHED
            )

    def _racing(self) -> list[int]:
        return [drone for drone, racing in enumerate(self._referee.racing) if racing]

    def _all_finished(self) -> bool:
        """Whether no controller wants to go on; until then those that have finished fly, too."""
        return all(self._flown[drone].finished for drone in self._racing())

    def _answers(self, questions: dict[int, LsyQuestion]) -> dict[int, LsyAnswer]:
        """Ask all at once, and wait for all."""
        begun = self._wall.now()
        for drone, question in questions.items():
            self._racers[drone].put(question)
        answers: dict[int, LsyAnswer] = {}
        for drone, question in questions.items():
            left = max(0.0, self._patience - (self._wall.now() - begun))
            answer = self._racers[drone].take(left)
            if answer is None:
                self._racers[drone].kill()
                text = f"step {question.step}: no answer within {self._patience:g} s of wall time"
                answer = LsyAnswer(question.step, error=text, timed_out=True)
            answers[drone] = answer
        return answers

    def _tell(self, step: int, flew: Sequence[int], verdict: RaceVerdict) -> None:
        """Call ``step_callback`` of those that were asked for this step's command."""
        kept = bool(self._recorders) or self._show is not None
        draw = kept and step % _DRAWN_EVERY == 0
        questions = {}
        for drone in flew:
            command = self._flown[drone].command
            assert command is not None
            reward = verdict.each[drone].reward
            told = Told(command, verdict.obs, reward, verdict.terminated, verdict.truncated)
            questions[drone] = LsyQuestion(step, told, None, draw)
        for drone, answer in self._answers(questions).items():
            flown = self._flown[drone]
            flown.finished = answer.finished
            if answer.drawings:
                flown.drawings = answer.drawings
            if answer.error is not None:
                self._fail(drone, answer.error)

    def _fail(self, drone: int, error: str) -> None:
        flown = self._flown[drone]
        flown.reason, flown.error = CONTROLLER_ERROR, error
        self._referee.withdraw(drone)

    def _take_down(
        self, step: int, flew: Sequence[int], rows: Sequence[Array | None], verdict: RaceVerdict
    ) -> None:
        began = step / self._level.env.freq
        for drone, said in verdict.each.items():
            flown, ticks = self._flown[drone], rows[drone]
            assert ticks is not None
            flown.events += said.events
            if said.reason is not None:
                flown.reason = said.reason
            drawings, flown.drawings = flown.drawings, []
            if not self._recorders:
                continue
            recorder = self._recorders[drone]
            if drone in flew:
                assert flown.command is not None
                record_command(recorder, began, flown.command.astype(np.float64))
            count = self._referee.drones[drone].steps * len(ticks)
            record_step(recorder, began, count, ticks, said, drawings)

    def _call_hooks(self) -> None:
        for drone, (racer, flown) in enumerate(zip(self._racers, self._flown, strict=True)):
            for name in EPISODE_HOOKS:
                if flown.error is None:
                    _, trouble = racer.hook(name)
                    if trouble is not None:
                        self._fail(drone, trouble)

    def _results(self, wall: float) -> list[RaceResult]:
        rate = self._level.env.freq
        results = []
        for drone, (flown, referee) in enumerate(
            zip(self._flown, self._referee.drones, strict=True)
        ):
            reason, success = flown.reason or CONTROLLER_FINISHED, referee.passed == referee.gates
            flight_time = referee.steps / rate
            time = max(0, referee.steps - 1) / rate
            if success:
                flight_time = referee.gate_times[-1]
                time = (round(flight_time * rate) - 1) / rate
            own = self._level.env.kwargs[drone].freq
            told = (flown.events, flown.error, referee.passed, referee.gates)
            results.append(
                RaceResult(
                    index=self._index,
                    termination=reason,
                    success=success,
                    time=time,
                    flight_time=flight_time,
                    gates_passed=referee.passed,
                    gates=referee.gates,
                    steps=referee.steps,
                    gate_times=list(referee.gate_times),
                    compute_ms=percentiles_ms(np.array(flown.seconds)),
                    construct_ms=flown.built * 1e3,
                    wall_time=wall,
                    error=flown.error,
                    notes=[
                        *referee.notes,
                        *hints(reason, referee.steps, flown.seconds, own),
                        *_alone(flown.error, referee.steps),
                    ],
                    events=flown.events,
                    why=lsy_why(reason, *told, referee.steps / rate),
                    drone=drone,
                    controller=self._names[drone],
                )
            )
        times = sorted(result.time for result in results if result.success)
        for result in results:
            if result.success:
                result.place = times.index(result.time) + 1
        return results


def _alone(error: str | None, steps: int) -> list[str]:
    """What a controller that failed at once may have missed."""
    if error is None or steps > 0:
        return []
    return [
        "was it written for one drone? In a race observations have a row a drone, "
        "obs['pos'][info['rank']] is its own"
    ]
