"""Gives any Python program virtual dongles, by its environment alone."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import crazyarena

_VARIABLE = "CRAZYARENA_VIRTUAL_RADIO"
_SITE = Path(__file__).resolve().parent / "site"


def with_dongles(address: str, base: Mapping[str, str] | None = None) -> dict[str, str]:
    """Environment in which a Python program finds the dongles of a gateway.

    Parameters
    ----------
    address: ``host:port`` of the gateway.
    base: the environment to add to; this process's own by default.
    """
    environment = dict(os.environ if base is None else base)
    # The program may have another interpreter, to which this package is not installed.
    package = Path(crazyarena.__file__).resolve().parent.parent
    before = environment.get("PYTHONPATH", "")
    parts = [str(_SITE), *(part for part in (before,) if part), str(package)]
    environment["PYTHONPATH"] = os.pathsep.join(parts)
    environment[_VARIABLE] = address
    return environment
