"""Camera systems through the ``motioncapture`` package (Vicon, Qualisys, OptiTrack, VRPN, ...)."""

from __future__ import annotations

import importlib.util
import json
import os
import select
import socket
import subprocess
import sys
import threading

from crazyarena.clock import Clock
from crazyarena.errors import DependencyMissing, InputError
from crazyarena.mocap.assembly import DEFAULT_WAIT, Assembler, take_assembled
from crazyarena.mocap.frames import Convention, chosen_convention
from crazyarena.mocap.source import FrameQueue, SourceState, SourceStatus
from crazyarena.mocap.stamps import StampReader
from crazyarena.mocap.wire import PayloadError, decode
from crazyarena.types import PoseFrame

VENDOR_TYPES = (
    "vicon", "qualisys", "optitrack", "optitrack_closed_source", "nokov", "fzmotion",
    "motionanalysis", "vrpn", "mock",
)  # fmt: skip
# Protocols that send each body by itself.
SINGLY = ("vrpn",)
_LARGEST = 1 << 20


class MotionCaptureSource:
    """Rigid bodies of a camera system.

    The vendor's client runs in a helper process (see
    :mod:`crazyarena.mocap.motioncapture_helper`), which is restarted when it dies, cannot
    connect, or is silent for ``stall_after``.

    Parameters
    ----------
    clock: the session clock.
    vendor: type name of the package. Which of them work depends on how the installed wheel
        was built; others are reported in ``status.error``.
    latency: known time from exposure to arrival here, s; the package does not tell.
    convention: axes, units and offsets; None to take poses as they come. axes: ``z-up`` or
        ``y-up``, short for a convention with these axes only.
    stall_after: silence, s, after which the client is taken for dead. retry_after: pause
        before connecting anew, s.
    assemble: longest wait, s, for the bodies of one instant
        (:class:`~crazyarena.mocap.assembly.Assembler`); 0 for none. By default VRPN's are
        assembled, since it sends each by itself.
    options: passed through under their own names: ``hostname``, ``port``, ``interface_ip``,
        ``port_command``, ``update_frequency``, ...
    """

    def __init__(
        self,
        clock: Clock,
        vendor: str,
        latency: float = 0.0,
        convention: Convention | None = None,
        axes: str | None = None,
        stall_after: float = 1.0,
        retry_after: float = 0.5,
        connect_timeout: float = 5.0,
        assemble: float | None = None,
        **options: object,
    ) -> None:
        if vendor not in VENDOR_TYPES:
            raise InputError(f"mocap type: found {vendor!r}; choose one of {VENDOR_TYPES}")
        if importlib.util.find_spec("motioncapture") is None:
            raise DependencyMissing("motioncapture", "mocap", f"motion capture by {vendor}")
        for name, value in (("stall_after", stall_after), ("retry_after", retry_after)):
            if not value > 0:
                raise InputError(f"mocap {name}: found {value}; need seconds above 0")
        self._clock = clock
        self._convention = chosen_convention(convention, axes)
        if assemble is None:
            assemble = DEFAULT_WAIT if vendor in SINGLY else 0.0
        self._assembler = Assembler(assemble) if assemble else None
        self._command = [
            vendor,
            json.dumps({key: str(value) for key, value in options.items()}),
            repr(float(latency)),
            "singly" if self._assembler is not None else "whole",
        ]
        self._stall_after = stall_after
        self._retry_after = retry_after
        self._connect_timeout = connect_timeout
        self._queue = FrameQueue()
        self._reader = StampReader(clock)
        self._wake, self._waker = socket.socketpair()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"mocap-{vendor}", daemon=True)
        self._thread.start()

    def frames(self, timeout: float = 0.0) -> list[PoseFrame]:
        return take_assembled(self._queue, self._assembler, self._clock, timeout)

    @property
    def status(self) -> SourceStatus:
        return self._queue.status

    def _run(self) -> None:
        while not self._closing.is_set():
            near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            with near:
                with far:
                    helper = subprocess.Popen(
                        [
                            sys.executable, "-m", "crazyarena.mocap.motioncapture_helper",
                            str(far.fileno()), *self._command,
                        ],
                        pass_fds=(far.fileno(),),
                        stdin=subprocess.DEVNULL,
                        # One core each is plenty; a pool per helper would fight the session.
                        env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
                    )  # fmt: skip
                try:
                    self._receive(near)
                finally:
                    helper.kill()
                    helper.wait()
            self._closing.wait(self._retry_after)

    def _receive(self, near: socket.socket) -> None:
        """Pass on frames until the helper is gone or silent."""
        patience = self._connect_timeout
        while True:
            ready, _, _ = select.select([near, self._wake], [], [], patience)
            if self._closing.is_set():
                return
            if not ready:
                what = "no frames" if patience == self._stall_after else "no connection"
                self._queue.note(SourceState.LOST, error=f"{what} for {patience:g} s")
                return
            received = self._clock.now()
            try:
                message = near.recv(_LARGEST)
            except OSError:
                message = b""
            if not message:
                self._queue.note(SourceState.LOST, error="the mocap client stopped")
                return
            if message.startswith(b"CAPF"):
                self._take(message, received)
            elif message == b"ready":
                patience = self._stall_after
            else:
                text = message.decode(errors="replace").partition(" ")[2]
                self._queue.note(SourceState.LOST, error=text)
                return

    def _take(self, message: bytes, received: float) -> None:
        try:
            wire = decode(message)
        except PayloadError as error:
            self._queue.reject(str(error))
            return
        captured = self._reader.capture_time(wire.host, wire.captured, wire.sent, received)
        frame = PoseFrame(captured, received, wire.frame_id, wire.bodies, wire.markers)
        self._queue.put(self._convention.frame(frame), wire.run)

    def close(self) -> None:
        if self._closing.is_set():
            return
        self._closing.set()
        self._waker.send(b"\0")
        self._queue.close()
        self._thread.join(timeout=1.0)
        self._wake.close()
        self._waker.close()
