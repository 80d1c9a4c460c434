"""Clients that hold a TCP connection to a pose server: accepted, read and dropped in one thread."""

from __future__ import annotations

import select
import socket
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Generic, Protocol, Self, TypeVar


class HasConnection(Protocol):
    """What is kept of a client."""

    connection: socket.socket


C = TypeVar("C", bound=HasConnection)


class TcpClients(ABC, Generic[C]):
    """The part of a server that deals with its clients; a context manager.

    Parameters
    ----------
    listener: listens already; datagrams: its UDP socket. Both are closed with the server.

    A server calls :meth:`_start` when it is ready to answer. Whatever it does with its clients, it
    does while it holds ``_lock``.
    """

    def __init__(self, listener: socket.socket, datagrams: socket.socket) -> None:
        self._lock = threading.Lock()
        self._clients: list[C] = []
        self._listener, self._udp = listener, datagrams
        # Called when there is something to read from other sockets.
        self._others: dict[socket.socket, Callable[[], None]] = {}
        self._wake, self._waker = socket.socketpair()
        self._closed = False
        self._thread: threading.Thread | None = None

    @abstractmethod
    def _make(self, connection: socket.socket, peer: str) -> C:
        """A new client; ``peer``: its address."""

    @abstractmethod
    def _greet(self, client: C) -> None:
        """The first words to a client; OSError drops it."""

    @abstractmethod
    def _heard(self, client: C, received: bytes) -> None:
        """Bytes from a client, never none; OSError drops it."""

    def _start(self, name: str) -> None:
        self._thread = threading.Thread(target=self._serve, name=name, daemon=True)
        self._thread.start()

    def _drop(self, client: C) -> None:
        if client in self._clients:
            self._clients.remove(client)
        client.connection.close()

    def _serve(self) -> None:
        while not self._closed:
            with self._lock:
                by_socket = {c.connection: c for c in self._clients}
            watched = [self._listener, self._wake, *self._others, *by_socket]
            ready, _, _ = select.select(watched, [], [], 1.0)
            for sock in ready:
                if sock is self._listener:
                    self._accept()
                elif sock in self._others:
                    self._others[sock]()
                elif sock is not self._wake:
                    self._read(by_socket[sock])

    def _accept(self) -> None:
        try:
            connection, (peer, *_) = self._listener.accept()
        except OSError:
            return
        self._welcome(connection, peer)

    def _welcome(self, connection: socket.socket, peer: str) -> None:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        # A client that stops reading is dropped instead of holding up everybody else.
        connection.settimeout(0.2)
        client = self._make(connection, peer)
        with self._lock:
            self._clients.append(client)
            try:
                self._greet(client)
            except OSError:
                self._drop(client)

    def _read(self, client: C) -> None:
        with self._lock:
            try:
                received = client.connection.recv(4096)
                if not received:
                    raise OSError("hung up")
                self._heard(client, received)
            except OSError:
                self._drop(client)

    def close(self) -> None:
        """Hang up on every client and stop; idempotent."""
        if self._closed:
            return
        self._closed = True
        self._waker.send(b"\0")
        if self._thread is not None:
            self._thread.join(timeout=2.0)
        with self._lock:
            for client in list(self._clients):
                self._drop(client)
        for sock in (self._listener, self._udp, self._wake, self._waker):
            sock.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
