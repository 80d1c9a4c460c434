"""The command line: one module a subcommand.

A module ``<name>.py`` in this folder that has a function ``register(app)`` adds its command to
the typer application; the name only decides the order. Modules import what is heavy inside
their functions, so that ``crazyarena --help`` answers at once.
"""

from __future__ import annotations

import importlib
import pkgutil

import typer


def make_app() -> typer.Typer:
    """Build the application with every subcommand found in this folder."""
    app = typer.Typer(
        name="crazyarena",
        help="Fly drone-racing controllers on real Crazyflies, after dry-running them in sim.",
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
    )

    @app.callback(invoke_without_command=True)
    def options(
        version: bool = typer.Option(False, "--version", help="Show the version and exit."),
    ) -> None:
        if version:
            from crazyarena import __version__

            typer.echo(f"crazyarena {__version__}")
            raise typer.Exit

    for module in sorted(pkgutil.iter_modules(__path__), key=lambda m: m.name):
        register = getattr(importlib.import_module(f"{__name__}.{module.name}"), "register", None)
        if register is not None:
            register(app)
    return app
