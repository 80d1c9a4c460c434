"""``crazyarena watch``: a flight that goes on, in a second terminal or in the browser."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import typer

from crazyarena.runner.cli.common import EXIT_NOT_CLEAN, bad_input_exits
from crazyarena.runner.cli.options.groups import takes
from crazyarena.runner.cli.options.view import view_options

if TYPE_CHECKING:
    from crazyarena.viewer_process import ViewOptions


def register(app: typer.Typer) -> None:
    app.command("watch")(watch)


@takes(view=view_options)
def watch(view: Callable[[], ViewOptions | None]) -> None:
    """Watch the flight that goes on: phase, fence, battery, link, cameras, watchdog, events.

    Shows the newest flight of this user on this machine (fly and bench, or anything with --view).
    In this terminal; with --view in the browser, with STOP and LAND. Exit code 1: nothing flies.
    """
    with bad_input_exits():
        from crazyarena.live import Watched, live_flights
        from crazyarena.viewer_process import ViewerProcess

        options = view()
        flights = live_flights()
        if not flights:
            typer.echo("Nothing flies here now.")
            raise typer.Exit(EXIT_NOT_CLEAN)
        if options is not None:
            viewer = ViewerProcess(flights[-1], options)
            typer.echo(f"Viewer: {viewer.url}")
            viewer.stay()
            return
        from crazyarena.runner.viewer.terminal import watch as show

        watched = Watched(flights[-1])
        try:
            show(watched)
        except KeyboardInterrupt:
            typer.echo("")
