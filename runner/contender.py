"""A contestant as the trial sees it: asked at every control step, answering in its own time."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from crazyarena.errors import CommandError
from crazyarena.levels.schema import Level
from crazyarena.runner.asked import Asked, checked
from crazyarena.runner.contestant import Submission, own_traceback
from crazyarena.runner.info import Canvas, initial_info

Array = NDArray[np.float64]


@dataclass(slots=True)
class Learn:
    """Arguments of ``interStepLearn`` after a control step."""

    action: Array
    state: Array
    reward: float
    done: bool
    info: dict[str, Any]


@dataclass(slots=True)
class Question:
    """One control step: ``learn`` comes first, from the step before; ``obs`` None asks for
    nothing but that."""

    step: int
    time: float
    obs: list[Any] | None
    reward: float
    done: bool
    info: dict[str, Any]
    learn: Learn | None = None


@dataclass(slots=True)
class Answer:
    """What came back.

    asked: None if the controller failed (or was asked for nothing); error: its traceback or
    what was wrong with its answer. seconds: from question to answer, as the asker measured it;
    command_seconds, learn_seconds: of the two calls, as the contestant's side measured them.
    """

    step: int
    asked: Asked | None
    error: str | None
    seconds: float
    command_seconds: float = 0.0
    learn_seconds: float = 0.0


class Contender(Protocol):
    """A loaded submission. Not thread-safe; one question at a time.

    digest: SHA-256 of its files; description: for the report, how it is run.
    """

    digest: str
    description: dict[str, Any]

    def make(self, obs: list[Any], level: Level, start: Array) -> None:
        """Construct the controller; raises InputError with its traceback if that fails."""
        ...

    def ask(self, question: Question) -> None:
        """Put a question; returns at once."""
        ...

    def wait(self, timeout: float) -> Answer | None:
        """The answer, or None if there is none within ``timeout`` s of wall time."""
        ...

    def hook(self, name: str) -> tuple[float, str | None]:
        """Call ``interEpisodeLearn`` or ``interEpisodeReset`` if the controller has it.

        Returns
        -------
        Wall time in s, and the traceback if it raised.
        """
        ...

    def close(self) -> None:
        """Get rid of it; idempotent."""
        ...


class Pilot:
    """The controller object and how it is called; the same inside and outside of a sandbox."""

    def __init__(self, submission: Submission) -> None:
        self._submission = submission
        self._canvas = Canvas()
        self._controller: Any = None

    def make(self, obs: list[Any], level: Level, start: Array) -> None:
        info = initial_info(level, self._canvas, start)
        self._controller = self._submission.make(list(obs), info, level.use_firmware, level.verbose)

    def answer(self, question: Question) -> Answer:
        """Call the controller for one control step; never raises for its failures."""
        started = time.perf_counter()
        learned = started
        where = "interStepLearn"
        try:
            if question.learn is not None:
                learn = getattr(self._controller, "interStepLearn", None)
                if learn is not None:
                    a = question.learn
                    learn(a.action, a.state, a.reward, a.done, a.info)
            learned = time.perf_counter()
            asked = None
            if question.obs is not None:
                where = "cmdFirmware"
                returned = self._controller.cmdFirmware(
                    question.time, question.obs, question.reward, question.done, question.info
                )
                done = time.perf_counter()
                asked = checked(returned, question.step)
            else:
                done = learned
            return Answer(
                question.step, asked, None, done - started, done - learned, learned - started
            )
        except CommandError as error:
            text = str(error)
        except KeyboardInterrupt:
            raise
        except BaseException as error:
            text = f"step {question.step}: {where} raised\n{own_traceback(error)}"
        return Answer(question.step, None, text, time.perf_counter() - started)

    def hook(self, name: str) -> tuple[float, str | None]:
        hook = getattr(self._controller, name, None)
        if hook is None:
            return 0.0, None
        started = time.perf_counter()
        try:
            hook()
        except KeyboardInterrupt:
            raise
        except BaseException as error:
            return time.perf_counter() - started, f"{name} raised\n{own_traceback(error)}"
        return time.perf_counter() - started, None

    def close(self) -> None:
        self._canvas.close()


class InProcess:
    """A contender that lives in this process: for dry runs of one's own code only."""

    def __init__(self, submission: Submission) -> None:
        self.digest = submission.digest
        self.submission = submission
        self.description = {"process": "that of the runner", "sandbox": []}
        self._pilot = Pilot(submission)
        self._question: Question | None = None

    def make(self, obs: list[Any], level: Level, start: Array) -> None:
        self._pilot.make(obs, level, start)

    def ask(self, question: Question) -> None:
        self._question = question

    def wait(self, timeout: float) -> Answer | None:
        question, self._question = self._question, None
        return None if question is None else self._pilot.answer(question)

    def hook(self, name: str) -> tuple[float, str | None]:
        return self._pilot.hook(name)

    def close(self) -> None:
        self._pilot.close()
        self.submission.close()
