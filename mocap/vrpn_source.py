"""Poses from a VRPN server, with its own time stamps.

The client of the ``motioncapture`` package polls: it hands on the newest pose of each tracker every
10 ms, without stamps, so that some poses are skipped and the others are up to 10 ms late. This one
takes every message as it comes. :mod:`crazyarena.mocap.vrpn_wire` has the layouts.
"""

from __future__ import annotations

import contextlib
import math
import select
import socket
import threading

import numpy as np

from crazyarena.clock import Clock
from crazyarena.errors import InputError
from crazyarena.mocap import vrpn_wire as wire
from crazyarena.mocap.assembly import DEFAULT_WAIT, Assembler, take_assembled
from crazyarena.mocap.frames import Convention, chosen_convention
from crazyarena.mocap.source import FrameQueue, SourceState, SourceStatus
from crazyarena.mocap.stamps import StampReader, new_run
from crazyarena.types import Pose, PoseFrame

# Reports of one instant are stamped within this time, s: some servers stamp them on sending.
_SAME = 0.002
# Never the identity of a host of ours: the server's clock is a stranger's even on this machine.
_STRANGER = 0
_WINDOW = 8192


class VrpnSource:
    """Trackers of a VRPN server as bodies; what it sends of one instant is one frame.

    The capture time is the server's stamp. The offset of its clock is that of the fastest recent
    message, so ages are counted from that one's; a server that does not stamp is believed on
    arrival. Sensor 0 of tracker ``cf1`` is body ``cf1``, sensor 2 is ``cf1-2``.

    Parameters
    ----------
    clock: the session clock.
    hostname: of the server; ``host:port`` for another port.
    port: its TCP port.
    transport: ``tcp``, or ``udp`` to have poses sent in datagrams.
    latency: known time from exposure to the fastest arrival here, s.
    convention: axes, units and offsets; None to take poses as they come. axes: ``z-up`` or
        ``y-up``, short for a convention with these axes only.
    assemble: longest wait for the bodies of one instant, s
        (:class:`~crazyarena.mocap.assembly.Assembler`); 0 for none.
    stall_after: silence, s, after which the connection is taken for dead. retry_after: pause
        before connecting anew, s. connect_timeout: s.

    Raises
    ------
    InputError: an option is wrong.
    """

    def __init__(
        self,
        clock: Clock,
        hostname: str = "localhost",
        port: int | str = wire.DEFAULT_PORT,
        transport: str = "tcp",
        latency: float = 0.0,
        convention: Convention | None = None,
        axes: str | None = None,
        assemble: float = DEFAULT_WAIT,
        stall_after: float = 1.0,
        retry_after: float = 0.5,
        connect_timeout: float = 2.0,
    ) -> None:
        for name, value in (("stall_after", stall_after), ("retry_after", retry_after)):
            if not value > 0:
                raise InputError(f"mocap {name}: found {value}; need seconds above 0")
        if transport not in ("tcp", "udp"):
            raise InputError(f"mocap transport: found {transport!r}; choose tcp or udp")
        self._address = _address(hostname, port)
        self._clock = clock
        self._datagrams = transport == "udp"
        self._latency = latency
        self._convention = chosen_convention(convention, axes)
        self._stall_after = stall_after
        self._retry_after = retry_after
        self._connect_timeout = connect_timeout
        self._queue = FrameQueue()
        self._assembler = Assembler(assemble, same=_SAME) if assemble else None
        self._wake, self._waker = socket.socketpair()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="mocap-vrpn", daemon=True)
        self._thread.start()

    def frames(self, timeout: float = 0.0) -> list[PoseFrame]:
        return take_assembled(self._queue, self._assembler, self._clock, timeout)

    @property
    def status(self) -> SourceStatus:
        return self._queue.status

    def _run(self) -> None:
        host, port = self._address
        while not self._closing.is_set():
            try:
                with (
                    socket.create_connection((host, port), self._connect_timeout) as link,
                    socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as datagrams,
                ):
                    self._talk(link, datagrams)
            except OSError as error:
                reason = f"VRPN server {host}:{port}: {error.strerror or error}"
                self._queue.note(SourceState.LOST, error=reason)
            except wire.VrpnError as error:
                self._queue.note(SourceState.LOST, error=f"VRPN server {host}:{port}: {error}")
            self._closing.wait(self._retry_after)

    def _talk(self, link: socket.socket, datagrams: socket.socket) -> None:
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        link.sendall(wire.COOKIE)
        stream = wire.Stream()
        trackers = _Trackers(self._clock, self._latency)
        told = not self._datagrams
        last = self._clock.now()
        while True:
            left = last + self._stall_after - self._clock.now()
            ready, _, _ = select.select([link, datagrams, self._wake], [], [], max(0.0, left))
            if self._closing.is_set():
                return
            if not ready:
                raise OSError(f"no pose for {self._stall_after:g} s")
            received = self._clock.now()
            messages: list[wire.Message] = []
            if link in ready:
                data = link.recv(65536)
                if not data:
                    raise OSError("the server hung up")
                messages += stream.feed(data)
            if stream.greeted and not told:
                told = True
                near = link.getsockname()[0]
                datagrams.bind((near, 0))
                body = near.encode() + b"\0"
                link.sendall(wire.pack(wire.UDP, datagrams.getsockname()[1], body))
            if datagrams in ready:
                data, peer = datagrams.recvfrom(65536)
                # Anybody can send a datagram; only the server is believed.
                if peer[0] == link.getpeername()[0]:
                    try:
                        messages += wire.unpack_datagram(data)
                    except wire.VrpnError as error:
                        self._queue.reject(str(error))
            for message in messages:
                try:
                    frame = trackers.take(message, received)
                except wire.VrpnError as error:
                    self._queue.reject(str(error))
                    continue
                if frame is not None:
                    last = received
                    self._queue.put(self._convention.frame(frame), trackers.run)

    def close(self) -> None:
        if self._closing.is_set():
            return
        self._closing.set()
        self._waker.send(b"\0")
        self._queue.close()
        self._thread.join(timeout=1.0)
        self._wake.close()
        self._waker.close()


class _Trackers:
    """What one connection's numbers mean, and its clock."""

    def __init__(self, clock: Clock, latency: float) -> None:
        self.run = new_run()
        self._latency = latency
        self._reader = StampReader(clock, _WINDOW, assumed_transit=0.0)
        self._senders: dict[int, str] = {}
        self._types: dict[int, str] = {}
        self._count = 0
        self._stamp = -math.inf

    def take(self, message: wire.Message, received: float) -> PoseFrame | None:
        """Return the pose in a message as a frame of its own; None if there is none."""
        if message.kind in (wire.SENDER, wire.TYPE):
            names = self._senders if message.kind == wire.SENDER else self._types
            if len(names) < wire.MAX_NAMES:
                names[message.sender] = wire.described(message)
            return None
        if self._types.get(message.kind) != wire.POS_QUAT:
            return None
        name = self._senders.get(message.sender)
        if not name or len(message.body) != wire.POSE.size:
            raise wire.VrpnError("a pose of a tracker without name, or of another length")
        sensor, _, *numbers = wire.POSE.unpack(message.body)
        values = np.array(numbers)
        norm = math.hypot(*values[3:].tolist()) if np.isfinite(values).all() else 0.0
        # Unseen bodies come as NaN or as a zero quaternion.
        if not 0.5 < norm < 2.0:
            return None
        captured = received
        # The clock of a server that stamps runs; one that does not tell stands still.
        if message.time != 0.0 and self._stamp > -math.inf:
            captured = self._reader.capture_time(_STRANGER, message.time, message.time, received)
        self._stamp = message.time
        frame = PoseFrame(
            captured - self._latency,
            received,
            self._count,
            {name if sensor == 0 else f"{name}-{sensor}": Pose(values[:3], values[3:] / norm)},
        )
        self._count += 1
        return frame


def _address(hostname: str, port: int | str) -> tuple[str, int]:
    host = hostname.removeprefix("tcp://")
    name, colon, own = host.rpartition(":")
    if colon and own.isdecimal():
        host, port = name, own
    with contextlib.suppress(ValueError):
        number = int(port)
        if host and 0 < number < 65536:
            return host, number
    raise InputError(f"mocap hostname {hostname!r} port {port!r}: write a name, or name:port")
