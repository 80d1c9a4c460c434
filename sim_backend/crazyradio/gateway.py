"""Lets dongles in other processes send on this process's air."""

from __future__ import annotations

import contextlib
import socket
import threading

from crazyarena.clock import Clock
from crazyarena.errors import InputError
from crazyarena.sim_backend.crazyradio import wire
from crazyarena.sim_backend.crazyradio.air import Air, InUse, Unplugged
from crazyarena.sim_backend.crazyradio.wire import Kind, Status

_LEASE = 2.0  # s without a word after which a dongle's holder is gone


class Gateway:
    """Serves an air on a UDP port of this machine, in a thread of its own.

    Parameters
    ----------
    air: its times are those of ``clock``.
    host, port: where to listen; port 0 takes a free one.

    Raises
    ------
    InputError: the port cannot be listened on.
    """

    def __init__(
        self, air: Air, clock: Clock, host: str = "127.0.0.1", port: int = wire.DEFAULT_PORT
    ) -> None:
        self.air = air
        self._clock = clock
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind((host, port))
        except OSError as error:
            self._socket.close()
            raise InputError(
                f"virtual radio: cannot listen on {host}:{port} ({error.strerror}); is another "
                "one running? choose another --radio-port"
            ) from None
        self._closed = False
        self._thread = threading.Thread(target=self._serve, name="virtual-air", daemon=True)
        self._thread.start()

    @property
    def address(self) -> str:
        """``host:port``, for :class:`.remote.RemoteAir`."""
        host, port = self._socket.getsockname()[:2]
        return f"{host}:{port}"

    def close(self) -> None:
        """Stop serving; idempotent."""
        if self._closed:
            return
        self._closed = True
        with (
            contextlib.suppress(OSError),
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as waker,
        ):
            waker.sendto(b"", self._socket.getsockname())
        self._thread.join()
        self._socket.close()

    def _serve(self) -> None:
        while not self._closed:
            try:
                data, sender = self._socket.recvfrom(256)
            except OSError:
                continue  # a client that went away
            answer = self._answer(data)
            if answer is not None:
                with contextlib.suppress(OSError):
                    self._socket.sendto(answer, sender)

    def _answer(self, data: bytes) -> bytes | None:
        parsed = wire.parse_request(data)
        if parsed is None:
            return None
        kind, number, token, serial, frame = parsed
        now = self._clock.now()
        body, status = b"", Status.OK
        try:
            if kind is Kind.DONGLES:
                body = "\0".join(self.air.dongles()).encode()
            elif kind is Kind.RELEASE:
                self.air.release(serial, token)
            else:
                self.air.claim(serial, token, now, _LEASE)
                if frame is not None:
                    body = wire.pack_outcome(self.air.exchange(serial, frame, now))
        except Unplugged:
            status = Status.UNPLUGGED
        except InUse:
            status = Status.IN_USE
        return wire.answer(kind, number, status, body)
