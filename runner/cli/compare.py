"""``crazyarena compare``: two groups of flights beside each other."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from crazyarena.plain_text import shown_line
from crazyarena.runner.cli.common import bad_input_exits
from crazyarena.runner.cli.options.report import Report, leave_report
from crazyarena.whole_file import write_whole


def register(app: typer.Typer) -> None:
    app.command("compare")(compare)


def compare(
    runs: Annotated[
        list[Path],
        typer.Argument(
            help="Results folders (or folders of them, or recordings). Two make a pair; groups of "
            "several are told apart by the word 'vs' between them.",
        ),
    ],
    out: Annotated[
        Path | None, typer.Option(help="Folder for compare.png and compare.json.")
    ] = None,
    figure: Annotated[bool, typer.Option(help="Write compare.png.")] = True,
    report: Report = True,
    different_levels: Annotated[
        bool,
        typer.Option("--different-levels", help="Compare even flights of different levels."),
    ] = False,
) -> None:
    """Compare flights, e.g. simulated with real ones: crazyarena compare sim1 sim2 vs real1 real2.

    Paths are aligned in time; the table tells how far the mean paths of the two groups are apart,
    per axis and over time, and how the timing differs.
    """
    with bad_input_exits():
        from rich.console import Console

        from crazyarena.errors import InputError
        from crazyarena.runner.records import compare as comparing

        words = [str(run) for run in runs]
        if words.count("vs") == 1:
            at = words.index("vs")
            groups = runs[:at], runs[at + 1 :]
        elif len(runs) == 2:
            groups = runs[:1], runs[1:]
        else:
            raise InputError(
                f"compare: found {len(runs)} runs; pass two, or two groups with 'vs' between them"
            )
        if not (groups[0] and groups[1]):
            raise InputError("compare: a group is empty; name runs before and after 'vs'")
        names = (_name(groups[0]), _name(groups[1]))
        result = comparing.compare(groups[0], groups[1], names, different_levels)
        console = Console()
        console.print(comparing.table(result))
        console.print(result.advice(), highlight=False, markup=False, soft_wrap=True)
        folder = out if out is not None else Path.cwd()
        folder.mkdir(parents=True, exist_ok=True)
        write_whole(folder / "compare.json", json.dumps(result.document(), indent=2) + "\n")
        if figure:
            from crazyarena.runner.records.compare_figure import save_figure

            save_figure(folder / "compare.png", result)
            console.print(f"Figure: {folder / 'compare.png'}", highlight=False, soft_wrap=True)
        if report:
            leave_report(folder, console)


def _name(group: list[Path]) -> str:
    name = shown_line(group[0].name)
    return name if len(group) == 1 else f"{name} ..."
