"""The newest value of something, handed from one process to others through shared memory.

The writer never waits and never learns who reads. A reader gets the newest whole value or none;
what was overwritten meanwhile is gone. A sequence number that is odd while a value is being
written (a seqlock) and a checksum keep a reader from taking a torn one.
"""

from __future__ import annotations

import mmap
import struct
import zlib

from crazyarena.errors import InputError

_SEQUENCE = struct.Struct("<Q")
_VALUE = struct.Struct("<QI")  # length, CRC-32
HEAD = 24
"""Bytes a slot takes besides its value."""
_TRIES = 8


class Slot:
    """One value of up to ``size`` bytes, at ``offset`` of a shared map; one writer at a time."""

    def __init__(self, memory: mmap.mmap, offset: int, size: int) -> None:
        if offset % 8:
            raise InputError(f"slot: offset {offset} is no multiple of 8")
        self._memory = memory
        self._offset = offset
        self.size = size

    @property
    def version(self) -> int:
        """Rises with every value; 0 before the first."""
        (sequence,) = _SEQUENCE.unpack_from(self._memory, self._offset)
        return int(sequence) // 2

    def put(self, value: bytes) -> None:
        """Replace the value; raises InputError if it is longer than ``size``."""
        if len(value) > self.size:
            raise InputError(f"slot: {len(value)} bytes; at most {self.size} fit")
        memory, offset = self._memory, self._offset
        (sequence,) = _SEQUENCE.unpack_from(memory, offset)
        sequence |= 1  # also after a writer that died while it wrote
        _SEQUENCE.pack_into(memory, offset, sequence)
        _VALUE.pack_into(memory, offset + 8, len(value), zlib.crc32(value))
        memory[offset + HEAD : offset + HEAD + len(value)] = value
        _SEQUENCE.pack_into(memory, offset, sequence + 1)

    def get(self) -> bytes | None:
        """The newest value; None if there is none, or it is being written all the time."""
        memory, offset = self._memory, self._offset
        for _ in range(_TRIES):
            (before,) = _SEQUENCE.unpack_from(memory, offset)
            if before == 0:
                return None
            if before % 2:
                continue
            length, checksum = _VALUE.unpack_from(memory, offset + 8)
            value = bytes(memory[offset + HEAD : offset + HEAD + min(length, self.size)])
            (after,) = _SEQUENCE.unpack_from(memory, offset)
            if before == after and zlib.crc32(value) == checksum:
                return value
        return None
