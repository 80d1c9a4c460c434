"""``crazyarena fault-campaign``: fly every fault with the safety on."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Annotated

import typer

from crazyarena.runner.cli.common import EXIT_NOT_CLEAN, bad_input_exits
from crazyarena.runner.cli.options.report import Report, leave_report
from crazyarena.runner.cli.options.vehicle import VehicleName, VehicleSet, vehicle_choice


def register(app: typer.Typer) -> None:
    app.command("fault-campaign")(fault_campaign)


def fault_campaign(
    seeds: Annotated[int, typer.Option(min=1, help="Flights per fault.")] = 10,
    fault: Annotated[
        list[str] | None, typer.Option(help="Only this fault; may be repeated. Default: all.")
    ] = None,
    level: Annotated[str, typer.Option(help="Level whose arena is flown in.")] = "level0",
    udp: Annotated[
        bool,
        typer.Option(
            "--udp",
            help="Fly in real time over the virtual radio: cflib, cameras over zenoh, the ground "
            "station in a process of its own. 13 s a flight; not every fault.",
        ),
    ] = False,
    radio: Annotated[
        bool, typer.Option("--radio", help="As --udp, over a virtual Crazyradio.")
    ] = False,
    margin: Annotated[
        float,
        typer.Option(
            min=0.0, help="m beyond the hard fence allowed when a motor fails or wind blows."
        ),
    ] = 1.5,
    workers: Annotated[
        int | None,
        typer.Option(
            min=1, help="Flights side by side. Default: 1, with --udp 2.", show_default=False
        ),
    ] = None,
    vehicle: VehicleName = None,
    vehicle_set: VehicleSet = None,
    report: Report = True,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder for campaign.json and campaign.png. Default: runs/fault-campaign, with "
            "--udp runs/fault-campaign-udp, with --radio runs/fault-campaign-radio.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Fly every kind of fault and show what the safety made of it.

    In simulation, as fast as it goes, or in real time with --udp or --radio.

    Exit code: 0 when every flight ended landed or with motors cut, inside the hard fence plus
    0.10 m (--margin where no software can help), 1 when not.
    """
    with bad_input_exits():
        from rich.console import Console
        from rich.progress import Progress

        from crazyarena.errors import InputError
        from crazyarena.runner.campaign import report as told
        from crazyarena.runner.campaign import run as virtual
        from crazyarena.runner.campaign.faults import ALL_FAULTS
        from crazyarena.runner.campaign.outcome import failures
        from crazyarena.runner.campaign.udp import run as real

        console = Console()
        if not console.is_terminal:
            console = Console(width=120)
        in_real_time = udp or radio
        flown = vehicle_choice(vehicle, vehicle_set)
        names = fault or list(real.UDP_FAULTS if in_real_time else ALL_FAULTS)
        run = (
            functools.partial(real.run_campaign, radio=radio)
            if in_real_time
            else virtual.run_campaign
        )
        title = told.UDP if in_real_time else told.SIMULATED
        workers = workers or (2 if in_real_time else 1)
        name = "fault-campaign-radio" if radio else "fault-campaign-udp"
        out = out or Path("runs", name if in_real_time else "fault-campaign")
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"--out {out}: cannot make this folder: {error.strerror}") from None
        with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
            task = progress.add_task("flying", total=seeds * len(names))
            outcomes = run(
                names,
                seeds,
                level,
                workers,
                lambda outcome: progress.advance(task),
                vehicle=flown,
            )
        told.write_json(out / "campaign.json", outcomes, title)
        told.save_figure(out / "campaign.png", outcomes, title)
        console.print(told.table(outcomes, title))
        failed = failures(outcomes, margin)
        safe = sum(outcome.safe for outcome in outcomes)
        console.print(f"{safe} of {len(outcomes)} flights ended in a safe state. Results in {out}")
        for outcome in failed:
            console.print(
                f"{outcome.fault}, seed {outcome.seed}: ended {outcome.end}, "
                f"{outcome.excursion:.2f} m beyond the hard fence",
                style="red",
                highlight=False,
            )
        if report:
            leave_report(out, console)
    if failed:
        raise typer.Exit(EXIT_NOT_CLEAN)
