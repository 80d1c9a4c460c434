"""Writes trajectories into a vehicle's memory."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import numpy as np

from crazyarena.clock import Clock
from crazyarena.crazyswarm_compat.radio import packets as pk
from crazyarena.crazyswarm_compat.radio.client import Client
from crazyarena.crazyswarm_compat.radio.lanes import HighLevelItem
from crazyarena.errors import BackendError

_TRAJECTORY_MEMORY = 0x12


class TrajectoryMemory:
    """Uploads to one vehicle, one at a time.

    Parameters
    ----------
    who: name of the vehicle, for messages.
    timeout: for a whole upload, s.
    client: the present connection, None for none.
    command: queues a high-level command.
    """

    def __init__(
        self,
        who: str,
        timeout: float,
        clock: Clock,
        client: Callable[[], Client | None],
        command: Callable[[HighLevelItem], None],
    ) -> None:
        self._who = who
        self._timeout = timeout
        self._clock = clock
        self._client = client
        self._command = command
        self._lock = threading.Lock()

    def upload(self, ident: int, piece_offset: int, pieces: Any) -> None:
        """Write pieces (n, 33) and declare them a trajectory (blocks).

        Raises
        ------
        BackendError
            if the vehicle has no such memory, refuses, or does not answer in time.
        """
        timeout = self._timeout
        where = f"{self._who}: uploadTrajectory {ident}"
        data = pk.trajectory_bytes(pieces)
        deadline = self._clock.now() + timeout
        with self._lock:
            client = self._client()
            if client is None or client.link is None:
                raise BackendError(f"{where}: not connected")
            memories = client.mem.get_mems(_TRAJECTORY_MEMORY)
            if not memories:
                raise BackendError(f"{where}: this firmware has no trajectory memory")
            self._write(client, memories[0], pk.PIECE_BYTES * piece_offset, data, where)
            answer: list[tuple[int | None, str]] = []
            answered = threading.Event()

            def done(code: int | None, reason: str) -> None:
                answer.append((code, reason))
                answered.set()

            packet = pk.define_trajectory(ident, piece_offset, len(np.asarray(pieces)))
            self._command(HighLevelItem(packet, "uploadTrajectory", False, done, expires=False))
            if not answered.wait(max(0.5, deadline - self._clock.now())):
                raise BackendError(f"{where}: not acknowledged within {timeout:g} s")
            code, reason = answer[0]
            if code != 0:
                raise BackendError(f"{where}: {reason or f'refused with error {code}'}")

    def _write(self, client: Client, memory: Any, address: int, data: bytes, where: str) -> None:
        finished = threading.Event()
        failed: list[bool] = []

        def good(written: Any, at: int) -> None:
            if written.id == memory.id and at == address:
                finished.set()

        def bad(written: Any, at: int) -> None:
            if written.id == memory.id and at == address:
                failed.append(True)
                finished.set()

        client.mem.mem_write_cb.add_callback(good)
        client.mem.mem_write_failed_cb.add_callback(bad)
        try:
            client.mem.write(memory, address, data)
            if not finished.wait(self._timeout):
                raise BackendError(
                    f"{where}: {len(data)} bytes not written within {self._timeout:g} s"
                )
            if failed:
                raise BackendError(f"{where}: the vehicle refused {len(data)} bytes at {address}")
        finally:
            client.mem.mem_write_cb.remove_callback(good)
            client.mem.mem_write_failed_cb.remove_callback(bad)
