"""Port 13: versions, and the commands that older clients send here."""

from __future__ import annotations

import struct

from crazyarena.sim_backend.crtp.packets import Packet, echo
from crazyarena.sim_backend.crtp.supervisor import Guard
from crazyarena.sim_backend.crtp.toc import protocol_version

FIRMWARE_VERSION = "2026.08"

_COMMAND, _VERSION = 0, 1
_ARM, _RECOVER = 1, 2
_PROTOCOL, _FIRMWARE, _DEVICE = 0, 1, 2


class PlatformService:
    """Answers on port 13; the application channel is empty."""

    def __init__(self, guard: Guard, device: str) -> None:
        self._guard = guard
        self._versions = {
            _PROTOCOL: struct.pack("<I", protocol_version()),
            _FIRMWARE: FIRMWARE_VERSION.encode(),
            _DEVICE: device.encode(),
        }

    def handle(self, packet: Packet) -> list[bytes]:
        if not packet.data:
            return []
        command = packet.data[0]
        if packet.channel == _VERSION:
            version = self._versions.get(command)
            return [] if version is None else [echo(packet, packet.data[:1] + version)]
        if packet.channel != _COMMAND:
            return []
        # This generation's length leaves out the second byte that its documentation promises.
        if command == _ARM:
            if len(packet.data) < 2:
                return []
            done = self._guard.arm(packet.data[1] != 0)
            return [echo(packet, bytes((command, done)))]
        if command == _RECOVER:
            return [echo(packet, bytes((command, self._guard.recover())))]
        return [echo(packet, packet.data)]
