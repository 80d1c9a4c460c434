"""``crazyarena sweep``: one submission with many values of its, or a level's, parameters."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from crazyarena.runner.cli.common import EXIT_NOT_CLEAN, bad_input_exits


def register(app: typer.Typer) -> None:
    app.command("sweep")(sweep)


def sweep(
    submission: Annotated[Path, typer.Argument(help="Folder or file of one submission.")],
    set_: Annotated[
        list[str],
        typer.Option(
            "--set",
            metavar="NAME=V,V,...",
            help="Values to try; repeated: all combinations. A field of the level (as --set of "
            "dry-run), or else a parameter that the submission is told.",
        ),
    ],
    levels: Annotated[
        str | None, typer.Option(metavar="LEVEL,...", help="Default: level2, lsy/level2.")
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, help="Draws of each level.")] = 50,
    out: Annotated[
        Path | None, typer.Option(help="Results folder; goes on with what is there.")
    ] = None,
    compute: Annotated[
        str, typer.Option(metavar="free|fixed=MS|measured", help="What thinking costs.")
    ] = "free",
    record: Annotated[bool, typer.Option(help="Keep an MCAP file an episode.")] = False,
    scheduler: Annotated[
        str | None, typer.Option(metavar="tcp://HOST:PORT", help="A dask scheduler.")
    ] = None,
    workers: Annotated[int | None, typer.Option(min=1, help="Processes here.")] = None,
    watch: Annotated[bool, typer.Option("--watch", help="Show every combination live.")] = False,
) -> None:
    """Fly a submission with every combination of values, in the same worlds.

    The submission is told its parameters in initial_info["parameters"] (config.parameters in
    lsy_drone_racing) and, as JSON, in the environment variable CRAZYARENA_PARAMETERS.

    Exit code: 0 when everything was flown, 1 when some of it could not be, 2 when something is at
    fault.
    """
    with bad_input_exits():
        import os

        from rich.console import Console

        from crazyarena.runner.records.run_folder import run_folder
        from crazyarena.runner.tournament.engine import Engine
        from crazyarena.runner.tournament.results import assemble, write_files
        from crazyarena.runner.tournament.sweep import (
            FIGURE,
            open_sweep,
            points,
            save_figure,
            table,
            write_summary,
        )
        from crazyarena.runner.tournament.tables import Watch

        console = Console()
        if not console.is_terminal:
            console = Console(width=160)

        def say(text: str) -> None:
            console.print(text, markup=False, highlight=False, soft_wrap=True)

        names = None if levels is None else [n.strip() for n in levels.split(",") if n.strip()]
        folder = out if out is not None else run_folder(None, submission, "sweep")
        event, axes = open_sweep(submission, set_, names, folder, seeds, compute, record)
        try:
            if event.resumed:
                say(f"{event.resumed} episodes were there already.")
            event.warm_up(console)
            failed: list[str] = []
            try:
                count = workers or len(os.sched_getaffinity(0))
                with Watch(event, console, count, watch) as shown:
                    failed = event.fly(
                        lambda: Engine(scheduler, workers, measured=compute == "measured", say=say),
                        shown.flown,
                        shown.tick,
                        say,
                    )
            except KeyboardInterrupt:
                say("Stopped. What was flown is safe; the same --out goes on.")
                failed = ["stopped"]
            results = assemble(event)
            write_files(results)
            given = names or ["lsy/level2" if event.plan.teams[0].contract == "lsy" else "level2"]
            found = points(results, axes, given)
            write_summary(folder, axes, found)
            save_figure(folder / FIGURE, axes, found)
            console.print(table(axes, found))
            for reason in failed:
                say(f"could not be flown: {reason}")
            say(f"Results in {folder}; heat map: {folder / FIGURE}")
        finally:
            event.close()
    if failed:
        raise typer.Exit(EXIT_NOT_CLEAN)
