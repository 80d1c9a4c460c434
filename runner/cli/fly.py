"""``crazyarena fly``: a trial on a real vehicle, or its dry run with the same line."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from enum import StrEnum
from typing import TYPE_CHECKING, Annotated

import typer

from crazyarena.runner.cli.common import (
    EXIT_NOT_CLEAN,
    AnySubmission,
    ArenaLevel,
    Out,
    Overrides,
    Secret,
    Seed,
    bad_input_exits,
)
from crazyarena.runner.cli.options.figure import figure_choice
from crazyarena.runner.cli.options.flight import flight_options
from crazyarena.runner.cli.options.groups import takes
from crazyarena.runner.cli.options.mocap import HOST_HELP, OPTION_HELP, SOURCE_HELP
from crazyarena.runner.cli.options.report import Report
from crazyarena.runner.cli.options.stops import Waive, flight_stops
from crazyarena.runner.cli.options.vehicle import VehicleSet, VehicleSpread
from crazyarena.runner.cli.options.view import view_options

if TYPE_CHECKING:
    from crazyarena.runner.rig.stops import StopOptions
    from crazyarena.runner.trial.options import FlightOptions
    from crazyarena.viewer_process import ViewOptions


class BackendChoice(StrEnum):
    """What stands behind clock, link and pose source."""

    SIM = "sim"
    RADIO = "radio"


def register(app: typer.Typer) -> None:
    app.command("fly")(fly)


@takes(figure=figure_choice, options=flight_options, stops=flight_stops, view=view_options)
def fly(
    submission: AnySubmission = None,
    level: ArenaLevel = None,
    backend: Annotated[
        BackendChoice, typer.Option(help="radio flies; sim is the dry run of the same line.")
    ] = BackendChoice.RADIO,
    uri: Annotated[
        str | None,
        typer.Option(help="Vehicle's link: radio://0/80/2M/E7E7E7E701, usb://0, udp://HOST:PORT."),
    ] = None,
    ident: Annotated[int, typer.Option("--id", min=0, max=255, help="Id of the vehicle.")] = 1,
    vehicle: Annotated[
        str | None,
        typer.Option(
            metavar="NAME|FILE",
            help="Model of the vehicle, for dry runs and the record: a shipped name or a file. "
            "(A whole number is taken for --id.)",
        ),
    ] = None,
    plant_log: Annotated[
        bool,
        typer.Option(
            help="Record motors, accelerometer and battery voltage 50 times a second, for "
            "crazyarena identify."
        ),
    ] = True,
    vehicle_set: VehicleSet = None,
    vehicle_spread: VehicleSpread = None,
    body: Annotated[
        str | None, typer.Option(help="Its name in the camera system. Default: cf<id>.")
    ] = None,
    mocap: Annotated[str | None, typer.Option(help=SOURCE_HELP)] = None,
    mocap_host: Annotated[str | None, typer.Option(help=HOST_HELP)] = None,
    mocap_option: Annotated[
        list[str] | None, typer.Option(metavar="KEY=VALUE", help=OPTION_HELP)
    ] = None,
    survey: Annotated[
        str | None,
        typer.Option(help="File of crazyarena mocap-survey. Default: measure the track now."),
    ] = None,
    publish: Annotated[
        str | None,
        typer.Option(metavar="ENDPOINT", help="Zenoh endpoint to publish the trial on."),
    ] = None,
    episodes: Annotated[
        int | None, typer.Option(min=1, help="How many. Default: the level's own number.")
    ] = None,
    seed: Seed = None,
    secret: Secret = False,
    out: Out = None,
    set_: Overrides = None,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask before arming.")] = False,
    record: Annotated[bool, typer.Option(help="Write an MCAP file an episode.")] = True,
    *,
    figure: str,
    report: Report = True,
    options: FlightOptions,
    real_time: Annotated[
        bool, typer.Option(help="Ask for real-time scheduling and locked memory.")
    ] = True,
    waive: Waive = None,
    stops: Callable[[str], StopOptions],
    view: Callable[[], ViewOptions | None],
) -> None:
    """Connect, check, survey the track, arm, fly, come home, land.

    Exit codes as for dry-run.
    """
    with bad_input_exits():
        from crazyarena.errors import InputError
        from crazyarena.levels.schema import Level
        from crazyarena.mocap.onboard import KIND as ONBOARD
        from crazyarena.runner.fly import Fly
        from crazyarena.runner.rig.cameras import deck_of, named_source
        from crazyarena.runner.rig.rig import Rig, simulated
        from crazyarena.runner.trial.checklist import check_waivers
        from crazyarena.runner.trial.entry import default_level
        from crazyarena.safety.limits import Limits
        from crazyarena.sim_backend.vehicles import VehicleChoice

        if vehicle is not None and vehicle.isdecimal():
            ident, vehicle = int(vehicle), None
            if ident > 255:
                raise InputError(f"--vehicle: found {ident}; ids are 0 to 255")
        real = backend is BackendChoice.RADIO
        if real and (uri is None or mocap is None):
            raise InputError(
                "fly --backend radio: needs --uri and --mocap (e.g. --uri "
                "radio://0/80/2M/E7E7E7E701 --mocap vicon --mocap-host 192.168.1.5)"
            )

        name = body or f"cf{ident}"
        check_waivers(waive or (), name)
        stopped_by = stops(name)
        source = (
            None if mocap is None else named_source(mocap, mocap_host, mocap_option or [], real)
        )
        if not real:
            # Simulated time runs faster than anybody's hand.
            if stopped_by != stopped_by.only_local():
                typer.echo("Simulated time: nothing has to be held, and nobody else can stop it.")
            stopped_by = stopped_by.only_local()

        def open_rig(loaded: Level, limits: Limits) -> Rig:
            if not real:
                entry = run.entry
                return simulated(
                    loaded,
                    run.seed,
                    limits=limits,
                    supply=run.supply,
                    deck=deck_of(source),
                    track=entry.track,
                    params=entry.params,
                )
            from crazyarena.runner.rig.flight_process.client import connected

            assert uri is not None
            assert source is not None
            return connected(
                loaded,
                uri,
                source,
                vehicle=ident,
                body=body,
                limits=limits,
                real_time=real_time,
                description={"mocap": source.kind, "mocap_host": mocap_host, "world": "arena"},
                model=run.model,
                plant_log=plant_log,
                params=run.entry.params,
            )

        run = Fly(
            submission,
            level or default_level(submission, "sim2real", "lsy/level2"),
            set_ or [],
            episodes,
            seed,
            out,
            record,
            figure,
            report=report,
            options=replace(options, secret=secret),
            open_rig=open_rig,
            yes=yes or not real,
            surveyed=survey,
            publish=None if publish is None else {"connect": [publish]},
            real_time=real_time and real,
            stops=stopped_by,
            waive=waive or (),
            uri=uri if real else None,
            onboard=mocap == ONBOARD,
            vehicle=VehicleChoice(vehicle, tuple(vehicle_set or ())),
            spread=vehicle_spread,
            view=view(),
            pace=0.0 if real else 1.0,
        )
        result = run.run()
    if not result.clean:
        raise typer.Exit(EXIT_NOT_CLEAN)
