"""``crazyarena virtual-cf``: simulated Crazyflies that a client cannot tell from real ones."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Any

import typer

from crazyarena.errors import CrazyarenaError, InputError
from crazyarena.runner.cli.common import bad_input_exits
from crazyarena.runner.cli.options.groups import takes
from crazyarena.runner.cli.options.vehicle import vehicle_choice
from crazyarena.runner.cli.options.view import view_options

if TYPE_CHECKING:
    from crazyarena.sim_backend.vehicles import VehicleChoice
    from crazyarena.viewer_process import ViewOptions

_PROFILES = ("arena",)


def register(app: typer.Typer) -> None:
    app.command("virtual-cf")(virtual_cf)


@takes(vehicle=vehicle_choice, view=view_options)
def virtual_cf(
    count: Annotated[int, typer.Option(help="How many vehicles.")] = 1,
    port: Annotated[int, typer.Option(help="UDP port of the first; 0 takes free ones.")] = 19850,
    host: Annotated[str, typer.Option(help="Address to listen on.")] = "127.0.0.1",
    level: Annotated[
        str | None, typer.Option(help="Level whose gates, obstacles and start to use.")
    ] = None,
    *,
    vehicle: VehicleChoice,
    profile: Annotated[str, typer.Option(help="Simulated firmware: arena.")] = "arena",
    loss: Annotated[
        str | None, typer.Option(metavar="SHARE", help="Lost packets each way, e.g. 5%.")
    ] = None,
    latency: Annotated[
        str | None, typer.Option(metavar="TIME", help="Delay each way, e.g. 8ms±3ms.")
    ] = None,
    battery: Annotated[
        str | None, typer.Option(metavar="VOLTS", help="Battery at the start, e.g. 3.7V.")
    ] = None,
    safe_link: Annotated[
        bool, typer.Option(help="Repeat lost requests and answers, as a radio's safe link does.")
    ] = True,
    feed_poses: Annotated[
        float,
        typer.Option(
            metavar="HZ", help="Give each vehicle its true pose, as if a client had sent it."
        ),
    ] = 0.0,
    mocap: Annotated[bool, typer.Option(help="Publish the poses over zenoh.")] = True,
    mocap_endpoint: Annotated[
        str, typer.Option(help="Zenoh endpoint to listen on.")
    ] = "tcp/127.0.0.1:7447",
    mocap_rate: Annotated[float, typer.Option(metavar="HZ", help="Camera frames.")] = 120.0,
    camera_noise: Annotated[
        bool, typer.Option(help="Noise, delay and dropouts of real cameras.")
    ] = False,
    seed: Annotated[int, typer.Option(min=0, help="Of losses and camera noise.")] = 0,
    radio: Annotated[
        bool, typer.Option("--radio", help="Virtual Crazyradios instead of UDP ports.")
    ] = False,
    channel: Annotated[
        str, typer.Option(help="Radio channels, which the vehicles take in turn: 80 or 80,90.")
    ] = "80",
    rate: Annotated[str, typer.Option(help="Radio data rate: 250K, 1M or 2M.")] = "2M",
    dongles: Annotated[int, typer.Option(help="How many virtual Crazyradios are plugged in.")] = 1,
    radio_port: Annotated[
        int, typer.Option(help="UDP port on which programs with virtual dongles find the air.")
    ] = 19840,
    table: Annotated[
        str | None,
        typer.Option(
            help="Whose parameters and log variables: cf21 (Crazyflie 2.1 and 2.1+), cf21b "
            "(2.1 Brushless) or recorded (a simulation build, for replaying its recordings). "
            "Default: by the vehicle."
        ),
    ] = None,
    deck: Annotated[
        str | None,
        typer.Option(
            help="Positioning deck on every vehicle, lighthouse or flow: they know their place by "
            "themselves, with the errors of such a deck."
        ),
    ] = None,
    fleet: Annotated[
        str | None,
        typer.Option(
            metavar="YAML", help="Vehicle list of Crazyswarm: how many, their numbers and places."
        ),
    ] = None,
    view: Callable[[], ViewOptions | None],
) -> None:
    """Run simulated Crazyflies in wall time, each on its own UDP port or on the air.

    Any CRTP client finds them, e.g. cflib with udp://127.0.0.1:19850; with --radio, any program
    under crazyarena with-virtual-radio, as radio://0/80/2M/E7E7E7E701. The estimator knows only
    the poses that clients send (or --feed-poses, or --deck). While it runs, standard input takes
    "loss 5%", "latency 8ms±3ms", "battery 3.2V", "cut 2s", "reboot" and "status", with --radio
    also "unplug 0", "plug 0" and "noise 80 30%"; "cf2 loss 5%" means that vehicle alone.
    Ends at Ctrl-C or SIGTERM.
    """
    with bad_input_exits():
        if profile not in _PROFILES:
            raise InputError(f"--profile: found {profile!r}; choose {' or '.join(_PROFILES)}")
        from rich.console import Console

        from crazyarena.runner.warm_up import compile_missing
        from crazyarena.sim_backend.crtp.host import Options, build
        from crazyarena.sim_backend.crtp.orders import status

        compile_missing(["arena"], Console(stderr=True))
        viewer = view()
        running = build(
            Options(
                count=count,
                host=host,
                port=port,
                level=level,
                vehicle=vehicle,
                loss=loss,
                latency=latency,
                battery=battery,
                safe_link=safe_link,
                feed_poses=feed_poses,
                mocap=mocap,
                mocap_endpoint=mocap_endpoint,
                mocap_rate=mocap_rate,
                camera_noise=camera_noise,
                seed=seed,
                radio=radio,
                channel=channel,
                rate=rate,
                dongles=dongles,
                radio_port=radio_port,
                table=table,
                deck=deck,
                fleet=fleet,
            )
        )
        server = running.server
        shown = None
        if viewer is not None:
            from crazyarena.runner.viewer.virtual_fleet import ShownFleet

            try:
                shown = ShownFleet(
                    server.swarm.fleet, level, viewer, lambda text: typer.echo(text, err=True)
                )
            except BaseException:
                running.close()
                raise
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: server.stop())
    for uri in server.uris:
        typer.echo(uri)
    if running.gateway is not None:
        typer.echo(f"air {running.gateway.address}")
    sys.stdout.flush()
    if _may_read_input():
        threading.Thread(target=_obey, args=(running,), daemon=True).start()
    try:
        server.run()
        for line in status(server):
            typer.echo(line, err=True)
    finally:
        if shown is not None:
            shown.close()
        running.close()


def _may_read_input() -> bool:
    """False in the background of a terminal, where reading would stop the process."""
    with contextlib.suppress(OSError, ValueError):
        number = sys.stdin.fileno()
        return not os.isatty(number) or os.tcgetpgrp(number) == os.getpgrp()
    return False


def _obey(running: Any) -> None:
    for line in sys.stdin:
        if not line.strip():
            continue
        try:
            typer.echo(running.command(line))
        except CrazyarenaError as error:
            typer.echo(f"error: {error}", err=True)
        sys.stdout.flush()
