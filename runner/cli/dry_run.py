"""``crazyarena dry-run``: fly a submission in simulation."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from crazyarena.runner.cli.common import (
    EXIT_NOT_CLEAN,
    bad_input_exits,
)
from crazyarena.runner.cli.options.flight import Sandbox, flight_options
from crazyarena.runner.cli.options.groups import takes
from crazyarena.runner.cli.options.vehicle import VehicleSpread, vehicle_choice

if TYPE_CHECKING:
    from crazyarena.runner.trial.options import FlightOptions
    from crazyarena.sim_backend.vehicles import VehicleChoice


def register(app: typer.Typer) -> None:
    app.command("dry-run")(dry_run)


@takes(vehicle=vehicle_choice, options=flight_options)
def dry_run(
    submission: Annotated[
        Path | None,
        typer.Argument(
            help="Folder with edit_this.py, or a .py file with class Controller. "
            "Default: the example racer.",
        ),
    ] = None,
    level: Annotated[str, typer.Option(help="Shipped level, or a level file.")] = "level0",
    episodes: Annotated[
        int | None, typer.Option(min=1, help="How many. Default: the level's own number.")
    ] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Replaces the level's seed.")] = None,
    out: Annotated[
        Path | None, typer.Option(help="Results folder. Default: a new one under runs/.")
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="FIELD=VALUE", help="Override a field of the level."),
    ] = None,
    record: Annotated[bool, typer.Option(help="Write an MCAP file an episode.")] = True,
    figure: Annotated[bool, typer.Option(help="Write a PNG an episode.")] = True,
    *,
    vehicle: VehicleChoice,
    vehicle_spread: VehicleSpread = None,
    options: FlightOptions,
    sandbox: Sandbox = None,
    margins: Annotated[
        bool,
        typer.Option(
            "--margins",
            help="Find the largest rotor lag, drag, weakness, camera latency and noise with which "
            "the flight is still completed (arena levels; some 50 flights).",
        ),
    ] = False,
) -> None:
    """Fly a submission in simulation and judge it by the competition's rules.

    Exit code: 0 when every episode was completed without collision or violation, 1 when not,
    2 when the level or the submission is at fault before anything has flown.
    """
    with bad_input_exits():
        if margins:
            from crazyarena.runner.cli.margins import show

            completed = show(
                submission, level, set_ or [], seed, out, replace(options, sandbox=sandbox), vehicle
            )
            if completed:
                return
            raise typer.Exit(EXIT_NOT_CLEAN)
        from crazyarena.runner.dry_run import DryRun

        run = DryRun(
            submission=submission,
            level=level,
            overrides=set_ or [],
            episodes=episodes,
            seed=seed,
            out=out,
            record=record,
            figure=figure,
            options=replace(options, sandbox=sandbox),
            vehicle=vehicle,
            spread=vehicle_spread,
        )
        result = run.run()
    if not result.clean:
        raise typer.Exit(EXIT_NOT_CLEAN)
