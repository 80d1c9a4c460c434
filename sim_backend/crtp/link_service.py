"""Port 15: echo, source and sink, by which a client measures the link and knows the vehicle."""

from __future__ import annotations

from crazyarena.sim_backend.crtp.packets import MAX_PAYLOAD, Packet, echo

_ECHO, _SOURCE = 0, 1
_IDENTITY = b"Bitcraze Crazyflie".ljust(MAX_PAYLOAD, b"\x00")


class LinkService:
    """Answers echo with the same packet and source with the identity; sinks the rest."""

    def handle(self, packet: Packet) -> list[bytes]:
        if packet.channel == _ECHO:
            return [echo(packet, packet.data)]
        if packet.channel == _SOURCE:
            return [echo(packet, _IDENTITY)]
        return []
