"""``crazyarena dry-run --margins``: what a submission still flies with."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

from crazyarena.errors import InputError
from crazyarena.whole_file import write_whole

if TYPE_CHECKING:
    from crazyarena.runner.trial.options import FlightOptions
    from crazyarena.sim_backend.vehicles import VehicleChoice


def show(
    submission: Path | None,
    level: str,
    overrides: list[str],
    seed: int | None,
    out: Path | None,
    options: FlightOptions,
    vehicle: VehicleChoice,
) -> bool:
    """Fly, print the tables, write ``margins.json`` into ``out``; whether the nominal flight is
    completed."""
    from rich.console import Console
    from rich.markup import escape

    from crazyarena.runner.margins import MarginRun, tables

    console = Console()
    with console.status("") as status:
        result = MarginRun(
            submission,
            level,
            overrides=overrides,
            seed=seed,
            options=options,
            vehicle=vehicle,
            say=status.update,
        ).run()
    if not result.completed:
        why = escape(result.why) or result.nominal
        console.print(f"The nominal flight, of a vehicle without spread, is not completed: {why}.")
    for table in tables(result):
        console.print(table)
    if out is not None:
        try:
            out.mkdir(parents=True, exist_ok=True)
            write_whole(out / "margins.json", json.dumps(result.summary(), indent=2) + "\n")
        except OSError as error:
            raise InputError(f"--out {out}: cannot write there: {error.strerror}") from error
    return result.completed
