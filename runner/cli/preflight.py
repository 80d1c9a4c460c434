"""``crazyarena preflight``: the checklist before a flight."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from crazyarena.runner.cli.common import EXIT_NOT_CLEAN, bad_input_exits


def register(app: typer.Typer) -> None:
    app.command("preflight")(preflight)


def preflight(
    uri: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=URI", help="A vehicle; NAME is its body. Repeatable."),
    ] = None,
    level: Annotated[str, typer.Option(help="Level to be flown.")] = "sim2real",
    mocap: Annotated[str | None, typer.Option(help="Source of poses, e.g. vicon, zenoh.")] = None,
    host: Annotated[str | None, typer.Option(help="Its host or endpoint.")] = None,
    option: Annotated[list[str] | None, typer.Option(metavar="KEY=VALUE")] = None,
    controller: Annotated[int, typer.Option(help="1 PID, 2 Mellinger.")] = 2,
    tip: Annotated[
        bool, typer.Option("--tip", help="Ask for each vehicle to be tipped by hand.")
    ] = False,
    waive: Annotated[
        list[str] | None, typer.Option(metavar="LINE", help="Fly in spite of this line.")
    ] = None,
    wait: Annotated[float, typer.Option(min=0.5, help="s, to gather what is checked.")] = 5.0,
    out: Annotated[Path, typer.Option(help="Where recordings would go.")] = Path("runs"),
) -> None:
    """Check vehicles, cameras, arena and machine; red lines come with a remedy.

    While it waits, try the emergency stop from another shell: crazyarena estop --test. Nothing
    is armed and no motor turns. Exit code: 0 when every line is green or waived, 1 when not.
    """
    with bad_input_exits():
        from rich.console import Console
        from rich.table import Table

        from crazyarena.runner.preflight import gather
        from crazyarena.safety.preflight import may_fly

        console = Console()
        checklist = gather(
            level, uri or [], mocap, host, option or [], controller, tip, wait, out, console.print
        )
        lines = checklist.run(waive or ())
        view = Table()
        for name in ("", "line", "found", "remedy"):
            view.add_column(name)
        for line in lines:
            mark = "[green]ok" if line.ok else "[yellow]waived" if line.waived else "[red]no"
            view.add_row(mark, line.name, line.found, "" if line.ok else line.remedy)
        console.print(view)
        ready = may_fly(lines)
        console.print("Ready to fly." if ready else "Not ready: see the lines marked no.")
    if not ready:
        raise typer.Exit(EXIT_NOT_CLEAN)
