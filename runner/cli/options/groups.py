"""Groups of options: written once, taken by several commands.

A group is a function whose parameters are the options, as typer has them, and which turns them
into one object. A command names a group with :func:`takes` and gets the object.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import Any


def _parameters(function: Callable[..., Any]) -> list[inspect.Parameter]:
    """Parameters with their annotations as objects; that of the result may be unknown here."""
    known = getattr(function, "__globals__", {})
    return [
        p.replace(annotation=eval(p.annotation, known)) if isinstance(p.annotation, str) else p
        for p in inspect.signature(function).parameters.values()
    ]


def takes(**groups: Callable[..., Any]) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Replace each named parameter of a command by the options of its group, in their place."""

    def decorate(command: Callable[..., Any]) -> Callable[..., Any]:
        options = {name: _parameters(group) for name, group in groups.items()}
        own = inspect.signature(command)
        known = getattr(command, "__globals__", {})
        parameters: list[inspect.Parameter] = []
        for name, parameter in own.parameters.items():
            if name in options:
                parameters += options[name]
            else:
                parameters.append(parameter.replace(annotation=eval(parameter.annotation, known)))

        @functools.wraps(command)
        def run(**given: Any) -> Any:
            passed = {
                name: groups[name](**{p.name: given[p.name] for p in options[name]})
                if name in options
                else given[name]
                for name in own.parameters
            }
            return command(**passed)

        # Keyword only: options have defaults, and so may stand anywhere between the others.
        run.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
            [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in parameters]
        )
        run.__annotations__ = {p.name: p.annotation for p in parameters}
        return run

    return decorate
