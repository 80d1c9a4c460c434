"""The option of whatever leaves a page that can be mailed, and how it is told."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rich.console import Console

Report = Annotated[
    bool,
    typer.Option("--report/--no-report", help="Write report.html, one page that needs no network."),
]


def leave_report(folder: Path, console: Console) -> None:
    """Write the report of what a folder holds, and say where; a page that cannot be made is told,
    and is no failure of what it is about."""
    from crazyarena.runner.records.pages.write import leave_page

    told, style = leave_page(folder)
    console.print(told, style=style, markup=False, highlight=False, soft_wrap=True)
