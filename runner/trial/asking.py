"""Asks the operator before the motors are armed: in the terminal, on the page, or in both."""

from __future__ import annotations

import contextlib
import secrets
import select
from collections.abc import Callable
from typing import IO

from crazyarena.clock import Clock
from crazyarena.errors import InputError
from crazyarena.runner.trial.showing import Showing

_LOOK = 0.05  # s, between looks for an answer; meanwhile cameras are seen and the page goes on


def ask_operator(
    question: str,
    clock: Clock,
    *,
    terminal: IO[str] | None,
    show: Showing | None,
    page: bool,
    say: Callable[[str], None],
    interrupted: Callable[[], bool] = lambda: False,
) -> bool:
    """Whether the operator says yes, wherever the answer comes first.

    Parameters
    ----------
    clock: of the trial; time passes on it while nobody answers.
    terminal: that somebody sits at; None for nobody.
    page: a viewer shows the question, and may answer; not unless it holds its button.
    say: writes the question to the terminal.

    Raises
    ------
    InputError: nobody can answer.
    """
    if terminal is None and not (page and show is not None):
        raise InputError("fly: nobody can answer here. Pass --yes to start without asking")
    # An answer to an earlier question is none to this one.
    number = secrets.token_hex(8)
    if show is not None and page:
        show.ask({"id": number, "text": question})
    if terminal is not None:
        say(f"{question} [y/N] ")
    elif page:
        say(f"{question} Hold the button on the page.\n")
    try:
        while not interrupted():
            if show is not None and page and show.live.reply().get("confirm") == number:
                return True
            if terminal is not None:
                line = _line(terminal)
                if line is not None:
                    return line.strip().lower().startswith("y")
            clock.sleep_until(clock.now() + _LOOK)
        return False
    finally:
        if show is not None and page:
            show.ask(None)


def _line(terminal: IO[str]) -> str | None:
    """A line that somebody has typed, empty at the end of the input; None if nobody has."""
    with contextlib.suppress(OSError, ValueError):
        if not select.select([terminal], [], [], 0.0)[0]:
            return None
    return terminal.readline()
