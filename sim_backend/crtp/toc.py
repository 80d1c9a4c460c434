"""The tables of contents of the parameters and log variables, and how their types travel.

``toc.json`` lists what a simulation build of the 2026.08 firmware has, in the order of its ids;
``hardware.json`` what a build for hardware has beyond that, leaves out, and boots with.
"""

from __future__ import annotations

import json
import math
import struct
import zlib
from dataclasses import dataclass
from enum import StrEnum
from functools import cache
from importlib import resources
from typing import Any

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


class Table(StrEnum):
    """Whose table of contents: that of a Crazyflie 2.1 or 2.1+, of a 2.1 Brushless, or of the
    reduced simulation build whose packets were recorded."""

    CF21 = "cf21"
    CF21_BRUSHLESS = "cf21b"
    RECORDED = "recorded"

    @property
    def device(self) -> str:
        """Device type, as the vehicle tells it."""
        return _DEVICES[self]


_DEVICES = {
    Table.CF21: "Crazyflie 2.1",
    Table.CF21_BRUSHLESS: "Crazyflie 2.1 Brushless",
    Table.RECORDED: "CF21",
}


@cache
def _file(name: str) -> dict[str, Any]:
    text = resources.files(__package__).joinpath(name).read_text("utf-8")
    document: dict[str, Any] = json.loads(text)
    return document


def protocol_version() -> int:
    """CRTP protocol version of the firmware."""
    return int(_file("toc.json")["protocol"])


def _rows(table: Table, kind: str) -> list[list[Any]]:
    rows: list[list[Any]] = _file("toc.json")[kind]
    if table is Table.RECORDED:
        return rows
    hardware = _file("hardware.json")
    missing = set(hardware["leave_out"][kind])
    return _grouped([row for row in rows if row[0] not in missing] + hardware[kind])


def _grouped(rows: list[list[Any]]) -> list[list[Any]]:
    """Entries of one group side by side, as a client lists them."""
    places: dict[str, int] = {}
    for row in rows:
        places.setdefault(row[0].partition(".")[0], len(places))
    return sorted(rows, key=lambda row: places[row[0].partition(".")[0]])


def _boot(table: Table) -> dict[str, float]:
    if table is Table.RECORDED:
        return {}
    hardware = _file("hardware.json")
    more = hardware["brushless"]["boot"] if table is Table.CF21_BRUSHLESS else {}
    return {**hardware["boot"], **more}


@cache
def param_entries(table: Table = Table.CF21) -> tuple[ParamEntry, ...]:
    """Every parameter, its id being its position."""
    changed = _boot(table)
    entries = []
    for name, ctype, attributes, boot, *default in _rows(table, "params"):
        flags = attributes.split()
        value = float(boot) if isinstance(boot, str) else boot
        entries.append(
            ParamEntry(
                name,
                TYPES[ctype],
                "ro" in flags,
                "persistent" in flags,
                "core" in flags,
                changed.get(name, value),
                default[0] if default else changed.get(name, value),
            )
        )
    return tuple(entries)


@cache
def log_entries(table: Table = Table.CF21) -> tuple[LogEntry, ...]:
    """Every log variable, its id being its position."""
    return tuple(LogEntry(name, TYPES[ctype]) for name, ctype in _rows(table, "logs"))
