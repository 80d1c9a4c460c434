"""Gamepads through the Linux joystick interface (``/dev/input/js*``), without a library.

Layout of the events: kernel documentation, "Joystick API" (``struct js_event``).
"""

from __future__ import annotations

import os
import struct
from pathlib import Path

_EVENT = struct.Struct("=IhBB")  # time ms, value, type, number
_BUTTON, _AXIS, _INIT = 0x01, 0x02, 0x80
_FULL_SCALE = 32767.0


class Joystick:
    """Reads one or more joysticks; each is opened by its number."""

    name = "linuxjsdev"

    def __init__(self, folder: str | Path = "/dev/input") -> None:
        self._folder = Path(folder)
        self._files: dict[int, int] = {}
        self._axes: dict[int, dict[int, float]] = {}
        self._buttons: dict[int, dict[int, int]] = {}

    def devices(self) -> list[dict[str, object]]:
        """``[{"id": 0, "name": "js0"}, ...]``, lowest number first."""
        found = []
        for path in self._folder.glob("js*"):
            if path.name[2:].isdigit():
                found.append({"id": int(path.name[2:]), "name": path.name})
        return sorted(found, key=lambda device: device["id"])  # type: ignore[arg-type, return-value]

    def open(self, device_id: int) -> None:
        """Start reading a device; OSError if that is not allowed."""
        path = self._folder / f"js{device_id}"
        self._files[device_id] = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        self._axes[device_id] = {}
        self._buttons[device_id] = {}

    def close(self, device_id: int) -> None:
        """Stop reading a device."""
        os.close(self._files.pop(device_id))

    def read(self, device_id: int) -> tuple[list[float], list[int]]:
        """Axes (-1..1) and buttons (0 or 1) as they are now."""
        axes, buttons = self._axes[device_id], self._buttons[device_id]
        while True:
            try:
                data = os.read(self._files[device_id], _EVENT.size)
            except BlockingIOError:
                break
            if len(data) < _EVENT.size:
                break
            _, value, kind, number = _EVENT.unpack(data)
            if kind & ~_INIT == _AXIS:
                axes[number] = value / _FULL_SCALE
            elif kind & ~_INIT == _BUTTON:
                buttons[number] = value
        return (
            [axes.get(k, 0.0) for k in range(max(axes, default=-1) + 1)],
            [buttons.get(k, 0) for k in range(max(buttons, default=-1) + 1)],
        )
