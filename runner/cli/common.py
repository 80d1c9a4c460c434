"""What subcommands share: turning our errors into one message and exit code 2."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import typer

from crazyarena.errors import CrazyarenaError

EXIT_NOT_CLEAN = 1
EXIT_BAD_INPUT = 2


@contextlib.contextmanager
def bad_input_exits() -> Iterator[None]:
    """Show a :class:`CrazyarenaError` as ``error: ...`` on stderr and exit with 2."""
    try:
        yield
    except CrazyarenaError as error:
        typer.secho(f"error: {error}", err=True, fg=typer.colors.RED)
        raise typer.Exit(EXIT_BAD_INPUT) from None
