"""``crazyarena check``: a submission before it is handed in."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from crazyarena.runner.cli.common import EXIT_NOT_CLEAN, bad_input_exits


def register(app: typer.Typer) -> None:
    app.command("check")(check)


def check(
    submission: Annotated[
        Path, typer.Argument(help="Folder or file of a controller, of either contract.")
    ],
    need: Annotated[
        str | None,
        typer.Option(metavar="LEVEL", help="Hardest level to be completed. Default: level 0."),
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="FIELD=VALUE",
            help="Override a field of the levels: env.control_mode=attitude for a controller of "
            "lsy_drone_racing that answers with attitudes.",
        ),
    ] = None,
) -> None:
    """Check contract, timing and common mistakes of a submission, and fly it through three levels.

    Exit code: 0 when nothing is wrong, 1 when something is, 2 when it cannot be loaded.
    """
    with bad_input_exits():
        from rich.console import Console
        from rich.table import Table

        from crazyarena.runner.check.submission import check as checked
        from crazyarena.runner.warm_up import compile_missing

        console = Console()
        lsy = (need or "").startswith("lsy/")
        compile_missing(("successor",) if lsy else ("competition", "referee"), console)
        with console.status("looking") as status:
            found = checked(submission, need, status.update, set_ or [])
        table = Table(box=None, show_header=False, padding=(0, 1))
        table.add_column(no_wrap=True)
        table.add_column(no_wrap=True)
        table.add_column(overflow="fold")
        marks = {True: "[green]good[/]", None: "[yellow]note[/]", False: "[red]wrong[/]"}
        for line in found:
            text = line.found if line.works or not line.remedy else f"{line.found}. {line.remedy}"
            table.add_row(marks[line.works], line.name, text.replace("[", "\\["))
        console.print(table)
    if any(line.works is False for line in found):
        raise typer.Exit(EXIT_NOT_CLEAN)
