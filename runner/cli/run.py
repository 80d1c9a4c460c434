"""``crazyarena run``: a Crazyswarm script from wherever it lies, with our packages."""

from __future__ import annotations

import os
import subprocess
import sys
from typing import Annotated

import typer

from crazyarena.runner.cli.common import bad_input_exits


def register(app: typer.Typer) -> None:
    app.command(
        "run",
        context_settings={"ignore_unknown_options": True, "allow_interspersed_args": False},
    )(run)


def run(
    script: Annotated[str, typer.Argument(help="A script of Crazyswarm 1 or 2.")],
    arguments: Annotated[
        list[str] | None, typer.Argument(metavar="[ARGS]", help="Passed on to it.")
    ] = None,
) -> None:
    """Run a Crazyswarm script with crazyarena's pycrazyswarm and crazyflie_py.

    crazyarena run ros_ws/src/crazyswarm/scripts/figure8_csv.py --sim --vis null

    A checkout of Crazyswarm has packages of these names beside its scripts, which plain python
    would take. Other neighbours of the script are found as always. Exit code: that of the script.
    """
    with bad_input_exits():
        from crazyarena.crazyswarm_compat.launch import command

        line = command(script, arguments or [])
        if os.name == "posix":
            sys.stdout.flush()
            os.execv(line[0], line)
        raise typer.Exit(subprocess.run(line, check=False).returncode)
