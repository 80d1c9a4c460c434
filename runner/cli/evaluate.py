"""``crazyarena evaluate``: how reliable and how fast a controller of lsy_drone_racing is."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from crazyarena.runner.cli.common import EXIT_NOT_CLEAN, Secret, bad_input_exits


def register(app: typer.Typer) -> None:
    app.command("evaluate")(evaluate)


def evaluate(
    controller: Annotated[Path, typer.Argument(help="File of a lsy_drone_racing controller.")],
    level: Annotated[
        str, typer.Option(help="lsy/level0 ... lsy/level3, or a TOML file.")
    ] = "lsy/level2",
    runs: Annotated[int, typer.Option(min=1, help="How many episodes.")] = 20,
    seed: Annotated[
        int | None, typer.Option(min=0, help="Default: the level's own; -1 there is a new one.")
    ] = None,
    secret: Secret = False,
    out: Annotated[Path | None, typer.Option(help="Results folder. Default: none.")] = None,
    record: Annotated[bool, typer.Option(help="Write an MCAP file an episode to --out.")] = False,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="FIELD=VALUE", help="Override a field of the level."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON document.")] = False,
    sandbox: Annotated[
        bool, typer.Option("--sandbox/--no-sandbox", help="Run it in a process of its own.")
    ] = False,
    require_sandbox: Annotated[
        bool, typer.Option("--require-sandbox", help="Refuse to fly without a full sandbox.")
    ] = False,
) -> None:
    """Fly 20 episodes of level 2 in lsy_drone_racing's simulation and count.

    The last line is mean time of the successful runs and success rate, as its own evaluation
    writes them. Exit code: 0 when at least half of the runs passed all gates, 1 when not, 2 when
    level or controller are at fault before anything has flown.
    """
    with bad_input_exits():
        import contextlib
        import json
        import sys

        from rich.console import Console

        from crazyarena.errors import StorageError
        from crazyarena.runner.lsy_run import ENOUGH, LsyRun, summary, tell

        console = Console(file=sys.stderr) if as_json else Console()
        # What a controller prints must not get into the document.
        prints = contextlib.redirect_stdout(sys.stderr) if as_json else contextlib.nullcontext()
        run = LsyRun(
            controller,
            level,
            set_ or [],
            episodes=runs,
            seed=seed,
            secret=secret,
            out=out,
            record=record,
            sandbox=sandbox or require_sandbox,
            require_sandbox=require_sandbox,
            console=console,
        )
        with prints:
            result = run.run()
        tell(result, console)
        if result.cut_short is not None:
            raise StorageError(result.cut_short)
    enough = result.success_rate >= ENOUGH
    if as_json:
        document = {
            **summary(result),
            "passed": enough,
            "runs": [
                {
                    "termination": e.termination,
                    "success": e.success,
                    "time": e.time,
                    "gates_passed": e.gates_passed,
                    "notes": e.notes,
                    "error": e.error,
                }
                for e in result.episodes
            ],
        }
        typer.echo(json.dumps(document, indent=2))
    else:
        shown = "nan" if result.mean_time is None else f"{result.mean_time:.3f}"
        typer.echo("seed: secret" if secret else f"seed {result.seed}")
        typer.echo(f"{shown},{result.success_rate:.2f}")
    if not enough:
        raise typer.Exit(EXIT_NOT_CLEAN)
