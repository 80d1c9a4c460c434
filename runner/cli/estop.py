"""``crazyarena estop``: stop everything that flies, from any shell."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from crazyarena.runner.cli.common import EXIT_NOT_CLEAN, bad_input_exits


def register(app: typer.Typer) -> None:
    app.command("estop")(estop)


def estop(
    reason: Annotated[str, typer.Option(help="For the record.")] = "",
    connect: Annotated[
        list[str] | None,
        typer.Option(help="Also over zenoh, to this endpoint, e.g. tcp/10.0.0.5:7447."),
    ] = None,
    network: Annotated[
        bool, typer.Option("--network", help="Also over zenoh, to whoever is on this network.")
    ] = False,
    token: Annotated[
        Path | None, typer.Option(help="File with the shared secret, for --connect and --network.")
    ] = None,
    test: Annotated[
        bool, typer.Option("--test", help="Rehearse: sessions answer, nothing is stopped.")
    ] = False,
) -> None:
    """Cut the motors of every vehicle of every running session, at once and for good.

    Sessions of this user on this machine are always stopped; those elsewhere with --connect or
    --network. Exit code: 0 when a session answered, 1 when none did.
    """
    from crazyarena.safety.estop_sources import stop_local, stop_over_zenoh

    found = False
    with bad_input_exits():
        # The nearest first; nothing that could fail comes before it.
        for name, answer in stop_local(reason, test):
            typer.echo(f"{name}: {answer}")
            found = found or answer in ("stopped", "tested")
        if (connect or network) and not test:
            from crazyarena.safety.estop_token import read_secret

            secret = None if token is None else read_secret(token)
            for session in stop_over_zenoh(secret, reason, connect or ()):
                typer.echo(f"zenoh session {session[:8]}: stop sent")
                found = True
    if not found:
        typer.echo("Nothing answered: no session is running here that could be stopped.")
        raise typer.Exit(EXIT_NOT_CLEAN)
