"""A controller of lsy_drone_racing as a contestant of a trial.

Its dialogue is the same in every world: told of the step before, asked for the next. What differs
is where it lives (a *seat*: this process, or one behind walls), and what becomes of the numbers it
answers with (*translate*).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from crazyarena.crazyswarm_compat import commands as cs
from crazyarena.levels.schema import Level
from crazyarena.runner.contestant.contract_2022.command_check import FINISHED, VERBS, Asked
from crazyarena.runner.contestant.contract_lsy.dialogue import (
    LsyAnswer,
    LsyQuestion,
    Observation,
    Told,
)
from crazyarena.runner.contestant.dialogue import Answer, Question
from crazyarena.runner.contestant.interrupt import Interrupt

Array = NDArray[np.float64]
Translate = Callable[[NDArray[np.float32]], cs.Command]

_STREAM = VERBS["FULLSTATE"]  # the verb of every streamed setpoint


class Seat(Protocol):
    """Where the controller lives; one question at a time."""

    digest: str
    description: dict[str, Any]

    def make(self, obs: Observation, config: dict[str, Any]) -> None: ...

    def put(self, question: LsyQuestion) -> None:
        """Put a question; returns at once."""
        ...

    def take(self, timeout: float) -> LsyAnswer | None:
        """The answer, or None if there is none within ``timeout`` s of wall time."""
        ...

    def hook(self, name: str) -> tuple[float, str | None]: ...

    def close(self) -> None: ...


@dataclass(frozen=True, slots=True)
class ThrustScale:
    """Collective thrust in N as what a vehicle is told, 0..65535.

    most: N of all motors together; low, high: ends of the range it is cut to.
    """

    most: float
    low: float = 7000.0
    high: float = 65535.0

    def pwm(self, newton: float) -> int:
        """Share of the most, of 16 bits."""
        return int(min(max(newton / self.most * 65535.0, self.low), self.high))


def full_state(command: NDArray[np.float32]) -> cs.Command:
    """Numbers of state mode as a setpoint."""
    c = command.astype(np.float64)
    return cs.FullState(c[:3], c[3:6], c[6:9], float(c[9]), c[10:13])


def attitude(scale: ThrustScale) -> Translate:
    """Numbers of attitude mode as a setpoint: angles within a quarter turn, as theirs are cut."""

    def translate(command: NDArray[np.float32]) -> cs.Command:
        roll, pitch, yaw, thrust = command.astype(np.float64).tolist()
        roll, pitch = (min(max(a, -0.5 * math.pi), 0.5 * math.pi) for a in (roll, pitch))
        return cs.RollPitchYawThrust(
            roll, pitch, math.remainder(yaw, 2.0 * math.pi), scale.pwm(thrust)
        )

    return translate


class LsyPlayer:
    """A :class:`~crazyarena.runner.contestant.dialogue.Contestant`; a new controller by every
    :meth:`make`.

    Drawings are not asked for: in an arena they would cost time that is needed for flying.
    """

    learns = True

    def __init__(
        self,
        seat: Seat,
        config: dict[str, Any],
        translate: Translate,
    ) -> None:
        self._seat = seat
        self._config = config
        self._translate = translate
        self._last: NDArray[np.float32] | None = None
        self.digest = seat.digest
        self.description = seat.description

    def make(self, obs: Any, level: Level, start: Array) -> None:
        """Construct the controller of an episode; raises InputError if that fails."""
        self._last = None
        self._seat.make(obs, self._config)

    def heed(self, interrupt: Interrupt) -> None:
        """Ctrl-C is the runner's business."""

    def ask(self, question: Question) -> None:
        told = None
        if question.learn is not None and self._last is not None:
            info = question.learn.info
            told = Told(
                self._last,
                info["obs"],
                question.learn.reward,
                bool(info["terminated"]),
                bool(info["truncated"]),
            )
        obs: Any = question.obs
        self._seat.put(LsyQuestion(question.step, told, obs, draw=False))

    def wait(self, timeout: float) -> Answer | None:
        answer = self._seat.take(timeout)
        if answer is None:
            return None
        asked: Asked | None = None
        if answer.error is None:
            if answer.finished:
                asked = Asked(FINISHED, None)
            elif answer.command is not None:
                # Commands travel in single precision there.
                self._last = answer.command.astype(np.float32)
                asked = Asked(_STREAM, self._translate(self._last))
        return Answer(
            answer.step,
            asked,
            answer.error,
            answer.seconds,
            answer.command_seconds,
            answer.callback_seconds,
            answer.timed_out,
        )

    def hook(self, name: str) -> tuple[float, str | None]:
        return self._seat.hook(name)

    def close(self) -> None:
        self._seat.close()


__all__ = ["LsyPlayer", "Seat", "ThrustScale", "attitude", "full_state"]
