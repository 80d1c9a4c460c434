"""An OptiTrack Motive that needs no cameras: NatNet, served from ours.

:mod:`crazyarena.mocap.natnet_wire` has the layouts.
"""

from __future__ import annotations

import math
import select
import socket
import struct
import threading
import time
from collections.abc import Mapping, Sequence

import numpy as np

from crazyarena.errors import InputError
from crazyarena.mocap import natnet_wire as wire
from crazyarena.mocap.frames import points_to_y_up, pose_to_y_up
from crazyarena.mocap.rotations import rotate
from crazyarena.types import PoseFrame, Vector

COMMAND_PORT = 1510
GROUP = "239.255.42.99"
# A unicast client that is silent for so long gets nothing more, s.
_SUBSCRIPTION = 10.0
# Markers of a body if none are given: an arrangement without symmetry, m.
_MARKERS = np.array([[0.03, 0.0, 0.01], [-0.03, 0.01, 0.01], [0.0, -0.03, 0.02]])


class NatNetServer:
    """Serve pose frames as Motive would.

    Parameters
    ----------
    bodies: names of the rigid bodies; their streaming ids are 1, 2, ...
    port: command port; 0 for any free one.
    host: address to listen on and to send from.
    version: bit stream: ``3.1``, ``4.0``, ``4.1`` or ``4.2``.
    multicast: send to a group. Else frames go to the data port of every host that connected,
        and to every client that says to be alive, until it was silent for 10 s.
    group: multicast group. data_port: where the group's members, and such hosts, listen; 0 for
        any free one.
    y_up: stream Motive's default axes, else z up.
    markers: places of each body's markers in its frame, (k, 3), m; three each by default.

    Call :meth:`publish` for every frame; its markers are streamed as unlabelled ones. One thread
    answers commands. A context manager.

    Raises
    ------
    InputError: unknown version, or a port that is taken.
    """

    def __init__(
        self,
        bodies: Sequence[str],
        port: int = COMMAND_PORT,
        host: str = "127.0.0.1",
        version: str = "4.1",
        multicast: bool = False,
        group: str = GROUP,
        data_port: int = 0,
        y_up: bool = False,
        markers: Mapping[str, Vector] | None = None,
    ) -> None:
        known = {".".join(map(str, v)): v for v in wire.VERSIONS}
        if version not in known:
            raise InputError(f"NatNet version: found {version!r}; choose one of {', '.join(known)}")
        self.bodies = tuple(bodies)
        self.sent = 0
        self._version = known[version]
        self._y_up = y_up
        self._markers = {name: (markers or {}).get(name, _MARKERS) for name in self.bodies}
        self._group = group if multicast else None
        self._lock = threading.Lock()
        self._clients: dict[tuple[str, int], float] = {}
        self._last = b""
        self._number = 0
        self._commands = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._data = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._commands.bind((host, port))
            self._data.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(host))
            self._data.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_LOOP, 1)
            self._data.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 1)
            self.data_port = data_port or _free_udp_port(host)
        except OSError as error:
            self._commands.close()
            self._data.close()
            raise InputError(f"mocap server: port {port} on {host}: {error}") from None
        self.port: int = self._commands.getsockname()[1]
        self._wake, self._waker = socket.socketpair()
        self._closed = False
        self._thread = threading.Thread(target=self._serve, name="natnet-server", daemon=True)
        self._thread.start()

    @property
    def clients(self) -> int:
        """Number of unicast clients that receive frames now."""
        oldest = time.monotonic() - _SUBSCRIPTION
        with self._lock:
            return sum(heard >= oldest for heard in self._clients.values())

    def publish(self, frame: PoseFrame) -> None:
        """Send one frame; ids and times go along."""
        bodies = {n: p for n, p in frame.bodies.items() if n in self._markers}
        labelled = {}
        for name, places in self._markers.items():
            pose = bodies.get(name)
            labelled[name] = (
                places if pose is None else pose.position + rotate(pose.quaternion, places)
            )
        loose = frame.markers
        if self._y_up:
            bodies = {name: pose_to_y_up(pose) for name, pose in bodies.items()}
            labelled = {name: points_to_y_up(places) for name, places in labelled.items()}
            loose = points_to_y_up(loose) if len(loose) else loose
        packet = wire.frame(self._version, frame.frame_id, frame.timestamp, bodies, labelled, loose)
        with self._lock:
            self._last = packet
            if self._closed:
                return
            if self._group is not None:
                self._send(self._data, packet, (self._group, self.data_port))
                return
            oldest = time.monotonic() - _SUBSCRIPTION
            for address, heard in list(self._clients.items()):
                if heard < oldest:
                    del self._clients[address]
                else:
                    self._send(self._commands, packet, address)

    def _send(self, sock: socket.socket, packet: bytes, address: tuple[str, int]) -> None:
        try:
            sock.sendto(packet, address)
            self.sent += 1
        except OSError:
            # Nobody there any more, or no room: a camera system does not wait either.
            self._clients.pop(address, None)

    def _serve(self) -> None:
        while not self._closed:
            ready, _, _ = select.select([self._commands, self._wake], [], [], 1.0)
            if self._commands not in ready:
                continue
            try:
                data, address = self._commands.recvfrom(4096)
            except OSError:
                continue
            with self._lock:
                answer = self._answer(data, address)
                if answer:
                    try:
                        self._commands.sendto(answer, address)
                    except OSError:
                        self._clients.pop(address, None)

    def _answer(self, data: bytes, address: tuple[str, int]) -> bytes:
        message = wire.message_of(data)
        if message == wire.KEEP_ALIVE:
            self._clients[address] = time.monotonic()
        if message == wire.CONNECT:
            # Simple clients only listen from now on, and never tell that they are there.
            self._clients[address[0], self.data_port] = math.inf
            return wire.server_info(self._version, self.data_port, self._group)
        if message == wire.REQUEST_MODELS:
            own = self._markers
            if self._y_up:
                own = {name: points_to_y_up(places) for name, places in own.items()}
            return wire.models(self._version, own)
        if message == wire.REQUEST_FRAME:
            return self._last
        if message == wire.REQUEST:
            return wire.packet(wire.RESPONSE, struct.pack("<i", 0))
        if message in (wire.KEEP_ALIVE, None):
            return b""
        return wire.packet(wire.UNRECOGNISED)

    def close(self) -> None:
        """Stop; idempotent."""
        if self._closed:
            return
        with self._lock:
            self._closed = True
        self._waker.send(b"\0")
        self._thread.join(timeout=2.0)
        for sock in (self._commands, self._data, self._wake, self._waker):
            sock.close()

    def __enter__(self) -> NatNetServer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _free_udp_port(host: str) -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind((host, 0))
        return int(probe.getsockname()[1])
