"""``crazyarena bench``: the whole hardware path in real time, without hardware."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from crazyarena.runner.cli.common import (
    EXIT_NOT_CLEAN,
    AnySubmission,
    ArenaLevel,
    Out,
    Overrides,
    bad_input_exits,
)
from crazyarena.runner.cli.options.figure import figure_choice
from crazyarena.runner.cli.options.flight import flight_options
from crazyarena.runner.cli.options.groups import takes
from crazyarena.runner.cli.options.mocap import OPTION_HELP
from crazyarena.runner.cli.options.report import Report, leave_report
from crazyarena.runner.cli.options.stops import Waive, flight_stops
from crazyarena.runner.cli.options.vehicle import VehicleSpread, vehicle_choice
from crazyarena.runner.cli.options.view import view_options
from crazyarena.whole_file import write_whole

if TYPE_CHECKING:
    from crazyarena.runner.rig.stops import StopOptions
    from crazyarena.runner.trial.options import FlightOptions
    from crazyarena.sim_backend.vehicles import VehicleChoice
    from crazyarena.viewer_process import ViewOptions


class CameraChoice(StrEnum):
    """What the cameras speak; ``onboard`` is a vehicle that knows its place by a deck."""

    ZENOH = "zenoh"
    QUALISYS = "qualisys"
    NATNET = "natnet"
    VRPN = "vrpn"
    ONBOARD = "onboard"


class LinkChoice(StrEnum):
    """What carries the radio protocol."""

    UDP = "udp"
    RADIO = "radio"


def register(app: typer.Typer) -> None:
    app.command("bench")(bench)


@takes(
    figure=figure_choice,
    vehicle=vehicle_choice,
    options=flight_options,
    stops=flight_stops,
    view=view_options,
)
def bench(
    submission: AnySubmission = None,
    level: ArenaLevel = None,
    runs: Annotated[int, typer.Option(min=1, max=100, help="How many, on the same draw.")] = 1,
    seed: Annotated[
        int | None,
        typer.Option(min=0, help="Of the draw. Default: 128 bits that nobody can guess."),
    ] = None,
    out: Out = None,
    set_: Overrides = None,
    dry: Annotated[
        bool, typer.Option("--dry/--no-dry", help="Fly the dry runs too, and compare.")
    ] = True,
    link: Annotated[
        LinkChoice, typer.Option(help="UDP, or a virtual Crazyradio under cflib's radio driver.")
    ] = LinkChoice.UDP,
    mocap_rate: Annotated[
        float | None, typer.Option(min=10.0, max=500.0, metavar="HZ", help="Camera frames.")
    ] = None,
    mocap: Annotated[
        CameraChoice,
        typer.Option(help="What the cameras speak; onboard: none, but a deck."),
    ] = CameraChoice.ZENOH,
    mocap_option: Annotated[
        list[str] | None, typer.Option(metavar="KEY=VALUE", help=OPTION_HELP)
    ] = None,
    *,
    figure: str,
    report: Report = True,
    vehicle: VehicleChoice,
    vehicle_spread: VehicleSpread = None,
    options: FlightOptions,
    real_time: Annotated[
        bool, typer.Option(help="Ask for real-time scheduling and locked memory.")
    ] = True,
    waive: Waive = None,
    stops: Callable[[str], StopOptions],
    view: Callable[[], ViewOptions | None],
) -> None:
    """Fly a virtual Crazyflie over UDP or radio with emulated cameras, in real time.

    Radio protocol, client, camera network, watchdog and contestant's process are those of a
    flight; --compute is for the dry runs that it is compared with.
    """
    with bad_input_exits():
        import datetime

        from rich.console import Console

        from crazyarena.runner.bench import Bench
        from crazyarena.runner.dry_run import example_racer
        from crazyarena.runner.records import compare as comparing
        from crazyarena.runner.rig.cameras import numeric, parse_options
        from crazyarena.runner.trial.entry import default_level, enter

        console = Console()
        level = level or default_level(submission, "sim2real", "lsy/level2")
        loaded = enter(submission or example_racer(), level, set_ or []).level
        stamp = datetime.datetime.now().strftime("%Y%m%d-%H%M%S")
        folder = out if out is not None else Path("runs") / f"{stamp}-bench-{loaded.name}"
        folder.mkdir(parents=True, exist_ok=True)
        run = Bench(
            submission,
            level,
            folder.resolve(),
            overrides=set_ or [],
            runs=runs,
            seed=replace(options, secret=seed is None).seed(seed, loaded),
            dry=dry,
            options=options,
            real_time=real_time,
            figure=figure,
            console=console,
            waive=waive or (),
            radio=link is LinkChoice.RADIO,
            cameras=None if mocap_rate is None else {"rate": mocap_rate},
            mocap=mocap.value,
            mocap_options=numeric(parse_options(mocap_option or ())),
            stops=stops("bench"),
            vehicle=vehicle,
            spread=vehicle_spread,
            view=view(),
        )
        result = run.run()
        if result.comparison is not None:
            console.print(comparing.table(result.comparison))
            summary = {**result.comparison.document(), "arenas": result.arenas}
            write_whole(folder / "compare.json", json.dumps(summary, indent=2) + "\n")
            if figure != "none":
                from crazyarena.runner.records.compare_figure import save_figure

                save_figure(folder / "compare.png", result.comparison)
                console.print(f"Figure: {folder / 'compare.png'}", highlight=False, soft_wrap=True)
        for reason in (result.uncompared, result.aborted):
            if reason is not None:
                text = f"bench: {reason.removeprefix('compare: ')}"
                console.print(text, style="red", markup=False, highlight=False, soft_wrap=True)
        if report and result.flown:
            leave_report(folder, console)
        run.finish()
    if not result.clean:
        raise typer.Exit(EXIT_NOT_CLEAN)
