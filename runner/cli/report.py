"""``crazyarena report``: a page that can be mailed."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from crazyarena.runner.cli.common import bad_input_exits


def register(app: typer.Typer) -> None:
    app.command("report")(report)


def report(
    run: Annotated[
        Path,
        typer.Argument(
            help="Folder of a run, a bench, a comparison, a fault campaign or a validation."
        ),
    ],
    against: Annotated[
        Path | None, typer.Option(help="A run to compare it with, such as its dry run.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="File to write. Default: report.html in the folder.")
    ] = None,
) -> None:
    """Write report.html: flights in 3-D and over time, events, checklist, provenance, on one page
    that needs no network."""
    with bad_input_exits():
        from crazyarena.runner.records.pages.write import write_report

        typer.echo(str(write_report(run, against, out)))
