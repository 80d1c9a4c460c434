"""``crazyarena new``: a controller to start from."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from crazyarena.runner.cli.common import bad_input_exits


class Contract(StrEnum):
    """How a controller is called."""

    COMPETITION = "2022"
    LSY = "lsy"


def register(app: typer.Typer) -> None:
    app.command("new")(new)


def new(
    folder: Annotated[Path, typer.Argument(help="Where to make it, e.g. my_controller.")],
    contract: Annotated[
        Contract,
        typer.Option(help="That of the IROS 2022 competition, or of lsy_drone_racing."),
    ] = Contract.COMPETITION,
) -> None:
    """Make a folder with a controller that completes level 0, its test, and a README."""
    with bad_input_exits():
        from crazyarena.runner.contestant.shipped import make

        for file in make(folder, contract.value):
            typer.echo(str(file))
        typer.echo(f"Next: crazyarena check {folder}")
