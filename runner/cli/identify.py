"""``crazyarena identify``: a vehicle model from logs of one's own flights."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from crazyarena.runner.cli.common import bad_input_exits
from crazyarena.whole_file import write_whole


def register(app: typer.Typer) -> None:
    app.command("identify")(identify)


def identify(
    flights: Annotated[
        list[Path],
        typer.Argument(
            metavar="RUN...", help="Logs of flights (.mcap, .npz, .csv), or folders of them."
        ),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="File to write the vehicle to (.yaml).")],
    mass: Annotated[
        float | None, typer.Option(metavar="GRAMS", help="Mass of the vehicle as it flew.")
    ] = None,
    start: Annotated[
        str,
        typer.Option(
            "--from",
            metavar="NAME|FILE",
            help="Vehicle model from which everything is taken that the flights do not tell.",
        ),
    ] = "cf21plus",
    controller: Annotated[
        str | None,
        typer.Option(metavar="pid|mellinger", help="Controller, where a file does not say."),
    ] = None,
    high_level: Annotated[
        bool, typer.Option("--high-level", help="Setpoints came from the planner on board.")
    ] = False,
    summary: Annotated[
        Path | None, typer.Option(help="Write every figure into this file as JSON.")
    ] = None,
) -> None:
    """Fit a vehicle model to flights, and say what they cannot tell.

    Poses and commands tell thrust to weight, delay and drag; battery voltage and motor commands
    the strength of each motor and the battery's resistance; accelerometer and attitude the drag
    along each axis; fast gyro or rotor speeds the rotor lag. The errors shown are of flights that
    were not fitted.
    """
    with bad_input_exits():
        from rich.console import Console

        from crazyarena.errors import InputError
        from crazyarena.runner.records import identify_report as report
        from crazyarena.runner.records.identify import identify as identified
        from crazyarena.runner.warm_up import compile_missing
        from crazyarena.sim_backend.vehicles import dump_vehicle, load_vehicle

        console = Console()
        if out.suffix not in (".yaml", ".yml"):
            raise InputError(f"--out {out}: expected a .yaml file")
        model = load_vehicle(start)
        compile_missing(("arena", "estimator"), console)
        with console.status("") as status:
            result = identified(
                flights,
                model,
                mass=None if mass is None else 1e-3 * mass,
                controller=controller,
                high_level=high_level,
                say=status.update,
            )
        for table in report.tables(result):
            console.print(table)
        if not result.unseen:
            console.print(
                "One flight only: the errors are of the flight that was fitted. Pass two or more."
            )
        for warning in result.warnings:
            console.print(f"Warning: {warning}", style="yellow", markup=False, soft_wrap=True)
        vehicle = result.vehicle.model_copy(update={"name": _name(out)})
        try:
            out.parent.mkdir(parents=True, exist_ok=True)
            write_whole(out, dump_vehicle(vehicle))
            if summary is not None:
                write_whole(summary, json.dumps(report.summary(result), indent=2) + "\n")
        except OSError as error:
            raise InputError(f"--out {out}: cannot write there: {error.strerror}") from error
        console.print(f"Written to {out}. Fly it: --vehicle {out}", soft_wrap=True)


def _name(file: Path) -> str:
    import re

    return re.sub(r"[^A-Za-z0-9_.-]", "_", file.stem).lstrip("_.-")[:64] or "vehicle"
