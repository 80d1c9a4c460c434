"""What subcommands share: exit codes, turning our errors into one message, common options."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer

from crazyarena.errors import CrazyarenaError
from crazyarena.plain_text import shown
from crazyarena.whole_file import FULL, is_refusal

EXIT_NOT_CLEAN = 1
EXIT_BAD_INPUT = 2


@contextlib.contextmanager
def bad_input_exits() -> Iterator[None]:
    """Show a :class:`CrazyarenaError` as ``error: ...`` on stderr and exit with 2.

    The same for what a disk says that is full or not ours to write to.
    """
    try:
        yield
    except CrazyarenaError as error:
        message = str(error)
    except OSError as error:
        if not is_refusal(error) or (error.filename is None and error.errno not in FULL):
            raise
        place = "a file" if error.filename is None else error.filename
        message = f"{place}: {error.strerror}"
    else:
        return
    typer.secho(f"error: {shown(message)}", err=True, fg=typer.colors.RED)
    raise typer.Exit(EXIT_BAD_INPUT) from None


AnySubmission = Annotated[
    Path | None,
    typer.Argument(
        help="Folder with edit_this.py, or a .py file with class Controller. Default: the example "
        "racer."
    ),
]


ArenaLevel = Annotated[
    str | None,
    typer.Option(
        help="Arena level, or a level file. Default: sim2real, lsy/level2 for a controller of "
        "lsy_drone_racing.",
        show_default=False,
    ),
]
Seed = Annotated[int | None, typer.Option(min=0, help="Replaces the level's seed.")]
Secret = Annotated[
    bool,
    typer.Option(
        "--secret",
        help="Draw the level from 128 bits nobody can guess, told in result.json alone; implies "
        "--sandbox.",
    ),
]
Out = Annotated[Path | None, typer.Option(help="Results folder.")]
Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="FIELD=VALUE", help="Override a field of the level."),
]
