"""The command line: one module a subcommand.

A module ``<name>.py`` in this folder that has a function ``register(app)`` adds its command to
the typer application; the name only decides the order. Modules import what is heavy inside
their functions, so that ``crazyarena --help`` answers at once.
"""

from __future__ import annotations

import functools
import importlib
import inspect
import math
import pkgutil
import re
from collections.abc import Callable
from typing import Any

import typer


def make_app(only: str | None = None) -> typer.Typer:
    """Build the application with every subcommand found in this folder, or with that of one
    module."""
    app = typer.Typer(
        name="crazyarena",
        help="Fly drone-racing controllers on real Crazyflies, after dry-running them in sim.",
        context_settings={"help_option_names": ["-h", "--help"]},
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
    )

    @app.callback(invoke_without_command=True)
    def options(
        context: typer.Context,
        version: bool = typer.Option(False, "--version", help="Show the version and exit."),
    ) -> None:
        if version:
            from crazyarena import __version__

            typer.echo(f"crazyarena {__version__}")
            raise typer.Exit
        if context.invoked_subcommand is None:
            typer.echo(context.get_help())
            raise typer.Exit

    for module in sorted(pkgutil.iter_modules(__path__), key=lambda m: m.name):
        if only is not None and module.name != only:
            continue
        register = getattr(importlib.import_module(f"{__name__}.{module.name}"), "register", None)
        if register is not None:
            register(app)
    for command in app.registered_commands:
        if command.callback is not None:
            command.callback = _finite_only(command.callback)
        command.short_help = _first_sentence(inspect.getdoc(command.callback) or "")
    return app


def _finite_only(command: Callable[..., Any]) -> Callable[..., Any]:
    """Refuse nan and inf, which pass every comparison with a bound or none, for all options."""

    @functools.wraps(command)
    def run(*arguments: Any, **options: Any) -> Any:
        for name, value in options.items():
            if isinstance(value, float) and not math.isfinite(value):
                flag = f"--{name.rstrip('_').replace('_', '-')}"
                raise typer.BadParameter(
                    f"found {value}; need a finite number", param_hint=f"'{flag}'"
                )
        return command(*arguments, **options)

    return run


def _first_sentence(text: str) -> str:
    """For the list of commands, where Click would cut a longer text off."""
    paragraph = " ".join(text.partition("\n\n")[0].split())
    return re.split(r"(?<=[.!?:]) (?=[A-Z])", paragraph)[0]
