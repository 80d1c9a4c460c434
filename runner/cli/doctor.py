"""``crazyarena doctor``: what works here, and what would make the rest work."""

from __future__ import annotations

import typer

from crazyarena.runner.cli.common import EXIT_NOT_CLEAN, bad_input_exits


def register(app: typer.Typer) -> None:
    app.command("doctor")(doctor)


def doctor() -> None:
    """Say what works on this machine, and how to make the rest work.

    Exit code: 0 when dry runs can be flown, 1 when not.
    """
    with bad_input_exits():
        from rich.console import Console
        from rich.table import Table

        from crazyarena.runner.doctor import examine

        console = Console()
        table = Table(box=None, show_header=False, padding=(0, 1))
        table.add_column(no_wrap=True)
        table.add_column(no_wrap=True)
        table.add_column(overflow="fold")
        marks = {True: "[green]yes[/]", None: "[yellow]part[/]", False: "[red]no[/]"}
        broken = False
        with console.status("looking"):
            for line in examine():
                broken |= line.needed and line.works is False
                text = (
                    line.found if line.works or not line.remedy else f"{line.found}. {line.remedy}"
                )
                table.add_row(marks[line.works], line.name, text.replace("[", "\\["))
        console.print(table)
    if broken:
        raise typer.Exit(EXIT_NOT_CLEAN)
