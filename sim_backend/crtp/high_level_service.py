"""Port 8: the high-level commander's commands, straight to its kernels."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from typing import Any

from crazyarena.sim_backend.crtp.packets import ENOEXEC, OK, Packet, echo
from crazyarena.sim_backend.firmware import high_level as hl

_TRAJECTORY_IN_MEMORY = 1
_ANSWER_BYTES = 4
_TAKEOFF_2 = 7


class HighLevelService:
    """Answers on port 8.

    Parameters
    ----------
    rows: the vehicle's memory (planner, its parameters, trajectories).
    now: firmware time, s.
    """

    def __init__(self, rows: Any, now: Callable[[], float]) -> None:
        self._planner = rows.high_level
        self._params = rows.high_level_params
        self._trajectories = rows.trajectories
        self._now = now

    def handle(self, packet: Packet) -> list[bytes]:
        data = packet.data
        if packet.channel != 0 or not data:
            return []
        layout, command = _COMMANDS.get(data[0], (None, None))
        status = ENOEXEC
        if data[0] == _TAKEOFF_2 and layout is not None and len(data) == layout.size:
            # The firmware takes one whose last byte is missing, and reads what lies there.
            data += b"\0"
        if layout is not None and command is not None and len(data) == 1 + layout.size:
            values = layout.unpack_from(data, 1)
            if all(math.isfinite(value) for value in values):
                status = int(command(self, *values))
        # Shorter requests leave bytes of an earlier packet in this place; here they are zero.
        head = data[: _ANSWER_BYTES - 1].ljust(_ANSWER_BYTES - 1, b"\0")
        return [echo(packet, head + bytes((status & 0xFF,)))]

    def _addressed(self, group: int) -> bool:
        return bool(hl.in_group(self._params, int(group)))

    def _group_mask(self, mask: int) -> int:
        return hl.set_group_mask(self._params, int(mask))

    def _vertical(self, kernel, group, height, yaw, keep_yaw, duration) -> int:
        if not self._addressed(group):
            return OK
        return kernel(self._planner, height, duration, yaw, bool(keep_yaw), self._now())

    def _takeoff(self, group: int, height: float, duration: float) -> int:
        return self._vertical(hl.takeoff, group, height, 0.0, False, duration)

    def _land(self, group: int, height: float, duration: float) -> int:
        return self._vertical(hl.land, group, height, 0.0, False, duration)

    def _takeoff_2(self, *values: Any) -> int:
        return self._vertical(hl.takeoff, *values)

    def _land_2(self, *values: Any) -> int:
        return self._vertical(hl.land, *values)

    def _at_velocity(self, kernel, group, height, relative, yaw, keep_yaw, velocity) -> int:
        if not self._addressed(group):
            return OK
        return kernel(
            self._planner,
            self._params,
            height,
            bool(relative),
            velocity,
            yaw,
            bool(keep_yaw),
            self._now(),
        )

    def _takeoff_at(self, *values: Any) -> int:
        return self._at_velocity(hl.takeoff_with_velocity, *values)

    def _land_at(self, *values: Any) -> int:
        return self._at_velocity(hl.land_with_velocity, *values)

    def _stop(self, group: int) -> int:
        return hl.stop(self._planner) if self._addressed(group) else OK

    def _go_to(self, group, relative, x, y, z, yaw, duration) -> int:
        return self._go_to_2(group, relative, 0, x, y, z, yaw, duration)

    def _go_to_2(self, group, relative, linear, x, y, z, yaw, duration) -> int:
        if not self._addressed(group):
            return OK
        return hl.go_to(
            self._planner,
            self._trajectories,
            x,
            y,
            z,
            yaw,
            duration,
            bool(relative),
            bool(linear),
            self._now(),
        )

    def _spiral(self, group, sideways, clockwise, angle, r0, r1, climb, duration) -> int:
        if not self._addressed(group):
            return OK
        return hl.spiral(
            self._planner,
            bool(sideways),
            bool(clockwise),
            angle,
            r0,
            r1,
            climb,
            duration,
            self._now(),
        )

    def _define(self, ident, location, kind, offset, pieces) -> int:
        if location != _TRAJECTORY_IN_MEMORY:
            return ENOEXEC
        return hl.define_trajectory(self._planner, ident, kind, offset, pieces)

    def _start(self, group, relative, reverse, ident, scale) -> int:
        return self._start_2(group, relative, 0, reverse, ident, scale)

    def _start_2(self, group, relative, relative_yaw, reverse, ident, scale) -> int:
        if not self._addressed(group):
            return OK
        return hl.start_trajectory(
            self._planner,
            self._trajectories,
            ident,
            scale,
            bool(relative),
            bool(relative_yaw),
            bool(reverse),
            self._now(),
        )


_COMMANDS: dict[int, tuple[struct.Struct, Callable[..., int]]] = {
    number: (struct.Struct("<" + layout), command)
    for number, layout, command in (
        (0, "B", HighLevelService._group_mask),
        (1, "Bff", HighLevelService._takeoff),
        (2, "Bff", HighLevelService._land),
        (3, "B", HighLevelService._stop),
        (4, "BBfffff", HighLevelService._go_to),
        (5, "BBBBf", HighLevelService._start),
        (6, "BBBIB", HighLevelService._define),
        (7, "Bff?f", HighLevelService._takeoff_2),
        (8, "Bff?f", HighLevelService._land_2),
        (9, "Bf?f?f", HighLevelService._takeoff_at),
        (10, "Bf?f?f", HighLevelService._land_at),
        (11, "BBBfffff", HighLevelService._spiral),
        (12, "BBBfffff", HighLevelService._go_to_2),
        (13, "BBBBBf", HighLevelService._start_2),
    )
}
