"""A contestant as the trial sees it: asked at every control step, answering in its own time."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from crazyarena.errors import InputError
from crazyarena.levels.schema import Level
from crazyarena.runner.contestant.contract_2022.command_check import Asked
from crazyarena.runner.contestant.contract_lsy.dialogue import Drawing
from crazyarena.runner.contestant.interrupt import Interrupt

Array = NDArray[np.float64]

PARAMETERS = "CRAZYARENA_PARAMETERS"
"""Environment variable with a JSON mapping that a contestant is told, for trying values out."""


def told_parameters() -> dict[str, Any]:
    """What :data:`PARAMETERS` of this process says; empty without it. Raises InputError."""
    text = os.environ.get(PARAMETERS, "")
    if not text:
        return {}
    try:
        told = json.loads(text)
    except ValueError as error:
        raise InputError(f"{PARAMETERS}: no valid JSON: {error}") from None
    if not isinstance(told, dict):
        raise InputError(f'{PARAMETERS}: expected a mapping, such as {{"speed": 1.5}}')
    return told


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
    command_seconds, learn_seconds: of the two calls, as the asker measured them; 0.0 for one that
    was not made. timed_out: it did not come in the wall time allowed; ``error`` says so.
    drawings: all that the controller has drawn, if that has changed.
    """

    step: int
    asked: Asked | None
    error: str | None
    seconds: float
    command_seconds: float = 0.0
    learn_seconds: float = 0.0
    timed_out: bool = False
    drawings: list[Drawing] | None = None


class Contestant(Protocol):
    """A loaded submission. Not thread-safe; one question at a time.

    digest: SHA-256 of its files; description: for the report, how it is run.
    learns: it wants to be told what came of each control step.
    """

    digest: str
    description: dict[str, Any]
    learns: bool

    def make(self, obs: list[Any], level: Level, start: Array) -> None:
        """Construct the controller; raises InputError with its traceback if that fails."""
        ...

    def heed(self, interrupt: Interrupt) -> None:
        """Let Ctrl-C end what the contestant does in this process, if it does anything here."""
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
