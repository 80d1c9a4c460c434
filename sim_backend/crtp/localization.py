"""Port 6: external positions and poses, and what older clients send here."""

from __future__ import annotations

import math
import struct
from typing import Protocol

from crazyarena.sim_backend.crtp.packets import Packet
from crazyarena.sim_backend.crtp.setpoints import decompress_quaternion
from crazyarena.sim_backend.crtp.supervisor import Guard

_POSITION, _GENERIC, _PACKED_POSITIONS = range(3)
_EMERGENCY_STOP, _WATCHDOG, _POSE, _PACKED_POSES = 3, 4, 8, 9
_THREE = struct.Struct("<fff")
_SEVEN = struct.Struct("<fffffff")
_PACKED_POSITION = struct.Struct("<Bhhh")
_PACKED_POSE = struct.Struct("<BhhhI")
_LIMIT = 1e3  # m
_NORM_TOLERANCE = 0.1

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


class Locator(Protocol):
    """What takes external measurements; metres, world; quaternions x, y, z, w."""

    address: int

    def external_position(self, position: Vector) -> None: ...

    def external_pose(self, position: Vector, quaternion: Quaternion) -> None: ...

    def peer_position(self, peer: int, position: Vector) -> None: ...


class LocalizationService:
    """Port 6; nothing is answered.

    A measurement of the wrong length, with numbers that are not finite or a quaternion far from
    unit length is dropped. There is no other gate, as on the vehicle.
    """

    def __init__(self, locator: Locator, guard: Guard) -> None:
        self._locator = locator
        self._guard = guard

    def handle(self, packet: Packet) -> list[bytes]:
        data = packet.data
        if packet.channel == _POSITION:
            if len(data) == _THREE.size:
                self._position(_THREE.unpack(data))
        elif packet.channel == _PACKED_POSITIONS:
            self._packed_positions(data)
        elif packet.channel == _GENERIC and data:
            self._generic(data[0], data[1:])
        return []

    def _generic(self, kind: int, data: bytes) -> None:
        if kind == _EMERGENCY_STOP:
            self._guard.emergency_stop()
        elif kind == _WATCHDOG:
            self._guard.feed_watchdog()
        elif kind == _POSE and len(data) == _SEVEN.size:
            x, y, z, *quaternion = _SEVEN.unpack(data)
            self._pose((x, y, z), tuple(quaternion))
        elif kind == _PACKED_POSES and len(data) % _PACKED_POSE.size == 0:
            for ident, x, y, z, packed in _PACKED_POSE.iter_unpack(data):
                position = (1e-3 * x, 1e-3 * y, 1e-3 * z)
                if ident == self._own:
                    self._pose(position, tuple(decompress_quaternion(packed)))
                else:
                    self._locator.peer_position(ident, position)

    @property
    def _own(self) -> int:
        return self._locator.address & 0xFF

    def _packed_positions(self, data: bytes) -> None:
        if len(data) % _PACKED_POSITION.size:
            return
        for ident, x, y, z in _PACKED_POSITION.iter_unpack(data):
            position = (1e-3 * x, 1e-3 * y, 1e-3 * z)
            if ident == self._own:
                self._position(position)
            else:
                self._locator.peer_position(ident, position)

    def _position(self, position: tuple[float, ...]) -> None:
        if all(abs(value) < _LIMIT for value in position):
            x, y, z = position
            self._locator.external_position((x, y, z))

    def _pose(self, position: Vector, quaternion: tuple[float, ...]) -> None:
        norm = math.hypot(*quaternion)
        if abs(norm - 1.0) < _NORM_TOLERANCE and all(abs(value) < _LIMIT for value in position):
            x, y, z, w = quaternion
            self._locator.external_pose(position, (x, y, z, w))
