"""Opens the pose source that the user names on the command line."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from crazyarena.clock import Clock
from crazyarena.errors import InputError
from crazyarena.mocap.onboard import KIND as ONBOARD
from crazyarena.mocap.onboard import certainty
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
    "position_std",
    "velocity_std",
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


def named_source(
    kind: str, host: str | None, pairs: Sequence[str], real: bool = True
) -> SourceSpec:
    """The source of ``--mocap``, ``--host`` and ``--option``, to be opened; or, not ``real``, to
    be simulated."""
    options: dict[str, Any] = dict(parse_options(pairs))
    if kind == ONBOARD:
        if host is not None:
            raise InputError("--mocap onboard: has no host; the vehicle's link is --uri")
        options = numeric(options)
        own = options if real else {k: v for k, v in options.items() if k != "deck"}
        certainty(False, own)  # here, and not in another process
        return SourceSpec(kind, options)
    if kind in ("zenoh", "ros2"):
        for key in ("connect", "listen"):
            if key in options:
                options[key] = options[key].split(",")
        if host is not None:
            options["connect"] = [host]
    elif host is not None and kind != "replay":
        options["hostname"] = host
    return SourceSpec(kind, numeric(options))


def deck_of(source: SourceSpec | None) -> str | None:
    """The deck that is to be simulated, ``--mocap-option deck=``; None for cameras."""
    if source is None or source.kind != ONBOARD:
        return None
    return str(source.options.get("deck", "lighthouse"))


def open_named_source(
    kind: str, host: str | None, pairs: Sequence[str], clock: Clock
) -> PoseSource:
    """Open the source of ``--mocap``, ``--host`` and ``--option``."""
    return named_source(kind, host, pairs).open(clock)
