"""Port 5: log blocks, by which a client subscribes to variables."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass, field

from crazyarena.sim_backend.crtp.packets import (
    E2BIG,
    EEXIST,
    ENOENT,
    ENOEXEC,
    ENOMEM,
    OK,
    Packet,
    Port,
    echo,
    reply,
)
from crazyarena.sim_backend.crtp.toc import LOG_TYPES, CType, Table, Toc, log_entries

MAX_BLOCKS = 16
MAX_VARIABLES = 128  # of all blocks together
MAX_BYTES = 26  # of one block's values

_TOC, _CONTROL, _DATA = range(3)
_DELETE, _START, _STOP, _RESET, _CREATE, _APPEND, _START_MS = 2, 3, 4, 5, 6, 7, 8
_VARIABLE = struct.Struct("<BH")


@dataclass(slots=True)
class _Block:
    ident: int
    variables: list[tuple[int, CType]] = field(default_factory=list)
    size: int = 0
    period: int = 0  # ms; 0: not running
    due: int = 0  # ms


class LogService:
    """Answers on port 5 and produces the data packets.

    Parameters
    ----------
    read: value of a log variable by its id.
    table: whose variables.
    """

    def __init__(self, read: Callable[[int], float], table: Table = Table.CF21) -> None:
        self.entries = log_entries(table)
        self._read = read
        self._toc = Toc(
            Port.LOG, [e.item for e in self.entries], bytes((MAX_BLOCKS, MAX_VARIABLES))
        )
        self._blocks: dict[int, _Block] = {}
        self._now = 0

    def reset(self) -> None:
        """Delete all blocks."""
        self._blocks.clear()

    def due(self) -> int | None:
        """When the next data packet is to be made, ms; None if no block is running."""
        return min((b.due for b in self._blocks.values() if b.period), default=None)

    def advance(self, now: int) -> list[bytes]:
        """Data packets of the blocks that are due at firmware time ``now`` (ms)."""
        self._now = now
        packets = []
        for block in self._blocks.values():
            if block.period and now >= block.due:
                packets.append(self._data(block, now))
                # On the grid of the start, unless whole periods fell between two calls.
                block.due += block.period
                if block.due <= now:
                    block.due = now + block.period
        return packets

    def _data(self, block: _Block, now: int) -> bytes:
        stamp = struct.pack("<I", now & 0xFFFFFF)[:3]
        values = b"".join(ctype.pack(self._read(ident)) for ident, ctype in block.variables)
        return reply(Port.LOG, _DATA, bytes((block.ident,)) + stamp + values)

    def handle(self, packet: Packet) -> list[bytes]:
        if packet.channel == _TOC:
            return self._toc.handle(packet)
        if packet.channel != _CONTROL or not packet.data:
            return []
        command, rest = packet.data[0], packet.data[1:]
        status, data = OK, list[bytes]()
        if command == _RESET:
            self.reset()
        elif not rest:
            return []
        else:
            status, data = self._control(command, rest[0], rest[1:])
        return [echo(packet, bytes((command, rest[0] if rest else 0, status))), *data]

    def _control(self, command: int, ident: int, rest: bytes) -> tuple[int, list[bytes]]:
        block = self._blocks.get(ident)
        if command == _CREATE:
            if block is not None:
                return EEXIST, []
            if len(self._blocks) == MAX_BLOCKS:
                return ENOMEM, []
            # A block whose variables are refused stays, with those before the bad one.
            block = self._blocks[ident] = _Block(ident)
            return self._append(block, rest), []
        if command not in (_APPEND, _DELETE, _START, _STOP, _START_MS):
            return ENOEXEC, []
        if block is None:
            return ENOENT, []
        if command == _APPEND:
            return self._append(block, rest), []
        if command == _DELETE:
            del self._blocks[ident]
        elif command == _STOP:
            block.period = 0
        else:
            return self._start(block, rest, 10 if command == _START else 1)
        return OK, []

    def _append(self, block: _Block, data: bytes) -> int:
        for at in range(0, len(data) - _VARIABLE.size + 1, _VARIABLE.size):
            types, ident = _VARIABLE.unpack_from(data, at)
            ctype = LOG_TYPES.get(types & 0x0F)
            if ctype is None or ident >= len(self.entries):
                return ENOENT
            if block.size + ctype.size > MAX_BYTES:
                return E2BIG
            if sum(len(b.variables) for b in self._blocks.values()) == MAX_VARIABLES:
                return ENOMEM
            block.variables.append((ident, ctype))
            block.size += ctype.size
        return OK

    def _start(self, block: _Block, data: bytes, unit: int) -> tuple[int, list[bytes]]:
        size = 1 if unit == 10 else 2
        if len(data) < size:
            return ENOEXEC, []
        block.period = unit * int.from_bytes(data[:size], "little")
        block.due = self._now + block.period
        return OK, [] if block.period else [self._data(block, self._now)]
