"""A ``crazyarena virtual-cf`` process for tests that stand on the ground station's side."""

from __future__ import annotations

import contextlib
import queue
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator

STARTUP = 240.0  # s; the first start compiles the simulation


class VirtualProcess:
    """The process, the URIs it printed, and its standard input for faults."""

    def __init__(self, *options: str) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "crazyarena", "virtual-cf", "--no-mocap", *options],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        self._lines: queue.Queue[str | None] = queue.Queue()
        threading.Thread(target=self._read, daemon=True).start()
        count = int(options[options.index("--count") + 1]) if "--count" in options else 1
        self.uris = [self._line(STARTUP) for _ in range(count)]
        # Where programs with virtual dongles find its vehicles.
        self.air = self._line().removeprefix("air ") if "--radio" in options else ""

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self._lines.put(line.strip())
        self._lines.put(None)

    def _line(self, timeout: float = 10.0) -> str:
        line = self._lines.get(timeout=timeout)
        assert line is not None, f"virtual-cf ended with {self._process.wait()}"
        return line

    @property
    def pid(self) -> int:
        return self._process.pid

    def command(self, text: str) -> str:
        """Type a line into it; returns the first line of its answer."""
        assert self._process.stdin is not None
        self._process.stdin.write(text + "\n")
        self._process.stdin.flush()
        return self._line()

    def close(self) -> None:
        self._process.terminate()
        try:
            self._process.wait(10.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


@contextlib.contextmanager
def virtual_process(*options: str) -> Iterator[VirtualProcess]:
    process = VirtualProcess(*options)
    try:
        yield process
    finally:
        process.close()


class Observer:
    """Asks a vehicle for its supervisor's bits over a socket of its own."""

    def __init__(self, uri: str) -> None:
        host, _, port = uri.removeprefix("udp://").partition(":")
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect((host, int(port)))
        self._socket.settimeout(20.0)

    def info(self) -> int:
        self._socket.send(bytes.fromhex("9c0c"))
        while True:
            answer = self._socket.recv(64)
            if answer[:2] == bytes.fromhex("908c"):
                return int.from_bytes(answer[2:4], "little")

    def close(self) -> None:
        self._socket.close()
