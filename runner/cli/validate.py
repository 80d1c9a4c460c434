"""``crazyarena validate``: real flights flown again by a vehicle model."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from crazyarena.runner.cli.common import bad_input_exits
from crazyarena.runner.cli.options.groups import takes
from crazyarena.runner.cli.options.report import Report, leave_report
from crazyarena.runner.cli.options.vehicle import vehicle_choice
from crazyarena.whole_file import write_whole

if TYPE_CHECKING:
    from crazyarena.sim_backend.vehicles import VehicleChoice


def register(app: typer.Typer) -> None:
    app.command("validate")(validate)


@takes(vehicle=vehicle_choice)
def validate(
    flights: Annotated[
        list[Path],
        typer.Argument(help="Logs of real flights (.npz, .csv, .mcap), or folders of them."),
    ],
    vehicle: VehicleChoice,
    hover: Annotated[
        str,
        typer.Option(
            metavar="flight|set|none",
            help="What the thrust to hover is taken from: each flight's motors and battery, the "
            "median of the set, or the model alone.",
        ),
    ] = "flight",
    controller: Annotated[
        str | None,
        typer.Option(metavar="pid|mellinger", help="Controller, where a file does not say."),
    ] = None,
    high_level: Annotated[
        bool,
        typer.Option(
            "--high-level",
            help="Setpoints came from the planner on board: velocities and accelerations that "
            "are not logged follow from the positions.",
        ),
    ] = False,
    out: Annotated[
        Path | None, typer.Option(help="Folder for validate.png and validate.json. Default: here.")
    ] = None,
    figure: Annotated[bool, typer.Option(help="Write validate.png.")] = True,
    report: Report = True,
) -> None:
    """Fly logged flights again in simulation, and tell how far the paths are apart.

    Setpoints go through the simulated firmware and plant of the vehicle at the times of the log.
    Nothing is fitted but the thrust it takes to hover. The table shows errors with and without
    one clock offset a flight, beside perfect tracking and a pure delay.
    """
    with bad_input_exits():
        from rich.console import Console

        from crazyarena.errors import InputError
        from crazyarena.runner.records import validate as validating
        from crazyarena.runner.records.validate_report import save_figure, tables
        from crazyarena.runner.warm_up import compile_missing

        console = Console()
        model = vehicle.load()
        compile_missing(("arena", "estimator"), console)
        with console.status("") as status:
            pairs = validating.validate(
                flights,
                model,
                hover=hover,
                controller=controller,
                high_level=high_level,
                on_flight=lambda done, of: status.update(f"flight {done} of {of}"),
            )
        for table in tables(pairs, model):
            console.print(table)
        folder = out if out is not None else Path.cwd()
        try:
            folder.mkdir(parents=True, exist_ok=True)
            data = validating.summary(pairs, model, hover)
            write_whole(folder / "validate.json", json.dumps(data, indent=2) + "\n")
            if figure:
                save_figure(folder / "validate.png", pairs, model)
        except OSError as error:
            raise InputError(f"--out {folder}: cannot write there: {error.strerror}") from error
        written = "validate.json, validate.png" if figure else "validate.json"
        console.print(f"Written to {folder}: {written}", highlight=False, soft_wrap=True)
        if report:
            leave_report(folder, console)
