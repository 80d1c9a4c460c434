"""``crazyarena with-virtual-radio``: any Python program, with a Crazyradio that is software."""

from __future__ import annotations

import os
import subprocess
import sys
from typing import Annotated

import typer

from crazyarena.errors import InputError
from crazyarena.runner.cli.common import bad_input_exits


def register(app: typer.Typer) -> None:
    app.command("with-virtual-radio")(with_virtual_radio)


def with_virtual_radio(
    program: Annotated[list[str], typer.Argument(metavar="-- PROGRAM [ARGS]", help="What to run.")],
    air: Annotated[
        str | None,
        typer.Option(
            metavar="HOST:PORT",
            help="Where a crazyarena virtual-cf --radio runs. Default: vehicles of its own.",
        ),
    ] = None,
    count: Annotated[int, typer.Option(help="Vehicles of its own.")] = 1,
    channel: Annotated[str, typer.Option(help="Their radio channels, as 80 or 80,90.")] = "80",
    rate: Annotated[str, typer.Option(help="Their data rate: 250K, 1M or 2M.")] = "2M",
    dongles: Annotated[int, typer.Option(help="How many dongles are plugged in.")] = 1,
    loss: Annotated[
        str | None, typer.Option(metavar="SHARE", help="Lost at each attempt, e.g. 5%.")
    ] = None,
    feed_poses: Annotated[
        float, typer.Option(metavar="HZ", help="Give each vehicle its true pose; 0 does not.")
    ] = 100.0,
) -> None:
    """Run a program whose cflib finds virtual Crazyradios, and no other USB device.

    crazyarena with-virtual-radio --count 2 -- python script.py radio://0/80/2M/E7E7E7E701

    Python programs of any kind will do, such as cflib's examples or cfclient; their radio driver
    is cflib's own. Exit code: that of the program.
    """
    with bad_input_exits():
        from crazyarena.sim_backend.crazyradio.environment import with_dongles

        vehicles = None
        if air is None:
            options = ["--count", str(count), "--channel", channel, "--rate", rate]
            options += ["--dongles", str(dongles), "--feed-poses", str(feed_poses)]
            options += [] if loss is None else ["--loss", loss]
            vehicles, air = _own_vehicles(options)
        else:
            host, _, port = air.rpartition(":")
            if not host or not port.isdigit():
                raise InputError(f"--air: found {air!r}; write HOST:PORT, as 127.0.0.1:19840")
        try:
            code = _run(program, with_dongles(air))
        finally:
            if vehicles is not None:
                vehicles.terminate()
                vehicles.wait()
    raise typer.Exit(code)


def _own_vehicles(options: list[str]) -> tuple[subprocess.Popen[str], str]:
    """Vehicles in a process of their own and the address of their air."""
    command = [sys.executable, "-m", "crazyarena", "virtual-cf", "--radio", "--no-mocap"]
    process = subprocess.Popen(
        [*command, "--radio-port", "0", *options],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,  # Ctrl-C is for the program; its vehicles outlive it
    )
    assert process.stdout is not None
    for line in process.stdout:
        typer.echo(line.strip(), err=True)
        if line.startswith("air "):
            return process, line.split()[1]
    process.wait()
    raise InputError("with-virtual-radio: its vehicles did not start (see above)")


def _run(program: list[str], environment: dict[str, str]) -> int:
    try:
        child = subprocess.Popen(program, env=environment)
    except OSError as error:
        raise InputError(f"{program[0]}: cannot be run ({os.strerror(error.errno or 0)})") from None
    while True:
        try:
            code = child.wait()
        except KeyboardInterrupt:
            continue  # it has got the same Ctrl-C
        return 128 - code if code < 0 else code
