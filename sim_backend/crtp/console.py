"""Port 0: text that the vehicle prints."""

from __future__ import annotations

from collections import deque

from crazyarena.sim_backend.crtp.packets import MAX_PAYLOAD, Packet, Port, reply


class ConsoleService:
    """Collects text and sends it by whole lines, or 30 bytes."""

    def __init__(self) -> None:
        self._line = b""
        self._packets: deque[bytes] = deque()

    def write(self, text: str) -> None:
        """Print text; what has no newline yet waits for it."""
        self._line += text.encode("latin-1", "replace")
        while b"\n" in self._line or len(self._line) >= MAX_PAYLOAD:
            end = self._line.find(b"\n") + 1 or MAX_PAYLOAD
            end = min(end, MAX_PAYLOAD)
            self._packets.append(reply(Port.CONSOLE, 0, self._line[:end]))
            self._line = self._line[end:]

    def take(self) -> list[bytes]:
        """Datagrams that are ready."""
        packets = list(self._packets)
        self._packets.clear()
        return packets

    def handle(self, packet: Packet) -> list[bytes]:
        return []
