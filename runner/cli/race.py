"""A race of lsy_drone_racing, for ``crazyarena dry-run``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from crazyarena.plain_text import shown_line
from crazyarena.runner.cli.common import EXIT_NOT_CLEAN
from crazyarena.runner.cli.options.report import leave_report

if TYPE_CHECKING:
    from crazyarena.runner.trial.options import FlightOptions
    from crazyarena.viewer_process import ViewOptions


def flew_race(
    submissions: list[Path],
    level: str | None,
    episodes: int | None,
    seed: int | None,
    out: Path | None,
    overrides: list[str],
    record: bool,
    options: FlightOptions,
    view: ViewOptions | None,
    report: bool,
    pace: float,
) -> bool:
    """Fly a race of several drones, told by its level; False if this is none."""
    if level is None or not (level.startswith("lsy/") or level.lower().endswith(".toml")):
        return False
    from crazyarena.errors import InputError, StorageError
    from crazyarena.levels.lsy import load_lsy_level, shipped_lsy_levels

    wanted = load_lsy_level(level, overrides, race=True)
    if not wanted.race:
        return False
    for given, name, remedy in (
        (options.budget != type(options.budget)(), "--step-limit, --episode-limit, --trial-limit",
         "a race has none of them; leave them out"),
        (options.compute not in (None, "free"), f"--compute {options.compute}",
         "in lsy_drone_racing's simulation thinking costs no time; leave it out"),
        (options.sandbox is False, "--no-sandbox",
         "in a race each controller has a process of its own; leave it out"),
    ):  # fmt: skip
        if given:
            raise InputError(f"{name}: {remedy}")
    options.check()
    from rich.console import Console

    from crazyarena.runner.lsy_race import LsyRace, race_controllers, tell_race

    file = None if level in shipped_lsy_levels() else Path(level)
    controllers = race_controllers(submissions, wanted, file)
    console = Console()
    run = LsyRace(
        controllers,
        wanted,
        episodes=episodes or 1,
        seed=seed,
        secret=options.secret,
        out=out,
        record=record,
        require_sandbox=options.require_sandbox,
        console=console,
        view=view,
        pace=pace,
    )
    outcome = run.run()
    tell_race(outcome, console)
    told = "The seed is secret" if options.secret else f"Seed {outcome.seed}"
    where = shown_line(str(run.out))
    console.print(f"{told}. Results in {where}", highlight=False, markup=False, soft_wrap=True)
    if report and run.out is not None:
        leave_report(run.out, console)
    run.finish()
    if outcome.cut_short is not None:
        raise StorageError(outcome.cut_short)
    if not outcome.clean:
        raise typer.Exit(EXIT_NOT_CLEAN)
    return True
