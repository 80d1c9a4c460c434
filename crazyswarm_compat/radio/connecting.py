"""Opens a connection and waits for it, or says why there is none."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable

from crazyarena.clock import Clock
from crazyarena.crazyswarm_compat.radio.client import Client
from crazyarena.errors import BackendError

_LOOK = 0.5  # s, between looks at the progress
_STARTING = 10.0  # s in which a program that was started just before may open its port
_UDP = re.compile(r"udp://[^/:\s]+:(\d+)/?")
# Dongle by number or serial, channel, rate, address.
_RADIO = re.compile(r"radio://[0-9A-Fa-f]+(/\d+(/(250K|1M|2M)(/[0-9A-Fa-f]{1,10})?)?)?(\?.*)?")


def wrong_uri(uri: str) -> str | None:
    """What is wrong with a link's address before it is opened; None for what cflib may open."""
    if uri.startswith("udp://"):
        found = _UDP.fullmatch(uri)
        if found is None or not 0 < int(found[1]) < 65536:
            return "expected udp://HOST:PORT, such as udp://127.0.0.1:19850"
    elif uri.startswith("radio://"):
        found = _RADIO.fullmatch(uri)
        channel = uri.split("?")[0].split("/")[3:4]
        if found is None or (channel and int(channel[0]) > 125):
            return (
                "expected radio://DONGLE/CHANNEL/RATE/ADDRESS, such as "
                "radio://0/80/2M/E7E7E7E701 (channel 0..125, rate 250K, 1M or 2M)"
            )
    elif "://" not in uri:
        return "expected a link such as radio://0/80/2M/E7E7E7E701 or udp://127.0.0.1:19850"
    return None


class NobodyThere(BackendError):
    """The computer is there, but no program listens on the port."""


def patiently(connect: Callable[[], None], clock: Clock, timeout: float) -> None:
    """``connect()``, again while no program listens on the port, but not for longer than
    ``timeout`` s: a virtual vehicle that was started on the line before needs its time."""
    deadline = clock.now() + min(_STARTING, timeout)
    while True:
        try:
            return connect()
        except NobodyThere:
            if clock.now() > deadline:
                raise
        clock.sleep_until(clock.now() + _LOOK)


def open_connection(
    client: Client,
    uri: str,
    who: str,
    timeout: float,
    clock: Clock,
    complete: threading.Event,
    failure: Callable[[], str | None],
    abandoned: Callable[[], bool],
) -> None:
    """Open ``uri`` and wait until the tables and wanted values are here.

    Parameters
    ----------
    timeout: s without progress; a slow link that goes on answering is given more.
    complete: set by the client's ``fully_connected``.
    failure: what the driver has complained of, None for nothing.
    abandoned: whether nobody wants it any more.

    Raises
    ------
    NobodyThere
        no program listens on the UDP port.
    BackendError
        naming the vehicle, its link and what to look at.
    """
    where = f"{who} ({uri})"
    deadline = clock.now() + timeout
    answers = 0
    client.open_link(uri)
    while not complete.wait(_LOOK):
        if abandoned():
            raise BackendError(f"{where}: given up, the program ends")
        if client.answers > answers:
            answers, deadline = client.answers, clock.now() + timeout
        why = failure()
        if why is not None:
            # A driver's message may end in a traceback, whose last line says what it was.
            lines = why.strip().splitlines() or ["unknown reason"]
            if "Connection refused" in lines[-1]:
                raise NobodyThere(
                    f"{where}: cannot connect: connection refused, nobody listens there; is the "
                    "virtual vehicle running (crazyarena virtual-cf)?"
                )
            raise BackendError(
                f"{where}: cannot connect: {lines[-1].strip()}; is the vehicle switched on, and "
                "the radio plugged in?"
            )
        silent = client.platform.get_protocol_version() < 0
        if clock.now() > deadline:
            raise BackendError(
                f"{where}: no answer within {timeout:g} s; is the vehicle switched on, and are "
                "radio, channel, data rate and address right?"
                if silent
                else f"{where}: answers, but nothing more came for {timeout:g} s while its tables "
                "and parameters were read; the link is bad, move closer or change the channel"
            )
        if silent and client.link is not None:
            client.ask_identity()
