"""The contestant's controller, and how it is called where it lives."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyarena.errors import CommandError, InputError
from crazyarena.levels.schema import Level
from crazyarena.runner.contestant.contract_2022.command_check import checked
from crazyarena.runner.contestant.contract_2022.drawn import DRAWN
from crazyarena.runner.contestant.contract_2022.info import Canvas, initial_info
from crazyarena.runner.contestant.contract_lsy.dialogue import Drawing
from crazyarena.runner.contestant.dialogue import Answer, Question, told_parameters
from crazyarena.runner.contestant.interrupt import Interrupt
from crazyarena.runner.contestant.prints import PrintsShown
from crazyarena.runner.contestant.submission import Submission, own_traceback
from crazyarena.runner.timing.step_limit import StepLimit, TimeIsUp, bounded

Array = NDArray[np.float64]


class Pilot:
    """The controller object and how it is called; the same inside and outside of a sandbox.

    Attributes
    ----------
    learns: whether the controller that was made has ``interStepLearn``.
    """

    def __init__(self, submission: Submission) -> None:
        self._submission = submission
        self._canvas = Canvas()
        self._controller: Any = None
        self.learns = False

    def make(self, obs: list[Any], level: Level, start: Array) -> None:
        DRAWN.clear()
        info = initial_info(level, self._canvas, start)
        if parameters := told_parameters():
            info["parameters"] = parameters
        self._controller = self._submission.make(list(obs), info, level.use_firmware, level.verbose)
        self.learns = hasattr(self._controller, "interStepLearn")

    def answer(self, question: Question, on_learned: Callable[[], None] = lambda: None) -> Answer:
        """Call the controller for one control step; never raises for its failures.

        ``on_learned`` is called when it has learned from the step before, if it did.
        """
        started = time.perf_counter()
        learned = started
        where = "interStepLearn"
        try:
            if question.learn is not None and self.learns:
                a = question.learn
                self._controller.interStepLearn(a.action, a.state, a.reward, a.done, a.info)
                learned = time.perf_counter()
                on_learned()
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
            answer = Answer(
                question.step, asked, None, done - started, done - learned, learned - started
            )
            if (items := DRAWN.news(question.step)) is not None:
                answer.drawings = [
                    Drawing(kind, np.array(points), (*colour, 1.0), size)
                    for kind, points, colour, size in items
                ]
            return answer
        except CommandError as error:
            text = str(error)
        except (KeyboardInterrupt, TimeIsUp):
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
        except (KeyboardInterrupt, TimeIsUp):
            raise
        except BaseException as error:
            return time.perf_counter() - started, f"{name} raised\n{own_traceback(error)}"
        return time.perf_counter() - started, None

    def close(self) -> None:
        self._canvas.close()


class InProcess:
    """A contestant that lives in this process: for dry runs of one's own code only.

    It is interrupted when it does not return in time; make_timeout, hook_timeout: s of wall time
    for the constructor and the episode hooks.
    """

    def __init__(
        self, submission: Submission, make_timeout: float = 120.0, hook_timeout: float = 120.0
    ) -> None:
        self.digest = submission.digest
        self.submission = submission
        self.description = {"process": "that of the runner", "isolated": False, "sandbox": []}
        self.learns = False
        self._pilot = Pilot(submission)
        self._question: Question | None = None
        self._interrupt = Interrupt()
        self._limit = StepLimit()
        self._printing = PrintsShown(lambda: self._interrupt.in_controller)
        self._make_timeout, self._hook_timeout = make_timeout, hook_timeout

    def heed(self, interrupt: Interrupt) -> None:
        self._interrupt = interrupt

    def make(self, obs: list[Any], level: Level, start: Array) -> None:
        try:
            with self._interrupt.at_once(), bounded(self._make_timeout):
                self._pilot.make(obs, level, start)
        except TimeIsUp as late:
            raise InputError(
                f"{self.submission.file}: Controller(...) did not return within "
                f"{self._make_timeout:g} s\n{own_traceback(late)}"
            ) from None
        self.learns = self._pilot.learns

    def ask(self, question: Question) -> None:
        self._question = question

    def wait(self, timeout: float) -> Answer | None:
        question, self._question = self._question, None
        if question is None:
            return None
        interrupt = self._interrupt
        interrupt.in_controller = True
        started = time.perf_counter()
        limit = self._limit
        try:
            limit.begin(started, timeout)
            return self._pilot.answer(question)
        except TimeIsUp as late:
            text = (
                f"step {question.step}: no answer within {timeout:g} s of wall time\n"
                f"{own_traceback(late)}"
            )
            seconds = time.perf_counter() - started
            return Answer(question.step, None, text, seconds, timed_out=True)
        except KeyboardInterrupt as raised:
            text = f"step {question.step}: it raised\n{self._own(raised)}"
            return Answer(question.step, None, text, time.perf_counter() - started)
        finally:
            limit.end()
            interrupt.in_controller = False

    def hook(self, name: str) -> tuple[float, str | None]:
        try:
            with self._interrupt.at_once(), bounded(self._hook_timeout):
                return self._pilot.hook(name)
        except TimeIsUp as late:
            text = f"{name} did not return within {self._hook_timeout:g} s\n{own_traceback(late)}"
            return self._hook_timeout, text
        except KeyboardInterrupt as raised:
            return 0.0, f"{name} raised\n{self._own(raised)}"

    def _own(self, raised: KeyboardInterrupt) -> str:
        """Traceback of what the controller itself has raised; raises on what somebody asked for."""
        if self._interrupt.asked:
            raise raised
        return own_traceback(raised)

    def close(self) -> None:
        self._limit.close()
        self._printing.close()
        self._pilot.close()
        self.submission.close()
