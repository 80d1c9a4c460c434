"""What subcommands share: exit codes, turning our errors into one message, common options."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from crazyarena.errors import CrazyarenaError

if TYPE_CHECKING:
    from crazyarena.runner.control_loop import LatePolicy

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


class LateChoice(StrEnum):
    """:class:`~crazyarena.runner.control_loop.LatePolicy`, without its imports."""

    HOLD = "hold"
    EXTRAPOLATE = "extrapolate"
    HOVER = "hover"

    @property
    def policy(self) -> LatePolicy:
        from crazyarena.runner.control_loop import LatePolicy

        return LatePolicy(self.value)


AnySubmission = Annotated[
    Path | None, typer.Argument(help="As for dry-run. Default: the example racer.")
]
ArenaLevel = Annotated[str, typer.Option(help="Arena level, or a level file.")]
Seed = Annotated[int | None, typer.Option(min=0, help="Replaces the level's seed.")]
Out = Annotated[Path | None, typer.Option(help="Results folder.")]
Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="FIELD=VALUE", help="Override a field of the level."),
]
Compute = Annotated[
    str | None,
    typer.Option(
        metavar="measured|free|fixed=MS",
        help="What thinking costs on the simulated clock. Default: measured on arena levels, "
        "free on others. free and fixed repeat to the bit.",
    ),
]
ComputeFactor = Annotated[
    float, typer.Option(help="How many times slower than this one the flight machine is.")
]
Late = Annotated[
    LateChoice,
    typer.Option(help="What the vehicle hears at a tick whose command is late."),
]
MaxMisses = Annotated[
    int, typer.Option(min=1, help="Missed ticks in a row after which the contestant is out.")
]
RequireSandbox = Annotated[
    bool, typer.Option("--require-sandbox", help="Refuse to fly without a full sandbox.")
]
