"""The controller object and how it is called; the same inside and outside of a sandbox."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from crazyarena.errors import CommandError
from crazyarena.plain_text import shown
from crazyarena.runner.contestant.contract_lsy.attribute_dict import level_config
from crazyarena.runner.contestant.contract_lsy.command_check import checked_command
from crazyarena.runner.contestant.contract_lsy.dialogue import (
    Drawing,
    LsyAnswer,
    LsyQuestion,
    Observation,
)
from crazyarena.runner.contestant.contract_lsy.submission import LsySubmission, controller_traceback
from crazyarena.runner.timing.step_limit import StepLimit, TimeIsUp, bounded

_PATIENCE = 30.0  # s of wall time for one answer
MAX_POINTS = 1000
"""Of all drawings of a step; more are left out."""


class LsyPilot:
    """A controller of an episode, made anew by every :meth:`make`."""

    def __init__(self, submission: LsySubmission) -> None:
        self._submission = submission
        self._controller: Any = None
        self._size = 13
        self._draws = True
        self._info: dict[str, Any] = {}

    def make(
        self, obs: Observation, config: dict[str, Any], info: dict[str, Any] | None = None
    ) -> None:
        self._info = dict(info or {})
        full = level_config(config)
        self._size = 4 if full.env.control_mode == "attitude" else 13
        self._draws = True
        self._controller = None
        self._controller = self._submission.make(fresh(obs), dict(self._info), full)

    def ask(self, question: LsyQuestion) -> LsyAnswer:
        """Never raises for the controller's failures."""
        started = time.perf_counter()
        answer = LsyAnswer(question.step)
        where = "step_callback"
        try:
            told = question.told
            if told is not None:
                answer.finished = bool(
                    self._controller.step_callback(
                        told.action.copy(), fresh(told.obs), told.reward, told.terminated,
                        told.truncated, dict(self._info),
                    )
                )  # fmt: skip
                answer.callback_seconds = time.perf_counter() - started
            if question.draw and not answer.finished and self._draws:
                answer.drawings = self._drawings()
            if question.obs is not None and not answer.finished:
                where = "compute_control"
                begun = time.perf_counter()
                command = self._controller.compute_control(fresh(question.obs), dict(self._info))
                answer.command_seconds = time.perf_counter() - begun
                answer.command = checked_command(command, self._size, question.step)
        except CommandError as error:
            answer.error = shown(str(error))
        except (KeyboardInterrupt, TimeIsUp):
            raise
        except BaseException as error:
            answer.error = f"step {question.step}: {where} raised\n{controller_traceback(error)}"
        answer.seconds = time.perf_counter() - started
        return answer

    def _drawings(self) -> list[Drawing]:
        sim = self._submission.canvas()
        try:
            self._controller.render_callback(sim)
            drawings, left = [], MAX_POINTS
            for kind, points, rgba, size in sim.drawn:
                rows = np.array(points, dtype=np.float64).reshape(-1, 3)[:left]
                left -= len(rows)
                colour = [1.0, 0.0, 0.0, 1.0] if rgba is None else [float(c) for c in rgba][:4]
                colour += [1.0] * (4 - len(colour))
                if len(rows) and np.isfinite(rows).all():
                    red, green, blue, alpha = colour
                    drawings.append(Drawing(kind, rows, (red, green, blue, alpha), float(size)))
            return drawings
        except (KeyboardInterrupt, TimeIsUp):
            raise
        except BaseException as error:
            # Drawings never decide a flight: it goes on without them.
            self._draws = False
            print(f"render_callback raised; no more drawings\n{controller_traceback(error)}")
            return []

    def hook(self, name: str) -> tuple[float, str | None]:
        method = getattr(self._controller, name, None)
        if method is None:
            return 0.0, None
        started = time.perf_counter()
        try:
            method()
        except (KeyboardInterrupt, TimeIsUp):
            raise
        except BaseException as error:
            text = f"{name} raised\n{controller_traceback(error)}"
            return time.perf_counter() - started, text
        return time.perf_counter() - started, None

    def close(self) -> None:
        self._controller = None
        self._submission.close()


class LsyInProcess(LsyPilot):
    """A controller that lives in this process: for dry runs of one's own code only."""

    def __init__(self, submission: LsySubmission) -> None:
        super().__init__(submission)
        self.digest = submission.digest
        self.description: dict[str, Any] = {
            "process": "that of the runner",
            "isolated": False,
            "sandbox": [],
        }
        self._question: LsyQuestion | None = None
        self._limit = StepLimit()

    def put(self, question: LsyQuestion) -> None:
        """Put a question; :meth:`take` asks it."""
        self._question = question

    def take(self, timeout: float) -> LsyAnswer | None:
        """Answer the last question; interrupted when it does not return in time."""
        question, self._question = self._question, None
        if question is None:
            return None
        limit, started = self._limit, time.perf_counter()
        try:
            limit.begin(started, timeout)
            return super().ask(question)
        except TimeIsUp as late:
            text = f"step {question.step}: no answer within {timeout:g} s of wall time"
            return LsyAnswer(
                question.step,
                error=f"{text}\n{controller_traceback(late)}",
                seconds=time.perf_counter() - started,
                timed_out=True,
            )
        finally:
            limit.end()

    def close(self) -> None:
        self._limit.close()
        super().close()

    def ask(self, question: LsyQuestion) -> LsyAnswer:
        """As there; interrupted when it does not return in time."""
        try:
            with bounded(_PATIENCE):
                return super().ask(question)
        except TimeIsUp as late:
            text = f"step {question.step}: no answer within {_PATIENCE:g} s of wall time"
            return LsyAnswer(question.step, error=f"{text}\n{controller_traceback(late)}")


def fresh(obs: Observation) -> Observation:
    """A copy that is the controller's to change."""
    return {name: value.copy() for name, value in obs.items()}
