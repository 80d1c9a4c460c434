"""Runs a Crazyswarm script with our ``pycrazyswarm``, ``crazyflie_py`` and ``uav_trajectory``.

In a checkout of Crazyswarm these lie beside the script, where Python finds them first. Here they
are imported before the script's folder is looked at; its other neighbours stay within reach.
"""

from __future__ import annotations

import importlib
import os
import runpy
import sys
from collections.abc import Sequence
from pathlib import Path

import crazyarena
from crazyarena.errors import InputError

NAMES = ("pycrazyswarm", "crazyflie_py", "uav_trajectory")


def _ours() -> Path:
    """Where our packages of these names lie: in a checkout, or installed beside crazyarena."""
    checkout = Path(__file__).resolve().parent / "dropin"
    if checkout.is_dir():
        return checkout
    return Path(crazyarena.__file__).resolve().parent.parent


def command(script: str, arguments: Sequence[str]) -> list[str]:
    """Command line that runs ``script``; InputError if there is no such file."""
    if not os.path.isfile(script):
        raise InputError(f"{script}: no such script (looked in {os.getcwd()})")
    # -P: without the working directory, in which another pycrazyswarm may lie.
    return [sys.executable, "-P", "-m", __name__, script, *arguments]


def main() -> None:
    """Run ``sys.argv[1]`` as the main program, with the arguments behind it."""
    script = sys.argv[1]
    sys.path.insert(0, str(_ours()))
    for name in NAMES:
        importlib.import_module(name)
    sys.path[0] = os.path.dirname(os.path.abspath(script))
    sys.argv = sys.argv[1:]
    runpy.run_path(script, run_name="__main__")


if __name__ == "__main__":
    main()
