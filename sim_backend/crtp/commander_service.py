"""Ports 3 and 7: streamed setpoints."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np

from crazyarena.sim_backend.crtp.packets import Packet, Port
from crazyarena.sim_backend.crtp.setpoints import RpytDecoder, decode_notify, decode_setpoint

_SETPOINT, _META = 0, 1
_RPYT_BYTES = 14
_CPPM = 3
# Payload by type. The firmware stops with a failed assertion on any other length.
_BYTES = {0: 1, 1: 17, 2: 17, 4: 17, 5: 17, 6: 29, 7: 17, 8: 17, 9: 17, 10: 17, 11: 16}
# Nothing on a vehicle has a setpoint beyond this, in any of the units; garbage does.
_LIMIT = 1e5


class Pilot(Protocol):
    """What takes setpoints."""

    def priority(self) -> int:
        """Priority in force, 0 when no source is active."""
        ...

    def yaw_angle(self) -> bool:
        """Whether the legacy setpoint says a heading, and not its rate."""
        ...

    def offer(self, row: np.ndarray) -> None:
        """Take a setpoint row (see :mod:`.firmware.layout`)."""
        ...

    def notify_setpoints_stop(self) -> None: ...


class CommanderService:
    """Port 3 and 7; nothing is answered.

    A packet of the wrong length or with a number that is not finite is dropped, an unknown type
    is a null setpoint as on the vehicle.
    """

    def __init__(self, pilot: Pilot) -> None:
        self._pilot = pilot
        self.rpyt = RpytDecoder()

    def handle(self, packet: Packet) -> list[bytes]:
        decode: Callable[[Packet], np.ndarray | None]
        decode = self._rpyt if packet.port == Port.SETPOINT else self._generic
        row = decode(packet)
        if row is not None and np.all(np.abs(row) < _LIMIT):
            self._pilot.offer(row)
        return []

    def _rpyt(self, packet: Packet) -> np.ndarray | None:
        if packet.channel != 0 or len(packet.data) != _RPYT_BYTES:
            return None
        pilot = self._pilot
        return self.rpyt.decode(packet.data, pilot.priority(), pilot.yaw_angle())

    def _generic(self, packet: Packet) -> np.ndarray | None:
        data = packet.data
        if packet.channel == _META:
            if len(data) == 5 and decode_notify(data) is not None:
                self._pilot.notify_setpoints_stop()
            return None
        if packet.channel != _SETPOINT or not data:
            return None
        kind = data[0]
        if kind == _CPPM:
            if len(data) < 2 or len(data) != 10 + 2 * (data[1] & 0x0F):
                return None
        elif len(data) != _BYTES.get(kind, len(data)):
            return None
        return decode_setpoint(data)
