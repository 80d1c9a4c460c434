"""``crazyarena dry-run``: fly a submission in simulation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from crazyarena.plain_text import shown_line
from crazyarena.runner.cli.common import (
    EXIT_NOT_CLEAN,
    Secret,
    bad_input_exits,
)
from crazyarena.runner.cli.options.figure import figure_choice
from crazyarena.runner.cli.options.flight import Sandbox, flight_options
from crazyarena.runner.cli.options.groups import takes
from crazyarena.runner.cli.options.report import Report
from crazyarena.runner.cli.options.vehicle import VehicleSpread, vehicle_choice
from crazyarena.runner.cli.options.view import view_options
from crazyarena.runner.cli.race import flew_race

if TYPE_CHECKING:
    from crazyarena.levels.draw_file import LoadedDraw
    from crazyarena.levels.schema import Level
    from crazyarena.runner.trial.options import FlightOptions
    from crazyarena.sim_backend.vehicles import VehicleChoice
    from crazyarena.viewer_process import ViewOptions


def register(app: typer.Typer) -> None:
    app.command("dry-run")(dry_run)


@takes(figure=figure_choice, vehicle=vehicle_choice, options=flight_options, view=view_options)
def dry_run(
    submissions: Annotated[
        list[Path] | None,
        typer.Argument(
            help="Folder with edit_this.py, a .py file with class Controller, or one with a "
            "controller of lsy_drone_racing; for a race of several drones one a drone. Default: "
            "the example racer.",
            show_default=False,
        ),
    ] = None,
    level: Annotated[
        str | None,
        typer.Option(
            help="Shipped level, or a level file. Default: level0, lsy/level0 for a controller "
            "of lsy_drone_racing."
        ),
    ] = None,
    episodes: Annotated[
        int | None, typer.Option(min=1, help="How many. Default: the level's own number.")
    ] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Replaces the level's seed.")] = None,
    secret: Secret = False,
    draw: Annotated[
        Path | None,
        typer.Option(
            help="Fly what a draw file says: its level, in the worlds of its seeds (of a "
            "tournament's results)."
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Results folder. Default: a new one under runs/.")
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="FIELD=VALUE", help="Override a field of the level."),
    ] = None,
    record: Annotated[bool, typer.Option(help="Write an MCAP file an episode.")] = True,
    *,
    figure: str,
    report: Report = True,
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
    view: Callable[[], ViewOptions | None],
    view_speed: Annotated[
        float,
        typer.Option(
            min=0.0,
            max=1000.0,
            help="With --view: times real time that the flight is shown at; 0 for as fast as it "
            "goes.",
        ),
    ] = 1.0,
) -> None:
    """Fly a submission in simulation and judge it by the competition's rules.

    Exit code: 0 when every episode was completed without collision or violation, 1 when not,
    2 when the level or the submission is at fault before anything has flown.
    """
    with bad_input_exits():
        options = replace(options, sandbox=sandbox, secret=secret)
        if not (margins or draw) and flew_race(
            submissions or [],
            level,
            episodes,
            seed,
            out,
            set_ or [],
            record,
            options,
            view(),
            report,
            view_speed,
        ):
            return
        submission = _one(submissions)
        if margins:
            from crazyarena.runner.cli.margins import show

            if show(submission, level or "sim2real", set_ or [], seed, out, options, vehicle):
                return
            raise typer.Exit(EXIT_NOT_CLEAN)
        drawn = None
        if draw is not None:
            given = (level, seed, episodes, set_ or None, options.secret or None)
            drawn, options = _drawn(draw, given, options)
        if _flew_lsy(
            submission,
            level,
            episodes,
            seed,
            out,
            set_ or [],
            record,
            options,
            view(),
            drawn,
            report,
            figure,
            view_speed,
        ):
            return
        from crazyarena.runner.dry_run import DryRun
        from crazyarena.runner.trial.entry import default_level

        run = DryRun(
            submission=submission,
            level=level or default_level(submission)
            if drawn is None
            else cast("Level", drawn.level),
            overrides=set_ or [],
            episodes=episodes,
            seed=seed,
            out=out,
            record=record,
            figure=figure,
            report=report,
            options=options,
            vehicle=vehicle,
            spread=vehicle_spread,
            view=view(),
            pace=view_speed if view() else 0.0,
            seeds=None if drawn is None else drawn.seeds,
        )
        result = run.run()
    if not result.clean:
        raise typer.Exit(EXIT_NOT_CLEAN)


def _one(submissions: list[Path] | None) -> Path | None:
    """The submission, where only one can fly."""
    if submissions and len(submissions) > 1:
        from crazyarena.errors import InputError

        raise InputError(
            f"{len(submissions)} submissions: several fly only in a race, a level of "
            "lsy_drone_racing with env.id MultiDroneRacing-v0, such as lsy/multi_level0"
        )
    return submissions[0] if submissions else None


def _drawn(
    path: Path, given: tuple[object, ...], options: FlightOptions
) -> tuple[LoadedDraw, FlightOptions]:
    """A draw file, and the options with what it says of thinking."""
    from crazyarena.errors import InputError
    from crazyarena.levels.draw_file import read_draw

    names = ("--level", "--seed", "--episodes", "--set", "--secret")
    for name, value in zip(names, given, strict=True):
        if value is not None:
            raise InputError(f"--draw and {name} exclude each other: the draw file says it")
    drawn = read_draw(path)
    if options.compute is None:
        options = replace(options, compute=drawn.file.compute)
    options.check()
    return drawn, options


def _flew_lsy(
    submission: Path | None,
    level: str | None,
    episodes: int | None,
    seed: int | None,
    out: Path | None,
    overrides: list[str],
    record: bool,
    options: FlightOptions,
    view: ViewOptions | None,
    drawn: LoadedDraw | None = None,
    report: bool = True,
    figure: str = "auto",
    pace: float = 1.0,
) -> bool:
    """Fly a controller of lsy_drone_racing, told by its file; False if this is none."""
    looks_like = submission is not None or drawn is not None or (level or "").endswith(".toml")
    if not looks_like and not (level or "").startswith("lsy/"):
        return False
    from crazyarena.errors import InputError, StorageError
    from crazyarena.levels.lsy import LsyLevel, load_lsy_level
    from crazyarena.levels.lsy.schema import LsyProfile
    from crazyarena.runner.trial.entry import is_lsy

    wanted: LsyLevel | None = None
    if drawn is not None:
        level = drawn.level.name
        wanted = drawn.level if isinstance(drawn.level, LsyLevel) else None
    if wanted is None and not is_lsy(submission, level):
        return False
    if submission is not None:
        wanted = wanted or load_lsy_level(level or "lsy/level0", overrides)
        if wanted.profile is LsyProfile.ARENA:
            return False
    if submission is None:
        raise InputError(
            f"level {level}: pass the file of a lsy_drone_racing controller, such as "
            "examples/racer_state/racer_state.py"
        )
    assert wanted is not None
    if options.budget != type(options.budget)():
        raise InputError(
            "--step-limit, --episode-limit, --trial-limit: levels of lsy_drone_racing have none of "
            "them; leave them out"
        )
    if options.compute not in (None, "free"):
        raise InputError(
            f"--compute {options.compute}: in lsy_drone_racing's simulation thinking costs no "
            "time; leave it out"
        )
    options.check()
    from rich.console import Console

    from crazyarena.runner.lsy_run import LsyRun, tell
    from crazyarena.runner.records.report import NOT_ISOLATED

    console = Console()
    run = LsyRun(
        submission,
        wanted,
        overrides,
        episodes=episodes or 1,
        seed=seed,
        out=out,
        keep=True,
        secret=options.secret,
        record=record,
        sandbox=bool(options.sandbox) or options.require_sandbox,
        require_sandbox=options.require_sandbox,
        console=console,
        seeds=None if drawn is None else drawn.seeds,
        view=view,
        pace=pace,
        figure=figure,
        report=report,
    )
    result = run.run()
    tell(result, console)
    if not run.isolated:
        console.print(NOT_ISOLATED, markup=False, highlight=False, soft_wrap=True)
    told = "The seed is secret" if options.secret else f"Seed {result.seed}"
    where = shown_line(str(run.out))
    console.print(f"{told}. Results in {where}", highlight=False, markup=False, soft_wrap=True)
    for line, style in run.told:
        console.print(line, style=style, markup=False, highlight=False, soft_wrap=True)
    run.finish()
    if result.cut_short is not None:
        raise StorageError(result.cut_short)
    if not result.clean:
        raise typer.Exit(EXIT_NOT_CLEAN)
    return True
