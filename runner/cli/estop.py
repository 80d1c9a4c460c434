"""``crazyarena estop``: stop everything that flies, from any shell."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from crazyarena.plain_text import shown_line
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
    land: Annotated[
        bool,
        typer.Option(
            "--land", help="Have the watchdogs here land what flies, and cut nothing; local only."
        ),
    ] = False,
    test: Annotated[
        bool, typer.Option("--test", help="Rehearse: sessions answer, nothing is stopped.")
    ] = False,
) -> None:
    """Cut the motors of every vehicle of every running session, at once and for good.

    Sessions of this user on this machine are always stopped, all at once (the super-user stops
    those of everybody); those elsewhere with --connect or --network. Exit code: 0 when a vehicle's
    link confirmed (with --test: when a session answered), 1 when none did.
    """
    from crazyarena.safety.estop_local import LANDING, STOPPED, TESTED, stop_local

    found = answered = False
    with bad_input_exits():
        # The nearest first; nothing that could fail comes before it.
        good = LANDING if land else TESTED if test else STOPPED
        for name, answer in stop_local(reason, test, warn=_warn, land=land and not test):
            typer.echo(f"{name}: {answer}")
            answered = True
            found = found or answer.startswith(good)
        if (connect or network) and not (test or land):
            from crazyarena.safety.estop_sources import stop_over_zenoh
            from crazyarena.safety.estop_token import read_secret

            secret = None if token is None else read_secret(token)
            for session in stop_over_zenoh(secret, reason, connect or ()):
                typer.echo(f"zenoh session {session[:8]}: stop sent")
                found = True
    if not found:
        typer.echo(
            "NOT CONFIRMED: no vehicle's link has said that it is stopped."
            if answered
            else "Nothing answered: no session is running here that could be stopped."
        )
        raise typer.Exit(EXIT_NOT_CLEAN)


def _warn(text: str) -> None:
    typer.secho(f"warning: {shown_line(text)}", err=True, fg=typer.colors.YELLOW)
