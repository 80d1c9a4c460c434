"""``crazyarena replay``: recorded flights in the browser."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from crazyarena.runner.cli.common import bad_input_exits
from crazyarena.runner.cli.options.view import ViewHost, ViewPort


def register(app: typer.Typer) -> None:
    app.command("replay")(replay)


def replay(
    runs: Annotated[
        list[Path],
        typer.Argument(help="Results folders (or folders of them), or recordings (.mcap)."),
    ],
    view_port: ViewPort = 8080,
    view_host: ViewHost = "127.0.0.1",
    play: Annotated[bool, typer.Option(help="Begin to play at once.")] = False,
) -> None:
    """Show recorded flights in the browser, with a time line; several as ghosts beside the first.

    The address is printed; Ctrl-C ends. Recordings that were cut short are shown as far as they go.
    """
    with bad_input_exits():
        import threading

        from crazyarena.runner.viewer.recorded import flights
        from crazyarena.runner.viewer.replay import Replay
        from crazyarena.runner.viewer.server import address, open_server

        found = flights(runs)
        server = open_server(view_host, view_port, "crazyarena replay")
        shown = Replay(server, found)
        typer.echo(
            f"{len(found)} flight{'s' if len(found) > 1 else ''}: {address(server, view_host)}"
        )
        typer.echo("Ctrl-C ends.")
        shown.play(play)
        try:
            shown.run(threading.Event())
        except KeyboardInterrupt:
            typer.echo("")
        finally:
            server.stop()
