"""The UDP end of one virtual vehicle: a socket, a client, and the faults in between."""

from __future__ import annotations

import random
import socket
from typing import Any

from crazyarena.errors import InputError
from crazyarena.sim_backend.crtp.faults import Channel, Faults
from crazyarena.sim_backend.crtp.packets import NULL_PACKET

BASE_PORT = 19850
SCANNED_PORTS = 10  # a client looks for vehicles on so many ports from BASE_PORT on
_BURST = 64  # datagrams read at a time, so that one vehicle cannot starve the others
_BUFFER = 2048


class UdpLink:
    """One vehicle's socket.

    Datagrams go to whoever sent last; a scanning probe is answered but does not make its sender
    the client.

    Parameters
    ----------
    host, port: where to listen; port 0 takes a free one.
    faults: between the socket and the vehicle.
    seed: of the faults' randomness.

    Raises
    ------
    InputError: the port cannot be listened on.
    """

    def __init__(self, host: str, port: int, faults: Faults, seed: int = 0) -> None:
        self.faults = faults
        self.uplink = Channel(faults, random.Random(2 * seed))
        self.downlink = Channel(faults, random.Random(2 * seed + 1))
        self._client: Any = None
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            self._socket.bind((host, port))
        except OSError as error:
            self._socket.close()
            raise InputError(
                f"virtual Crazyflie: cannot listen on {host}:{port} ({error.strerror}); "
                "is another one running? choose another --port"
            ) from None

    @property
    def port(self) -> int:
        """Port it listens on."""
        return int(self._socket.getsockname()[1])

    @property
    def uri(self) -> str:
        """What a client opens."""
        host, port = self._socket.getsockname()[:2]
        return f"udp://{host}:{port}"

    def fileno(self) -> int:
        """For a selector."""
        return self._socket.fileno()

    def receive(self, now: float) -> list[tuple[bytes, Any]]:
        """Datagrams that have reached the vehicle, with their senders."""
        for _ in range(_BURST):
            try:
                datagram, sender = self._socket.recvfrom(_BUFFER)
            except BlockingIOError:
                break
            except OSError:
                # A client that went away; the next datagram may be another's.
                continue
            if datagram != NULL_PACKET:
                self._client = sender
            self.uplink.send(datagram, sender, now)
        return self.uplink.take(now)

    def send(self, datagram: bytes, now: float, receiver: Any = None) -> None:
        """Send to ``receiver``, or to the client if there is one."""
        receiver = self._client if receiver is None else receiver
        if receiver is not None:
            self.downlink.send(datagram, receiver, now)

    def flush(self, now: float) -> None:
        """Put on the wire what has come through."""
        for datagram, receiver in self.downlink.take(now):
            try:
                self._socket.sendto(datagram, receiver)
            except OSError:
                # Full buffer, or nobody there any more: lost, as on a radio.
                self.downlink.counters.lost += 1

    def due(self) -> float:
        """When the next datagram under way arrives, s; inf if none."""
        return min(self.uplink.due(), self.downlink.due())

    def boots(self) -> bool:
        """Whether somebody has switched the vehicle on over the link: UDP knows no power."""
        return False

    def reboot(self, now: float) -> None:
        """The vehicle was switched off and on; its client is still its client."""

    def report(self) -> str:
        """What was received and sent, in words."""
        up, down = self.uplink.counters, self.downlink.counters
        return (
            f"received {up.carried} (lost {up.lost}, repeated {up.repeated}, cut {up.cut}), "
            f"sent {down.carried} (lost {down.lost}, repeated {down.repeated}, cut {down.cut})"
        )

    def close(self) -> None:
        self._socket.close()
