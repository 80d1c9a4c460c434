"""A Qualisys Track Manager that needs no cameras: its real-time protocol, served from ours.

Speaks the part of the QTM RT protocol (version 1.19, little endian; published by Qualisys in
the "QTM Real-time Server Protocol Documentation") that clients use to receive rigid bodies:

* TCP, base port + 1. Every packet: u32 size (of all of it), u32 type, payload. Types: 0 error,
  1 command (text ending in NUL), 2 XML, 3 data, 6 event (one byte).
* The server greets with ``QTM RT Interface connected``; the client asks for ``Version``,
  ``QTMVersion``, ``ByteOrder``, ``GetState``, ``GetParameters 6D``, ``StreamFrames`` and
  ``GetCurrentFrame``.
* Data packet: u64 time stamp in us, u32 frame number, u32 component count, then components:
  u32 size, u32 type, u32 count, u16 and u16 (drop and out-of-sync rate), items. Component 2,
  markers without labels: 3 f32 in mm, u32 id. Component 5, bodies: 3 f32 mm, 9 f32 rotation
  matrix by columns. Component 6, bodies with Euler angles: 3 f32 mm, 3 f32 degrees, about x, y
  and z in that order, each about the already turned axis. A body that is not seen is all NaN.
* Streams go to the UDP port named in ``StreamFrames ... UDP:port``, else over TCP.
"""

from __future__ import annotations

import socket
import struct
from collections.abc import Mapping, Sequence
from xml.sax.saxutils import escape

import numpy as np

from crazyarena.errors import InputError
from crazyarena.mocap.rotations import euler_xyz, matrix_of
from crazyarena.mocap.tcp_clients import TcpClients
from crazyarena.types import Pose, PoseFrame, Vector

ERROR, COMMAND, XML, DATA, NO_DATA, EVENT = 0, 1, 2, 3, 4, 6
_EVENT_CAPTURE_STARTED = 3
_PACKET = struct.Struct("<II")
_DATA = struct.Struct("<QII")
_COMPONENT = struct.Struct("<IIIHH")
_COMPONENTS = {"3dnolabels": 2, "6d": 5, "6deuler": 6}
_MARKER = np.dtype([("position", "<f4", 3), ("id", "<u4")])
_LONGEST_REQUEST = 1 << 16


def encode_data(
    frame_id: int,
    timestamp: float,
    names: Sequence[str],
    bodies: Mapping[str, Pose],
    markers: Vector,
    components: Sequence[int],
) -> bytes:
    """Return one data packet; ``timestamp`` in s, ``components`` as numbered above."""
    parts = []
    for component in sorted(components):
        if component == 2:
            items = np.zeros(len(markers), dtype=_MARKER)
            items["position"] = markers * 1e3
            items["id"] = np.arange(1, len(markers) + 1)
            body = items.tobytes()
            count = len(markers)
        else:
            width = 12 if component == 5 else 6
            block = np.full((len(names), width), np.nan, dtype="<f4")
            for row, name in enumerate(names):
                pose = bodies.get(name)
                if pose is None:
                    continue
                block[row, :3] = pose.position * 1e3
                if component == 5:
                    block[row, 3:] = matrix_of(pose.quaternion).T.ravel()
                else:
                    block[row, 3:] = np.degrees(euler_xyz(pose.quaternion))
            body = block.tobytes()
            count = len(names)
        parts.append(_COMPONENT.pack(_COMPONENT.size + len(body), component, count, 0, 0) + body)
    payload = _DATA.pack(max(0, int(timestamp * 1e6)), frame_id, len(parts)) + b"".join(parts)
    return _PACKET.pack(_PACKET.size + len(payload), DATA) + payload


class _Client:
    def __init__(self, connection: socket.socket, peer: str) -> None:
        self.connection = connection
        self.peer = peer
        self.buffer = b""
        self.components: tuple[int, ...] = ()
        self.udp_port: int | None = None
        self.streaming = False

    def send(self, kind: int, payload: bytes) -> None:
        self.connection.sendall(_PACKET.pack(_PACKET.size + len(payload), kind) + payload)


class QualisysServer(TcpClients[_Client]):
    """Serve pose frames as QTM would.

    Parameters
    ----------
    bodies: names of the rigid bodies, in the order of the data packets.
    port: QTM's base port (clients connect to ``port + 1``); 0 for any free pair.
    host: address to listen on.

    Call :meth:`publish` for every frame; one thread answers commands. A context manager.
    """

    def __init__(self, bodies: Sequence[str], port: int = 22222, host: str = "127.0.0.1") -> None:
        super().__init__(_listener(host, port), socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        self.bodies = tuple(bodies)
        self._last: PoseFrame | None = None
        self.sent = 0
        self.port: int = self._listener.getsockname()[1] - 1
        self._start("qtm-server")

    @property
    def clients(self) -> int:
        """Number of clients that receive frames now."""
        with self._lock:
            return sum(client.streaming for client in self._clients)

    def publish(self, frame: PoseFrame) -> None:
        """Send one frame to every streaming client; frame ids and times go along."""
        packets: dict[tuple[int, ...], bytes] = {}
        with self._lock:
            self._last = frame
            for client in list(self._clients):
                if not client.streaming:
                    continue
                packet = packets.get(client.components)
                if packet is None:
                    packet = packets[client.components] = self._encode(frame, client.components)
                try:
                    if client.udp_port is not None:
                        self._udp.sendto(packet, (client.peer, client.udp_port))
                    else:
                        client.connection.sendall(packet)
                    self.sent += 1
                except OSError:
                    self._drop(client)

    def _encode(self, frame: PoseFrame, components: Sequence[int]) -> bytes:
        return encode_data(
            frame.frame_id & 0xFFFFFFFF,
            frame.timestamp,
            self.bodies,
            frame.bodies,
            frame.markers,
            components,
        )

    def _make(self, connection: socket.socket, peer: str) -> _Client:
        return _Client(connection, peer)

    def _greet(self, client: _Client) -> None:
        client.send(COMMAND, b"QTM RT Interface connected\0")

    def _heard(self, client: _Client, received: bytes) -> None:
        client.buffer += received
        while len(client.buffer) >= _PACKET.size:
            size, kind = _PACKET.unpack_from(client.buffer)
            if not _PACKET.size <= size <= _LONGEST_REQUEST:
                self._drop(client)
                return
            if len(client.buffer) < size:
                break
            payload = client.buffer[_PACKET.size : size]
            client.buffer = client.buffer[size:]
            if kind == COMMAND:
                self._answer(client, payload.rstrip(b"\0").decode("latin-1"))

    def _answer(self, client: _Client, text: str) -> None:
        words = text.split()
        verb = words[0].lower() if words else ""
        if verb == "version":
            wanted = words[1] if len(words) > 1 else "1.19"
            client.send(COMMAND, f"Version set to {wanted}\0".encode())
        elif verb == "qtmversion":
            client.send(COMMAND, b"QTM Version is 2021.2 (build 6940)\0")
        elif verb == "byteorder":
            client.send(COMMAND, b"Byte order is little endian\0")
        elif verb == "getstate":
            client.send(EVENT, bytes([_EVENT_CAPTURE_STARTED]))
        elif verb == "getparameters":
            client.send(XML, self._parameters().encode() + b"\0")
        elif verb == "streamframes":
            self._stream(client, words[1:])
        elif verb == "getcurrentframe":
            if self._last is None:
                client.send(NO_DATA, b"")
            else:
                parts = [_COMPONENTS[w.lower()] for w in words[1:] if w.lower() in _COMPONENTS]
                client.connection.sendall(self._encode(self._last, parts))
        else:
            client.send(ERROR, b"Parse error\0")

    def _stream(self, client: _Client, words: Sequence[str]) -> None:
        lower = [word.lower() for word in words]
        if lower[:1] == ["stop"]:
            client.streaming = False
            return
        client.udp_port = None
        components = []
        for word in lower:
            name = word.split(":")[0]
            if name in _COMPONENTS:
                components.append(_COMPONENTS[name])
            elif name == "udp":
                port = word.rsplit(":", 1)[1]
                if not port.isdecimal() or not 0 < int(port) < 65536:
                    client.send(ERROR, b"Parse error\0")
                    return
                client.udp_port = int(port)
        client.components = tuple(components)
        client.streaming = bool(components)

    def _parameters(self) -> str:
        bodies = "".join(
            f"<Body><Name>{escape(name)}</Name><RGBColor>255</RGBColor></Body>"
            for name in self.bodies
        )
        return (
            "<QTM_Parameters_Ver_1.19><The_6D>"
            f"<Bodies>{len(self.bodies)}</Bodies>{bodies}"
            "<Euler><First>Roll</First><Second>Pitch</Second><Third>Yaw</Third></Euler>"
            "</The_6D></QTM_Parameters_Ver_1.19>"
        )


def _listener(host: str, port: int) -> socket.socket:
    listener = socket.socket()
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port + 1 if port else 0))
    except OSError as error:
        listener.close()
        raise InputError(f"mocap server: port {port + 1} on {host}: {error}") from None
    listener.listen()
    return listener
