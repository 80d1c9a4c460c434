"""Port 9: the state of the supervisor, arming, recovery, emergency stop and its watchdog."""

from __future__ import annotations

from typing import Protocol

from crazyarena.sim_backend.crtp.packets import Packet, Port, reply

_INFO, _COMMAND = 0, 1
_FIELD = 0x0C
_ARM, _RECOVER, _STOP, _WATCHDOG = 1, 2, 3, 4
_ANSWER = 0x80


class Guard(Protocol):
    """The supervisor of a vehicle."""

    def info(self) -> int:
        """Bit field of ``supervisor.info``."""
        ...

    def is_armed(self) -> bool: ...

    def arm(self, arm: bool) -> bool:
        """Ask to arm or disarm; True when so afterwards."""
        ...

    def recover(self) -> bool:
        """Ask for recovery from a crash; True when not crashed afterwards."""
        ...

    def emergency_stop(self) -> None: ...

    def feed_watchdog(self) -> None: ...


class SupervisorService:
    """Answers on port 9."""

    def __init__(self, guard: Guard) -> None:
        self._guard = guard

    def handle(self, packet: Packet) -> list[bytes]:
        if not packet.data:
            return []
        command = packet.data[0]
        answer = b""
        if packet.channel == _INFO:
            if command == _FIELD:
                answer = self._guard.info().to_bytes(2, "little")
            elif 0 < command < _FIELD:
                answer = bytes((self._guard.info() >> (command - 1) & 1,))
        elif packet.channel == _COMMAND:
            answer = self._command(command, packet.data[1:])
        if not answer:
            return []
        return [reply(Port.SUPERVISOR, packet.channel, bytes((_ANSWER | command,)) + answer)]

    def _command(self, command: int, rest: bytes) -> bytes:
        if command == _ARM and rest:
            done = self._guard.arm(rest[0] != 0)
            return bytes((done, self._guard.is_armed()))
        if command == _RECOVER:
            done = self._guard.recover()
            return bytes((done, done))
        if command == _STOP:
            self._guard.emergency_stop()
        elif command == _WATCHDOG:
            self._guard.feed_watchdog()
        return b""
