"""A VRPN tracker server that needs no cameras: each body is a tracker of its own.

:mod:`crazyarena.mocap.vrpn_wire` has the layouts.
"""

from __future__ import annotations

import socket
from collections.abc import Sequence

from crazyarena.errors import InputError
from crazyarena.mocap import vrpn_wire as wire
from crazyarena.mocap.tcp_clients import TcpClients
from crazyarena.mocap.vrpn_wire import DEFAULT_PORT
from crazyarena.types import Pose, PoseFrame

_TYPES = (wire.POS_QUAT, wire.PING, wire.PONG)
_POS_QUAT, _, _PONG = range(3)
# Poses in one datagram, if they are sent together: what an Ethernet frame holds.
_BUNDLE = 16


def pack_pose(number: int, pose: Pose, time: float, sequence: int) -> bytes:
    """Return the pose of sender ``number``."""
    body = wire.POSE.pack(0, 0, *pose.position.tolist(), *pose.quaternion.tolist())
    return wire.pack(_POS_QUAT, number, body, time, sequence)


class _Client:
    def __init__(self, connection: socket.socket, peer: str) -> None:
        self.connection = connection
        self.peer = peer
        self.stream = wire.Stream()
        self.greeted = False
        self.udp: tuple[str, int] | None = None
        self.types: dict[int, str] = {}
        self.senders: dict[int, str] = {}


class VrpnServer(TcpClients[_Client]):
    """Serve pose frames as a VRPN server with one tracker per body.

    Parameters
    ----------
    bodies: names of the trackers.
    port: TCP and UDP port; 0 for any free one.
    host: address to listen on.
    bundled: send the poses of a frame in one datagram, as some servers do, instead of one each.

    Call :meth:`publish` for every frame; bodies that are not in it send nothing. One thread
    answers the clients. A context manager.
    """

    def __init__(
        self,
        bodies: Sequence[str],
        port: int = DEFAULT_PORT,
        host: str = "127.0.0.1",
        bundled: bool = False,
    ) -> None:
        super().__init__(*_free_pair(host, port))
        self.bodies = tuple(bodies)
        self.sent = 0
        self._numbers = {name: i for i, name in enumerate(self.bodies)}
        self._bundled = bundled
        self.port: int = self._listener.getsockname()[1]
        self._others[self._udp] = self._call_back
        self._start("vrpn-server")

    @property
    def clients(self) -> int:
        """Number of clients that receive poses now."""
        with self._lock:
            return sum(client.greeted for client in self._clients)

    def publish(self, frame: PoseFrame) -> None:
        """Send one frame, a message a body, stamped with the frame's time."""
        with self._lock:
            if not self._clients:
                return
            messages = []
            for name, pose in frame.bodies.items():
                number = self._numbers.get(name)
                if number is not None:
                    self.sent += 1
                    messages.append(pack_pose(number, pose, frame.timestamp, self.sent))
            step = _BUNDLE if self._bundled else 1
            packets = [b"".join(messages[i : i + step]) for i in range(0, len(messages), step)]
            for client in list(self._clients):
                if client.greeted:
                    self._send(client, packets)

    def _send(self, client: _Client, packets: list[bytes]) -> None:
        try:
            for packet in packets:
                if client.udp is not None:
                    self._udp.sendto(packet, client.udp)
                else:
                    client.connection.sendall(packet)
        except OSError:
            self._drop(client)

    def _call_back(self) -> None:
        """Connect to a client that asked for it, at the address its datagram came from."""
        try:
            text, (address, _) = self._udp.recvfrom(256)
            words = text.rstrip(b"\0").split()
            # Connecting to an address somebody writes down would let him aim us at others.
            connection = socket.create_connection((address, int(words[1])), timeout=0.5)
        except (OSError, ValueError, IndexError, OverflowError):
            return
        self._welcome(connection, address)

    def _make(self, connection: socket.socket, peer: str) -> _Client:
        return _Client(connection, peer)

    def _greet(self, client: _Client) -> None:
        client.connection.sendall(wire.COOKIE)

    def _heard(self, client: _Client, received: bytes) -> None:
        try:
            for message in client.stream.feed(received):
                self._answer(client, message)
        except wire.VrpnError:
            self._drop(client)
            return
        if client.stream.greeted and not client.greeted:
            self._describe(client)

    def _describe(self, client: _Client) -> None:
        for number, name in enumerate(_TYPES):
            client.connection.sendall(wire.pack_description(wire.TYPE, number, name))
        for number, name in enumerate(self.bodies):
            client.connection.sendall(wire.pack_description(wire.SENDER, number, name))
        client.greeted = True

    def _answer(self, client: _Client, message: wire.Message) -> None:
        if message.kind in (wire.SENDER, wire.TYPE):
            names = client.senders if message.kind == wire.SENDER else client.types
            if len(names) < wire.MAX_NAMES:
                names[message.sender] = wire.described(message)
        elif message.kind == wire.UDP and 0 < message.sender < 65536:
            # To where the connection comes from, whatever address the message names.
            client.udp = (client.peer, message.sender)
        elif client.types.get(message.kind) == wire.PING:
            number = self._numbers.get(client.senders.get(message.sender, ""))
            if number is not None:
                client.connection.sendall(wire.pack(_PONG, number, b""))


def _free_pair(host: str, port: int) -> tuple[socket.socket, socket.socket]:
    """A TCP listener and a UDP socket of one number; raises InputError if it is taken."""
    tries = 1 if port else 20
    for attempt in range(tries):
        listener = socket.socket()
        datagrams = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind((host, port))
            datagrams.bind((host, listener.getsockname()[1]))
        except OSError as error:
            listener.close()
            datagrams.close()
            if attempt + 1 == tries:
                raise InputError(f"mocap server: port {port} on {host}: {error}") from None
        else:
            listener.listen()
            return listener, datagrams
    raise AssertionError("unreachable")
