"""``crazyarena fault-campaign``: fly every fault with the safety on."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from crazyarena.runner.cli.common import EXIT_NOT_CLEAN, bad_input_exits


def register(app: typer.Typer) -> None:
    app.command("fault-campaign")(fault_campaign)


def fault_campaign(
    seeds: Annotated[int, typer.Option(min=1, help="Flights per fault.")] = 10,
    fault: Annotated[
        list[str] | None, typer.Option(help="Only this fault; may be repeated. Default: all.")
    ] = None,
    level: Annotated[str, typer.Option(help="Level whose arena is flown in.")] = "level0",
    margin: Annotated[
        float,
        typer.Option(
            min=0.0, help="m beyond the hard fence allowed to motor, wind and link faults."
        ),
    ] = 2.0,
    workers: Annotated[int, typer.Option(min=1, help="Processes.")] = 1,
    out: Annotated[Path, typer.Option(help="Folder for campaign.json and campaign.png.")] = Path(
        "runs/fault-campaign"
    ),
) -> None:
    """Fly every kind of fault in simulation and show what the safety made of it.

    Exit code: 0 when every flight ended landed or with motors cut, inside the hard fence plus
    0.10 m (plus --margin where no software can help), 1 when not.
    """
    with bad_input_exits():
        from rich.console import Console
        from rich.progress import Progress

        from crazyarena.errors import InputError
        from crazyarena.runner import campaign_report
        from crazyarena.runner.campaign import FAULTS, failures, run_campaign

        console = Console()
        if not console.is_terminal:
            console = Console(width=120)
        names = fault or list(FAULTS)
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"--out {out}: cannot make this folder: {error.strerror}") from None
        with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
            task = progress.add_task("flying", total=seeds * len(names))
            outcomes = run_campaign(
                names, seeds, level, workers, lambda outcome: progress.advance(task)
            )
        campaign_report.write_json(out / "campaign.json", outcomes)
        campaign_report.save_figure(out / "campaign.png", outcomes)
        console.print(campaign_report.table(outcomes))
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
    if failed:
        raise typer.Exit(EXIT_NOT_CLEAN)
