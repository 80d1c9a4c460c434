"""What ``fly``, ``bench`` and ``preflight`` share: what stops a flight besides the watchdog.

Endpoints and token mean what they mean for ``crazyarena estop``, which is the other end.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from crazyarena.runner.rig.stops import StopOptions


class DeadManChoice(StrEnum):
    """:class:`~crazyarena.runner.rig.stops.DeadManBy`, without its imports."""

    KEY = "key"
    GAMEPAD = "gamepad"


Gamepad = Annotated[
    str | None,
    typer.Option(
        metavar="auto|/dev/input/eventN",
        help="Gamepad whose button B stops the motors; auto takes the first.",
    ),
]
DeadMan = Annotated[
    DeadManChoice | None,
    typer.Option(
        help="Fly only while the operator holds h in this terminal (key) or the gamepad's left "
        "shoulder button: the countdown waits for it, and letting go lands.",
    ),
]
StopNetwork = Annotated[
    bool,
    typer.Option(
        "--stop-network",
        help="Obey crazyarena estop --network from anywhere on this network.",
    ),
]
StopConnect = Annotated[
    list[str] | None,
    typer.Option(
        metavar="ENDPOINT",
        help="Obey crazyarena estop through this zenoh router, e.g. tcp/10.0.0.5:7447.",
    ),
]
StopListen = Annotated[
    list[str] | None,
    typer.Option(
        metavar="ENDPOINT",
        help="Obey crazyarena estop --connect to this endpoint of ours, e.g. tcp/0.0.0.0:7450.",
    ),
]
StopToken = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="Refuse stops over zenoh that do not know this file's secret, as crazyarena estop "
        "--token FILE does.",
    ),
]

Waive = Annotated[
    list[str] | None,
    typer.Option(
        metavar="LINE",
        help="Fly in spite of this red line of the pre-flight checklist; goes on record. "
        "Repeatable.",
    ),
]


def flight_stops(
    gamepad: Gamepad = None,
    dead_man: DeadMan = None,
    stop_network: StopNetwork = False,
    stop_connect: StopConnect = None,
    stop_listen: StopListen = None,
    stop_token: StopToken = None,
) -> Callable[[str], StopOptions]:
    """A group of options: what stops a flight, once its session has a name."""
    return lambda session: stop_options(
        gamepad, dead_man, stop_network, stop_connect, stop_listen, stop_token, session
    )


def stop_options(
    gamepad: str | None,
    dead_man: DeadManChoice | None,
    network: bool,
    connect: Sequence[str] | None,
    listen: Sequence[str] | None,
    token: Path | None,
    session: str,
) -> StopOptions:
    """Options as typed; the keyboard is one more whenever somebody sits at it."""
    from crazyarena.runner.rig.stops import DeadManBy, StopOptions, has_keyboard

    return StopOptions(
        keyboard=has_keyboard(),
        gamepad=gamepad,
        dead_man=None if dead_man is None else DeadManBy(dead_man.value),
        network=network,
        connect=tuple(connect or ()),
        listen=tuple(listen or ()),
        token=token,
        session=session,
    )
