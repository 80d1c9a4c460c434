"""Opens the pose source that the user names on the command line."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from crazyarena.clock import Clock
from crazyarena.errors import InputError
from crazyarena.mocap.opening import SourceSpec
from crazyarena.mocap.source import PoseSource

_NUMBERS = (
    "latency",
    "stall_after",
    "retry_after",
    "connect_timeout",
    "assemble",
    "release_after",
    "speed",
)


def parse_options(pairs: Sequence[str]) -> dict[str, str]:
    """Read ``KEY=VALUE`` arguments."""
    options = {}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not equals or not key:
            raise InputError(f"--option: found {pair!r}; write KEY=VALUE")
        options[key] = value
    return options


def numeric(options: dict[str, Any]) -> dict[str, Any]:
    """Options of sources, numbers as such; raises InputError for one that is none."""
    options = dict(options)
    for key in _NUMBERS:
        if key in options:
            try:
                options[key] = float(options[key])
            except ValueError:
                raise InputError(f"--option {key}: found {options[key]!r}; need a number") from None
    return options


def named_source(kind: str, host: str | None, pairs: Sequence[str]) -> SourceSpec:
    """The source of ``--mocap``, ``--host`` and ``--option``, to be opened."""
    options: dict[str, Any] = dict(parse_options(pairs))
    if kind in ("zenoh", "ros2"):
        for key in ("connect", "listen"):
            if key in options:
                options[key] = options[key].split(",")
        if host is not None:
            options["connect"] = [host]
    elif host is not None and kind != "replay":
        options["hostname"] = host
    return SourceSpec(kind, numeric(options))


def open_named_source(
    kind: str, host: str | None, pairs: Sequence[str], clock: Clock
) -> PoseSource:
    """Open the source of ``--mocap``, ``--host`` and ``--option``."""
    return named_source(kind, host, pairs).open(clock)
