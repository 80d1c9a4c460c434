"""The air of another process, as a dongle in this one needs it."""

from __future__ import annotations

import os
import socket
import threading
from collections.abc import Sequence

from crazyarena.sim_backend.crazyradio import wire
from crazyarena.sim_backend.crazyradio.air import Frame, InUse, Outcome, Unplugged
from crazyarena.sim_backend.crazyradio.air_time import sent
from crazyarena.sim_backend.crazyradio.wire import Kind, Status

_PATIENCE = 0.25  # s; the other process may have no processor just now


class RemoteAir:
    """The air behind a :class:`.gateway.Gateway`. Safe to share between threads.

    When nobody answers there, the dongles stay plugged in and hear nothing, as with vehicles
    that are switched off.

    Parameters
    ----------
    address: ``host:port`` of the gateway.
    """

    def __init__(self, address: str) -> None:
        host, _, port = address.rpartition(":")
        if not host or not port.isdigit() or not 0 < int(port) < 65536:
            raise ValueError(f"virtual radio: found {address!r}; write HOST:PORT")
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.settimeout(_PATIENCE)
        self._socket.connect((host, int(port)))
        self._token = os.urandom(8)
        self._number = 0
        self._known: tuple[str, ...] = ()
        self._lock = threading.Lock()

    def dongles(self) -> Sequence[str]:
        answer = self._ask(Kind.DONGLES, "")
        if answer is not None:
            text = answer[1].decode("ascii", "replace")
            self._known = tuple(text.split("\0")) if text else ()
        return self._known

    def claim(self, serial: str) -> None:
        self._checked(self._ask(Kind.CLAIM, serial), serial)

    def release(self, serial: str) -> None:
        self._ask(Kind.RELEASE, serial)

    def exchange(self, serial: str, frame: Frame, now: float) -> Outcome:
        body = self._checked(self._ask(Kind.EXCHANGE, serial, frame), serial)
        outcome = None if body is None else wire.parse_outcome(body)
        if outcome is not None:
            return outcome
        attempts = frame.retries + 1 if frame.acked else 1
        wait = frame.ack_wait if frame.acked else 0.0
        duration = attempts * (sent(len(frame.payload), frame.rate) + wait)
        return Outcome(False, attempts - 1, duration)

    def close(self) -> None:
        self._socket.close()

    def _checked(self, answer: tuple[Status, bytes] | None, serial: str) -> bytes | None:
        if answer is None:
            return None
        if answer[0] is Status.UNPLUGGED:
            raise Unplugged(serial)
        if answer[0] is Status.IN_USE:
            raise InUse(serial)
        return answer[1]

    def _ask(
        self, kind: Kind, serial: str, frame: Frame | None = None
    ) -> tuple[Status, bytes] | None:
        """Status and body of the answer, None if there is none."""
        with self._lock:
            self._number = (self._number + 1) & 0xFFFFFFFF
            try:
                self._socket.send(wire.request(kind, self._number, self._token, serial, frame))
                while True:
                    parsed = wire.parse_answer(self._socket.recv(256))
                    # An answer that came too late for its own question is nobody's.
                    if parsed is not None and parsed[:2] == (kind, self._number):
                        return parsed[2], parsed[3]
            except OSError:
                return None
