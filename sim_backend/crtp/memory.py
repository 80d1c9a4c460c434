"""Port 4: memories that a client reads and writes by address."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crazyarena.sim_backend.crtp.packets import EIO, ENOENT, OK, Packet, Port, reply
from crazyarena.sim_backend.firmware.planner import TRAJECTORY_MEMORY_SIZE

MAX_READ = 24
MAX_WRITE = 25

_INFO, _READ, _WRITE = range(3)
_COUNT, _DETAILS = 1, 2
_READ_REQUEST = struct.Struct("<BIB")
_WRITE_HEAD = struct.Struct("<BI")

EEPROM, ONE_WIRE, LED_RING, TRAJECTORY, TESTER, LED_TIMING, DECKS = (
    0x00,
    0x01,
    0x10,
    0x12,
    0x15,
    0x17,
    0x19,
)
LEDS = 12
_NO_SERIAL = bytes(8)


@dataclass(slots=True)
class Memory:
    """One memory: kind, contents, and the serial number that only 1-wire memories have.

    ``written`` is called after each write.
    """

    kind: int
    data: bytearray | NDArray[np.uint8]
    serial: bytes = _NO_SERIAL
    written: Callable[[], None] | None = None

    @property
    def size(self) -> int:
        return len(self.data)

    def read(self, address: int, length: int) -> bytes | None:
        """``length`` bytes, or None beyond the end."""
        if length > MAX_READ or address + length > self.size:
            return None
        return bytes(self.data[address : address + length])

    def write(self, address: int, data: bytes) -> bool:
        """Write; False beyond the end."""
        if address + len(data) > self.size:
            return False
        if isinstance(self.data, bytearray):
            self.data[address : address + len(data)] = data
        else:
            self.data[address : address + len(data)] = np.frombuffer(data, np.uint8)
        if self.written is not None:
            self.written()
        return True


class TesterMemory(Memory):
    """The memory by which the link is tested: holds its own addresses, counts wrong writes."""

    def __init__(self) -> None:
        super().__init__(TESTER, bytearray(0x1000))
        self.errors = 0

    def read(self, address: int, length: int) -> bytes | None:
        if length > MAX_READ or address + length > self.size:
            return None
        return bytes((address + k) & 0xFF for k in range(length))

    def write(self, address: int, data: bytes) -> bool:
        if address + len(data) > self.size:
            return False
        self.errors += sum(value != (address + k) & 0xFF for k, value in enumerate(data))
        return True


def eeprom(address: int, channel: int = 80, data_rate: int = 2) -> Memory:
    """Configuration memory, version 1.

    Parameters
    ----------
    address: 40-bit radio address. channel: 0..125. data_rate: 0, 1, 2 for 250k, 1M, 2M bit/s.
    """
    block = b"0xBC" + struct.pack(
        "<BBBffBI", 1, channel, data_rate, 0.0, 0.0, address >> 32, address & 0xFFFFFFFF
    )
    block += bytes((sum(block) % 256,))
    return Memory(EEPROM, bytearray(block.ljust(0x1FFF, b"\xff")))


def one_wire(number: int, vendor: int, product: int, name: str, revision: str) -> Memory:
    """Memory on an expansion deck: who made it, what it is.

    Both halves end with the low byte of their CRC-32.
    """
    head = struct.pack("<BIBB", 0xEB, 0, vendor, product)
    elements = b"".join(
        bytes((key, len(text))) + text.encode("latin-1") for key, text in ((2, revision), (1, name))
    )
    body = bytes((0, len(elements))) + elements
    image = b"".join(part + bytes((zlib.crc32(part) & 0xFF,)) for part in (head, body))
    serial = bytes((0x0D, number)) + bytes(6)
    return Memory(ONE_WIRE, bytearray(image.ljust(112, b"\xff")), serial)


def deck_list() -> Memory:
    """List of decks with a firmware of their own: version 3, eight empty places."""
    return Memory(DECKS, bytearray(b"\x03".ljust(0x1100, b"\x00")))


class MemoryService:
    """Answers on port 4; a memory's id is its position."""

    def __init__(self, memories: Sequence[Memory]) -> None:
        self.memories = list(memories)

    def handle(self, packet: Packet) -> list[bytes]:
        try:
            answer = self._answer(packet.channel, packet.data)
        except struct.error:
            return []
        return [] if answer is None else [reply(Port.MEMORY, packet.channel, answer)]

    def _answer(self, channel: int, data: bytes) -> bytes | None:
        if channel == _INFO:
            return self._info(data)
        if channel == _READ:
            ident, address, length = _READ_REQUEST.unpack_from(data)
            head = data[: _WRITE_HEAD.size]
            if ident >= len(self.memories):
                return head + bytes((ENOENT,))
            content = self.memories[ident].read(address, length)
            return head + (bytes((EIO,)) if content is None else bytes((OK,)) + content)
        if channel == _WRITE:
            ident, address = _WRITE_HEAD.unpack_from(data)
            head, content = data[: _WRITE_HEAD.size], data[_WRITE_HEAD.size :]
            if ident >= len(self.memories):
                return head + bytes((ENOENT,))
            done = self.memories[ident].write(address, content)
            return head + bytes((OK if done else EIO,))
        return None

    def _info(self, data: bytes) -> bytes | None:
        if data[:1] == bytes((_COUNT,)):
            return bytes((_COUNT, len(self.memories)))
        if data[:1] == bytes((_DETAILS,)) and len(data) >= 2:
            if data[1] >= len(self.memories):
                return data[:2]
            memory = self.memories[data[1]]
            return data[:2] + struct.pack("<BI", memory.kind, memory.size) + memory.serial
        return None


def trajectory(data: NDArray[np.uint8]) -> Memory:
    """The trajectory memory of the high-level commander; shares its bytes."""
    assert len(data) == TRAJECTORY_MEMORY_SIZE
    return Memory(TRAJECTORY, data)
