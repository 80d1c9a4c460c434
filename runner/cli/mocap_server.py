"""``crazyarena mocap-server``: motion capture for others, with cameras or without."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from crazyarena.runner.cli.common import bad_input_exits
from crazyarena.runner.cli.options.mocap import (
    HOST_HELP,
    OPTION_HELP,
)


def register(app: typer.Typer) -> None:
    app.command("mocap-server")(mocap_server)


def mocap_server(
    protocol: Annotated[
        str,
        typer.Option(
            help="What to serve: qualisys (QTM real-time protocol), natnet (OptiTrack), vrpn or "
            "zenoh."
        ),
    ] = "qualisys",
    source: Annotated[
        str,
        typer.Option(help="sim (circling bodies, no cameras) or any source of mocap-check."),
    ] = "sim",
    host: Annotated[str | None, typer.Option(help=HOST_HELP)] = None,
    option: Annotated[list[str] | None, typer.Option(metavar="KEY=VALUE", help=OPTION_HELP)] = None,
    body: Annotated[
        list[str] | None, typer.Option(help="Body to serve (repeatable; default cf1).")
    ] = None,
    level: Annotated[
        str | None, typer.Option(help="Also serve the gates and obstacles of this level (sim).")
    ] = None,
    rate: Annotated[float, typer.Option(min=1.0, max=1000.0, help="Frames per second (sim).")] = (
        120.0
    ),
    port: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=65533,
            help="QTM base port, of which clients use the next (22222), NatNet command port "
            "(1510), or port of VRPN (3883).",
        ),
    ] = None,
    address: Annotated[str, typer.Option(help="Address to listen on (not zenoh).")] = "127.0.0.1",
    stream: Annotated[
        str, typer.Option(help="Bit stream of natnet: 3.1, 4.0, 4.1 or 4.2.")
    ] = "4.1",
    multicast: Annotated[
        bool, typer.Option("--multicast", help="Send to a multicast group (natnet).")
    ] = False,
    data_port: Annotated[
        int, typer.Option(min=1, max=65535, help="Where natnet frames go.")
    ] = 1511,
    y_up: Annotated[
        bool, typer.Option("--y-up", help="Axes as Motive has them by default (natnet).")
    ] = False,
    listen: Annotated[
        str | None,
        typer.Option(
            help="Endpoint to listen on (zenoh), e.g. tcp/10.0.0.5:7447; without one, only this "
            "machine can hear."
        ),
    ] = None,
    token: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Sign every frame with this file's secret (zenoh)."),
    ] = None,
    zenoh_config: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Zenoh configuration: TLS, users, endpoints (zenoh)."),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the simulated cameras.")] = 0,
    seconds: Annotated[float | None, typer.Option(min=0.1, help="Stop after this long.")] = None,
) -> None:
    """Serve poses as a camera system would, or pass those of real cameras on."""
    with bad_input_exits():
        import math
        from contextlib import closing

        from crazyarena.clock import WallClock
        from crazyarena.errors import InputError
        from crazyarena.mocap.camera_model import CameraModel
        from crazyarena.mocap.natnet_server import NatNetServer
        from crazyarena.mocap.serve import Outlet, circling, relay
        from crazyarena.mocap.sim_source import SimSource
        from crazyarena.mocap.source import PoseSource
        from crazyarena.mocap.vendor_server import QualisysServer
        from crazyarena.mocap.vrpn_server import VrpnServer
        from crazyarena.mocap.zenoh_link import ZenohPublisher
        from crazyarena.runner.rig.cameras import open_named_source

        clock = WallClock()
        names = body or ["cf1"]
        opened: PoseSource
        if source == "sim":
            track = {}
            if level is not None:
                from crazyarena.levels import load_level
                from crazyarena.safety.placement import nominal_track

                track = dict(nominal_track(load_level(level)))
            flight = circling(names)
            opened = SimSource(
                clock, lambda time: {**flight(time), **track}, CameraModel(rate=rate), seed
            )
            names = [*names, *track]
        else:
            opened = open_named_source(source, host, option or (), clock)
        with closing(opened):
            outlet: Outlet
            if protocol == "qualisys":
                outlet = QualisysServer(names, port or 22222, address)
                where = f"QTM real-time protocol on {address}, base port {outlet.port}"
            elif protocol == "natnet":
                outlet = NatNetServer(
                    names, port or 1510, address, stream, multicast, data_port=data_port, y_up=y_up
                )
                how = "multicast" if multicast else "unicast"
                axes = "y up" if y_up else "z up"
                where = f"NatNet {stream} on {address}:{outlet.port}, {how}, {axes}"
            elif protocol == "vrpn":
                outlet = VrpnServer(names, port or 3883, address)
                where = f"VRPN on {address}:{outlet.port}"
            elif protocol == "zenoh":
                outlet = ZenohPublisher(
                    clock, listen=[listen] if listen else (), config=zenoh_config, token=token
                )
                where = f"zenoh on {listen or zenoh_config or 'this machine'}"
            else:
                raise InputError(
                    f"--protocol: found {protocol!r}; choose qualisys, natnet, vrpn or zenoh"
                )
            with closing(outlet):
                typer.echo(f"serving {', '.join(names)}: {where}; Ctrl-C ends")
                try:
                    count = relay(opened, [outlet], clock, seconds or math.inf)
                except KeyboardInterrupt:
                    raise typer.Exit from None
        typer.echo(f"{count} frames served")
