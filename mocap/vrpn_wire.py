"""Messages of VRPN 7 (layout: "Format_Of_Protocol.txt" of VRPN; "Protocol.md" of vrpn-rs).

Everything is big endian.

* Connection. Either the client connects to the server's TCP port, or it sends the text ``address
  port`` in a datagram to the UDP port of the same number, and the server connects to it there.
  Both sides then send a cookie of 24 bytes (``vrpn: ver. 07.38  0``); the major version must agree.
* Message: i32 length (24 + body without padding), i32 s and us of the capture, i32 sender, i32
  type, u32 sequence number, then the body, padded to 8 bytes. Senders and types are numbers that
  each side hands out and describes to the other: types -1 and -2, the number in the sender
  field, body u32 length and the name with its NUL.
* Type -3 in the client's messages: poses may go to the UDP port in the sender field, at the
  address in the body. Without it they go over TCP.
* ``vrpn_Tracker Pos_Quat``: i32 sensor, i32 padding, 3 f64 position, 4 f64 quaternion x, y, z, w.
* ``vrpn_Base ping_message`` is answered with ``vrpn_Base pong_message``.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass

COOKIE = b"vrpn: ver. 07.38  0".ljust(24, b"\0")
# Up to the point behind the major version.
_MAJOR = 14
DEFAULT_PORT = 3883
SENDER, TYPE, UDP = -1, -2, -3
POS_QUAT = "vrpn_Tracker Pos_Quat"
PING = "vrpn_Base ping_message"
PONG = "vrpn_Base pong_message"
_HEADER = struct.Struct(">iiiiiI")
POSE = struct.Struct(">ii7d")
_ALIGN = 8
LONGEST = 1 << 16
MAX_NAMES = 4096


class VrpnError(ValueError):
    """What the other side sends is not VRPN 7."""


@dataclass(frozen=True, slots=True)
class Message:
    """One message; ``time`` in s on the sender's clock."""

    kind: int
    sender: int
    time: float
    body: bytes


def pack(kind: int, sender: int, body: bytes, time: float = 0.0, number: int = 0) -> bytes:
    """Return one message."""
    seconds = math.floor(time)
    micro = min(999_999, int((time - seconds) * 1e6))
    header = _HEADER.pack(
        _HEADER.size + len(body), seconds & 0x7FFFFFFF, micro, sender, kind, number & 0xFFFFFFFF
    )
    return header + body + bytes(-len(body) % _ALIGN)


def pack_description(kind: int, number: int, name: str) -> bytes:
    """Return the message that gives ``number`` a name; ``kind`` SENDER or TYPE."""
    text = name.encode() + b"\0"
    return pack(kind, number, struct.pack(">I", len(text)) + text)


def described(message: Message) -> str:
    """Return the name in a description."""
    return message.body[4:].partition(b"\0")[0].decode("utf-8", "replace")


class Stream:
    """Messages out of a byte stream that begins with a cookie."""

    def __init__(self) -> None:
        self._buffer = b""
        self.greeted = False

    def feed(self, data: bytes) -> Iterator[Message]:
        """Yield the messages that are complete by ``data``; raises VrpnError."""
        self._buffer += data
        if not self.greeted:
            if len(self._buffer) < len(COOKIE):
                return
            if self._buffer[:_MAJOR] != COOKIE[:_MAJOR]:
                raise VrpnError(f"cookie {self._buffer[: len(COOKIE)]!r} is not that of VRPN 7")
            self._buffer = self._buffer[len(COOKIE) :]
            self.greeted = True
        at = 0
        buffer = self._buffer
        try:
            while len(buffer) - at >= _HEADER.size:
                length, seconds, micro, sender, kind, _ = _HEADER.unpack_from(buffer, at)
                if not _HEADER.size <= length <= LONGEST:
                    raise VrpnError(f"message of {length} bytes")
                whole = length + -length % _ALIGN
                if len(buffer) - at < whole:
                    return
                body = buffer[at + _HEADER.size : at + length]
                at += whole
                yield Message(kind, sender, seconds + 1e-6 * micro, body)
        finally:
            self._buffer = buffer[at:]


def unpack_datagram(data: bytes) -> list[Message]:
    """Return the messages of one datagram; raises VrpnError."""
    stream = Stream()
    stream.greeted = True
    return list(stream.feed(data))
