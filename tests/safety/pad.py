"""A gamepad that tests press."""

from __future__ import annotations

import os
import select
import struct
from collections.abc import Iterator
from types import SimpleNamespace


class Pad:
    """What evdev's InputDevice looks like, fed through a pipe."""

    name = "pad of the test"

    def __init__(self) -> None:
        self.fd, self._write = os.pipe()

    def press(self, code: int, value: int) -> None:
        os.write(self._write, struct.pack("HHi", 1, code, value))

    def read(self) -> Iterator[SimpleNamespace]:
        ready, _, _ = select.select([self.fd], [], [], 0)
        data = os.read(self.fd, 8) if ready else b""
        if not data:
            raise OSError("unplugged")
        kind, code, value = struct.unpack("HHi", data)
        yield SimpleNamespace(type=kind, code=code, value=value)

    def unplug(self) -> None:
        os.close(self._write)

    def close(self) -> None:
        os.close(self.fd)
