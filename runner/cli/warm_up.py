"""``crazyarena warm-up``: compile everything now, so that no flight waits for it."""

from __future__ import annotations

import typer

from crazyarena.runner.cli.common import bad_input_exits


def register(app: typer.Typer) -> None:
    app.command("warm-up")(warm_up)


def warm_up() -> None:
    """Compile the simulator now, so that no later command waits for it."""
    with bad_input_exits():
        from rich.console import Console

        from crazyarena.jit import cache_folder
        from crazyarena.runner.warm_up import PARTS, compile_missing

        console = Console()
        done = compile_missing(list(PARTS), console)
        what = f"Compiled {len(done)} of {len(PARTS)} parts" if done else "Everything was compiled"
        console.print(f"{what}; kept in {cache_folder()}", highlight=False, soft_wrap=True)
