"""Datagrams between a dongle in a client's process and the air in that of the vehicles.

A request is ``kind, number, token, serial`` and, to send a frame, its settings and payload; the
answer repeats kind and number. They travel on loopback between processes of one machine.
"""

from __future__ import annotations

import struct
from enum import IntEnum

from crazyarena.sim_backend.crazyradio.air import Frame, Outcome
from crazyarena.sim_backend.crazyradio.air_time import Rate

DEFAULT_PORT = 19840
SERIAL = 10
_HEAD = struct.Struct("<4sBI8s10s")
_FRAME = struct.Struct("<BB5sBI?")
_OUTCOME = struct.Struct("<BBI")
_ANSWER = struct.Struct("<4sBIB")
_MAGIC = b"CRV1"


class Kind(IntEnum):
    """Requests."""

    DONGLES = 0
    CLAIM = 1
    RELEASE = 2
    EXCHANGE = 3


class Status(IntEnum):
    """Answers."""

    OK = 0
    UNPLUGGED = 1
    IN_USE = 2


def request(
    kind: Kind, number: int, token: bytes, serial: str, frame: Frame | None = None
) -> bytes:
    """Datagram of a request."""
    head = _HEAD.pack(_MAGIC, kind, number, token, serial.encode().ljust(SERIAL, b"\0"))
    if frame is None:
        return head
    micros = round(1e6 * frame.ack_wait)
    settings = (frame.channel, frame.rate, frame.address, frame.retries, micros, frame.acked)
    return head + _FRAME.pack(*settings) + frame.payload


def parse_request(data: bytes) -> tuple[Kind, int, bytes, str, Frame | None] | None:
    """Kind, number, token, serial and frame of a datagram; None if it is none of ours."""
    if len(data) < _HEAD.size:
        return None
    magic, kind, number, token, serial = _HEAD.unpack_from(data)
    if magic != _MAGIC or kind > max(Kind):
        return None
    text = serial.rstrip(b"\0").decode("ascii", "replace")
    frame = None
    if kind == Kind.EXCHANGE:
        begin = _HEAD.size + _FRAME.size
        if not begin < len(data) <= begin + 32:
            return None
        channel, rate, address, retries, micros, acked = _FRAME.unpack_from(data, _HEAD.size)
        if rate > max(Rate):
            return None
        frame = Frame(
            channel, Rate(rate), address, data[begin:], retries & 15, 1e-6 * micros, acked
        )
    return Kind(kind), number, token, text, frame


def answer(kind: Kind, number: int, status: Status, body: bytes = b"") -> bytes:
    """Datagram of an answer."""
    return _ANSWER.pack(_MAGIC, kind, number, status) + body


def parse_answer(data: bytes) -> tuple[Kind, int, Status, bytes] | None:
    """Kind, number, status and body of an answer; None if it is none of ours."""
    if len(data) < _ANSWER.size:
        return None
    magic, kind, number, status = _ANSWER.unpack_from(data)
    if magic != _MAGIC or kind > max(Kind) or status > max(Status):
        return None
    return Kind(kind), number, Status(status), data[_ANSWER.size :]


def pack_outcome(outcome: Outcome) -> bytes:
    """Body of the answer to a frame."""
    micros = round(1e6 * outcome.duration)
    flags = int(outcome.acked) | int(outcome.strong) << 1
    return _OUTCOME.pack(flags, outcome.retries, micros) + outcome.payload


def parse_outcome(body: bytes) -> Outcome | None:
    """Inverse of :func:`pack_outcome`; None if it is too short."""
    if len(body) < _OUTCOME.size:
        return None
    flags, retries, micros = _OUTCOME.unpack_from(body)
    payload = body[_OUTCOME.size :]
    return Outcome(bool(flags & 1), retries, 1e-6 * micros, payload, bool(flags & 2))
