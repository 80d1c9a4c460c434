"""CRTP packets as they travel: one header byte, up to 30 bytes of payload.

The header is ``port << 4 | reserved << 2 | channel``. The firmware answers some requests in the
buffer they came in, so that the reserved bits of the client come back, and builds other answers
afresh, with the reserved bits zero; :func:`echo` and :func:`reply` are those two.
"""

from __future__ import annotations

import errno
from enum import IntEnum
from typing import NamedTuple, Protocol

MAX_PAYLOAD = 30
MAX_DATAGRAM = 1 + MAX_PAYLOAD
NULL_PACKET = b"\xff"
EVERYBODY = object()  # what a link names as the client of a packet that went to all vehicles

# Status bytes are the errno values of the firmware's C library.
OK = 0
ENOENT = errno.ENOENT
EIO = errno.EIO
E2BIG = errno.E2BIG
ENOEXEC = errno.ENOEXEC
ENOMEM = errno.ENOMEM
EACCES = errno.EACCES
EEXIST = errno.EEXIST
EINVAL = errno.EINVAL


class Port(IntEnum):
    """CRTP ports in use."""

    CONSOLE = 0
    PARAM = 2
    SETPOINT = 3
    MEMORY = 4
    LOG = 5
    LOCALIZATION = 6
    GENERIC_SETPOINT = 7
    HIGH_LEVEL = 8
    SUPERVISOR = 9
    PLATFORM = 13
    LINK = 15


class Packet(NamedTuple):
    """A received packet: its header byte and its payload."""

    header: int
    data: bytes

    @property
    def port(self) -> int:
        return self.header >> 4

    @property
    def channel(self) -> int:
        return self.header & 3


class Service(Protocol):
    """What answers on one port. Knows neither sockets nor time; never raises on any payload."""

    def handle(self, packet: Packet) -> list[bytes]:
        """Act on a request and return the datagrams that answer it, often none."""
        ...


def parse(datagram: bytes) -> Packet | None:
    """Split a datagram; None if it is empty, too long or a null packet."""
    if not 0 < len(datagram) <= MAX_DATAGRAM or datagram[0] & 0xF3 == 0xF3:
        return None
    return Packet(datagram[0], datagram[1:])


def reply(port: int, channel: int, data: bytes) -> bytes:
    """Datagram of an answer built afresh."""
    return bytes((port << 4 | channel,)) + data


def echo(packet: Packet, data: bytes) -> bytes:
    """Datagram of an answer written into the buffer of the request."""
    return bytes((packet.header,)) + data
