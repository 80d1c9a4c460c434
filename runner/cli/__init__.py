"""The command line: one module a subcommand.

A module ``<name>.py`` in this folder that has a function ``register(app)`` adds its command to
the typer application; the name only decides the order. Modules import what is heavy inside
their functions, so that ``crazyarena --help`` answers at once.
"""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import re

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
        command.short_help = _first_sentence(inspect.getdoc(command.callback) or "")
    return app


def _first_sentence(text: str) -> str:
    """For the list of commands, where Click would cut a longer text off."""
    paragraph = " ".join(text.partition("\n\n")[0].split())
    return re.split(r"(?<=[.!?:]) (?=[A-Z])", paragraph)[0]
