"""A stream socket that carries whole messages: four bytes of length, then the message."""

from __future__ import annotations

import contextlib
import select
import socket
import struct
import threading
from collections import deque

_LENGTH = struct.Struct("<I")
_CHUNK = 1 << 18


class Receiver:
    """Takes messages from a socket. For one thread."""

    def __init__(self, connection: socket.socket) -> None:
        self._socket = connection
        self._poll = select.poll()
        self._poll.register(connection, select.POLLIN)
        self._buffer = bytearray()
        self._chunk = memoryview(bytearray(_CHUNK))

    def receive(self, timeout: float | None = 0.0) -> list[bytes]:
        """Every message that has arrived, waiting up to ``timeout`` s (None: for ever) if
        nothing has.

        Raises
        ------
        EOFError: the other end is gone, and there is nothing left to read.
        """
        # Waiting costs nothing where time is short: whole milliseconds are not exact enough.
        wait = None if timeout is None else max(0.0, timeout)
        if wait == 0.0:
            ready = bool(self._poll.poll(0))
        else:
            ready = bool(select.select([self._socket], [], [], wait)[0])
        if not ready:
            return []
        gone = False
        while True:
            try:
                length = self._socket.recv_into(self._chunk, 0, socket.MSG_DONTWAIT)
            except BlockingIOError:
                break
            except OSError:
                length = 0
            if not length:
                gone = True
                break
            self._buffer += self._chunk[:length]
            if length < _CHUNK:
                break
        messages = self._cut()
        if gone and not messages:
            raise EOFError
        return messages

    def _cut(self) -> list[bytes]:
        buffer, at = self._buffer, 0
        messages = []
        while len(buffer) - at >= _LENGTH.size:
            (length,) = _LENGTH.unpack_from(buffer, at)
            end = at + _LENGTH.size + length
            if len(buffer) < end:
                break
            messages.append(bytes(memoryview(buffer)[at + _LENGTH.size : end]))
            at = end
        del buffer[:at]
        return messages


class Sender:
    """Puts messages into a socket, from any thread, and waits until they are in."""

    def __init__(self, connection: socket.socket) -> None:
        self._socket = connection
        self._lock = threading.Lock()

    def send(self, message: bytes) -> None:
        """Raises OSError when the other end is gone."""
        with self._lock:
            self._socket.sendall(_LENGTH.pack(len(message)) + message, socket.MSG_NOSIGNAL)


class PatientSender:
    """Puts messages into a socket, from any thread, and never waits nor loses one.

    What the socket does not take is kept, however much it is, and a thread sends it on as soon
    as the other end reads again.
    """

    def __init__(self, connection: socket.socket) -> None:
        self._socket = connection
        self._queue: deque[bytes | memoryview] = deque()
        self._wake = threading.Condition(threading.Lock())
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="to-runner", daemon=True)
        self._thread.start()

    def send(self, message: bytes) -> None:
        """Nothing happens when the other end is gone: whoever reads notices."""
        with self._wake:
            if self._closed:
                return
            self._queue.append(_LENGTH.pack(len(message)) + message)
            if len(self._queue) == 1:
                self._flush()
                if self._queue:
                    self._wake.notify()

    def _flush(self) -> None:
        queue = self._queue
        while queue:
            first = queue[0]
            try:
                sent = self._socket.send(first, socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)
            except BlockingIOError:
                return
            except OSError:
                self._closed = True
                queue.clear()
                return
            if sent == len(first):
                queue.popleft()
            else:
                queue[0] = memoryview(first)[sent:]

    def _run(self) -> None:
        while True:
            with self._wake:
                self._flush()
                while not self._queue:
                    if self._closed:
                        return
                    self._wake.wait()
            with contextlib.suppress(OSError, ValueError):
                # A while at most, so that a closed socket ends the thread.
                select.select([], [self._socket], [], 0.2)

    def close(self) -> None:
        """Give up what has not been sent."""
        with self._wake:
            self._closed = True
            self._queue.clear()
            self._wake.notify()
        self._thread.join(timeout=1.0)
