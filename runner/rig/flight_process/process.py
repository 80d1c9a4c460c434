"""Starts the flight process and speaks to it over a channel of its own."""

from __future__ import annotations

import contextlib
import math
import pickle
import signal
import socket
import subprocess
import sys
from collections.abc import Mapping
from typing import Any

from crazyarena.clock import WallClock
from crazyarena.errors import BackendError
from crazyarena.mocap.source import SourceStatus
from crazyarena.runner.rig.flight_process import wire
from crazyarena.runner.rig.flight_process.channel import Receiver, Sender
from crazyarena.runner.rig.flight_process.server import READY
from crazyarena.runner.rig.hardware import HardwareSetup
from crazyarena.types import PoseFrame, Telemetry

_CONNECTING = 120.0  # s, with the first compilation of the pose estimator
_ANSWERING = 3.0  # s, for what does not wait for the vehicle
VEHICLE = 15.0  # s, for what does
_LANDS = 30.0  # s, for it to bring down what may be in the air when it is told to end
SIGN_OF_LIFE = 0.2  # s
_BACKLOG = 50_000  # bytes: more than comes in any ordinary wait
_NEXT = 0.01  # s, for the rest of a backlog to follow


class FlightProcess:
    """Starts the flight process and talks to it. Not thread-safe but for :meth:`tell`.

    Attributes
    ----------
    frames: that have arrived and were not fetched yet. status: as last told.
    lost: why the process can no longer be reached, or None.
    refused: the first of what was posted that failed, or None.
    notes: what real-time privileges it was granted.

    Parameters
    ----------
    environment: of the process, this one's own by default.

    Raises
    ------
    CrazyarenaError: whatever connecting raised over there.
    """

    def __init__(self, setup: HardwareSetup, environment: Mapping[str, str] | None = None) -> None:
        self.frames: list[PoseFrame] = []
        self.status = wire.Status(Telemetry(-math.inf), SourceStatus())
        self.lost: str | None = None
        self.refused: Exception | None = None
        self.notes: list[str] = []
        self._replies: dict[int, wire.Reply] = {}
        self._clock = WallClock()
        self._number = READY
        self._told = -math.inf
        self._closed = self._ready = False
        ours, theirs = socket.socketpair()
        self._socket = ours
        self._sender = Sender(ours)
        self._receiver = Receiver(ours)
        module = "crazyarena.runner.rig.flight_process.server"
        # Ctrl-C is not for the child, not even while it starts.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT,))
        try:
            with theirs:
                self._process = subprocess.Popen(
                    [sys.executable, "-m", module, str(theirs.fileno())],
                    pass_fds=(theirs.fileno(),),
                    stdout=subprocess.DEVNULL,
                    env=environment,
                )
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        self._send(pickle.dumps(setup))

    @property
    def pid(self) -> int:
        """Process id of the flight process."""
        return self._process.pid

    @property
    def descriptor(self) -> int:
        """Readable when something has arrived; -1 when nothing will any more."""
        return -1 if self.lost is not None else self._socket.fileno()

    def await_ready(self) -> None:
        """Wait until everything over there is connected."""
        self.notes = self._await(READY, _CONNECTING)
        self._ready = True

    def tell(self, name: str, *arguments: Any) -> None:
        """Call ``name`` over there; nobody waits for it. Any thread."""
        self._send(wire.encode(wire.Call(0, name, arguments)))

    def post(self, name: str, *arguments: Any) -> None:
        """Call ``name`` over there without waiting; if it fails, ``refused`` will say so."""
        self._send(wire.encode(wire.Call(wire.POSTED, name, arguments)))

    def ask(self, name: str, *arguments: Any, timeout: float = _ANSWERING) -> Any:
        """Call ``name`` over there and return its result, or raise what it raised.

        Raises
        ------
        BackendError: the flight process is gone or does not answer.
        """
        self._number += 1
        number = self._number
        self._send(wire.encode(wire.Call(number, name, arguments)))
        return self._await(number, timeout)

    def _await(self, number: int, timeout: float) -> Any:
        end = self._clock.now() + timeout
        while number not in self._replies:
            if self.lost is not None:
                raise BackendError(self.lost)
            left = end - self._clock.now()
            if left <= 0.0:
                raise BackendError(f"the flight process did not answer within {timeout:g} s")
            self.listen(left)
        reply = self._replies.pop(number)
        # What nobody waits for any more.
        self._replies.clear()
        if reply.failure is not None:
            raise wire.revive(reply.failure)
        return reply.value

    def listen(self, timeout: float = 0.0) -> None:
        """Take in what has arrived, waiting up to ``timeout`` s for the first of it."""
        if self.lost is not None:
            self._clock.sleep_until(self._clock.now() + timeout)
            return
        try:
            arrived = self._receiver.receive(timeout)
            self._take(arrived)
            # Nobody has listened for seconds: more than the socket holds is on its way.
            while sum(map(len, arrived)) > _BACKLOG:
                arrived = self._receiver.receive(_NEXT)
                self._take(arrived)
        except EOFError:
            self._lose()

    def _take(self, arrived: list[bytes]) -> None:
        for data in arrived:
            message = wire.decode(data)
            if isinstance(message, PoseFrame):
                self.frames.append(message)
            elif isinstance(message, wire.Status):
                self.status = message
            elif isinstance(message, wire.Reply):
                if message.number == wire.POSTED and message.failure is not None:
                    self.refused = self.refused or wire.revive(message.failure)
                else:
                    self._replies[message.number] = message

    def sign_of_life(self, now: float) -> None:
        """Now and then, so that over there a runner that hangs can be told from a busy one."""
        if now - self._told >= SIGN_OF_LIFE:
            self._told = now
            self.tell("here")

    def _send(self, data: bytes) -> None:
        if self.lost is not None:
            return
        try:
            self._sender.send(data)
        except OSError:
            self._lose()

    def _lose(self) -> None:
        try:
            code = self._process.wait(timeout=1.0)
            how = f"exit code {code}" if code >= 0 else signal.Signals(-code).name
        except subprocess.TimeoutExpired:
            how = "it closed the channel"
        self.lost = (
            f"the flight process ended ({how}): nobody reaches the vehicle any more; "
            "in the air, its own watchdog stops its motors within a second"
        )

    def close(self) -> None:
        """Let it end, which it does when the vehicle is down. Idempotent."""
        if self._closed:
            return
        self._closed = True
        if not self._ready:
            self._process.terminate()  # nothing is in the air
        self.tell("close")
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_WR)
        try:
            self._process.wait(timeout=_LANDS)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._socket.close()
