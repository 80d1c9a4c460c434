"""The tables of contents of the parameters and log variables, and how their types travel.

``toc.json`` lists what the 2026.08 firmware has, in the order of its ids.
"""

from __future__ import annotations

import json
import math
import struct
import zlib
from dataclasses import dataclass
from functools import cache
from importlib import resources

from crazyarena.sim_backend.crtp.packets import Packet, reply

_ITEM, _INFO = 2, 3
_EXTENDED = 0x10
_CORE = 0x20
_READ_ONLY = 0x40


@dataclass(frozen=True, slots=True)
class CType:
    """A C type on the wire: its name, ``struct`` code, and the codes by which TOCs name it."""

    name: str
    code: str
    param: int
    log: int

    @property
    def size(self) -> int:
        return struct.calcsize(self.code)

    def pack(self, value: float) -> bytes:
        """Convert as a C cast on the vehicle would, but saturating; NaN becomes integer 0."""
        if self.code in "fe":
            try:
                return struct.pack("<" + self.code, float(value))
            except OverflowError:
                return struct.pack("<" + self.code, math.copysign(math.inf, value))
        if isinstance(value, float):
            value = 0 if math.isnan(value) else max(min(value, 2.0**63), -(2.0**63))
        bits = 8 * self.size
        low, high = (0, 2**bits - 1) if self.code.isupper() else (-(2 ** (bits - 1)), 0)
        high = high or 2 ** (bits - 1) - 1
        return struct.pack("<" + self.code, min(max(int(value), low), high))

    def unpack(self, data: bytes) -> float:
        """Read the value at the beginning of ``data``; struct.error if too short."""
        return struct.unpack_from("<" + self.code, data)[0]


_TYPES = (
    CType("uint8", "B", 0x08, 1),
    CType("uint16", "H", 0x09, 2),
    CType("uint32", "I", 0x0A, 3),
    CType("int8", "b", 0x00, 4),
    CType("int16", "h", 0x01, 5),
    CType("int32", "i", 0x02, 6),
    CType("float", "f", 0x06, 7),
    CType("fp16", "e", 0x05, 8),
)
TYPES = {ctype.name: ctype for ctype in _TYPES}
LOG_TYPES = {ctype.log: ctype for ctype in _TYPES}
PARAM_TYPES = {ctype.param: ctype for ctype in _TYPES}


@dataclass(frozen=True, slots=True)
class ParamEntry:
    """A parameter: full name, type, access, whether it can be stored and belongs to the stable
    core; value after boot, and the default, which the firmware may replace while it boots."""

    name: str
    ctype: CType
    read_only: bool
    persistent: bool
    core: bool
    boot: float
    default: float

    @property
    def item(self) -> bytes:
        flags = self.persistent * _EXTENDED | self.core * _CORE | self.read_only * _READ_ONLY
        return bytes((self.ctype.param | flags,)) + _wire_name(self.name)


@dataclass(frozen=True, slots=True)
class LogEntry:
    """A log variable: full name and type."""

    name: str
    ctype: CType

    @property
    def item(self) -> bytes:
        return bytes((self.ctype.log,)) + _wire_name(self.name)


def _wire_name(name: str) -> bytes:
    return name.replace(".", "\0", 1).encode("ascii") + b"\0"


class Toc:
    """Channel 0 of the ports 2 and 5: number of entries, checksum, and each entry by id.

    Parameters
    ----------
    items: type byte and names of every entry, in the order of ids.
    limits: bytes that follow the checksum (the log service states its capacity there).
    """

    def __init__(self, port: int, items: list[bytes], limits: bytes = b"") -> None:
        self._port = port
        self._items = items
        # Clients only use it as the key of their cache.
        self.crc = zlib.crc32(b"".join(items))
        self._info = struct.pack("<BHI", _INFO, len(items), self.crc) + limits

    def handle(self, packet: Packet) -> list[bytes]:
        data = packet.data
        if data[:1] == bytes((_INFO,)):
            return [reply(self._port, 0, self._info)]
        if data[:1] == bytes((_ITEM,)) and len(data) >= 3:
            (ident,) = struct.unpack_from("<H", data, 1)
            if ident >= len(self._items):
                return [reply(self._port, 0, bytes((_ITEM,)))]
            return [reply(self._port, 0, data[:3] + self._items[ident])]
        return []


@cache
def _table() -> dict:
    text = resources.files(__package__).joinpath("toc.json").read_text("utf-8")
    return json.loads(text)


def protocol_version() -> int:
    """CRTP protocol version of the firmware."""
    return int(_table()["protocol"])


@cache
def param_entries() -> tuple[ParamEntry, ...]:
    """Every parameter, its id being its position."""
    entries = []
    for name, ctype, attributes, boot, *default in _table()["params"]:
        flags = attributes.split()
        entries.append(
            ParamEntry(
                name,
                TYPES[ctype],
                "ro" in flags,
                "persistent" in flags,
                "core" in flags,
                boot,
                default[0] if default else boot,
            )
        )
    return tuple(entries)


@cache
def log_entries() -> tuple[LogEntry, ...]:
    """Every log variable, its id being its position."""
    return tuple(LogEntry(name, TYPES[ctype]) for name, ctype in _table()["logs"])
