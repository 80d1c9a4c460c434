"""Recordings of a real firmware, told apart by their content, and a vehicle to replay them on."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from crazyarena.sim_backend.arena import ArenaFleet
from crazyarena.sim_backend.crtp.swarm import VirtualSwarm
from crazyarena.sim_backend.crtp.toc import Table, param_entries
from crazyarena.sim_backend.crtp.vehicle import Hardware
from tests.recorded import folder

FEED_RATE = 100.0  # Hz, external poses in the recordings


def _contents() -> Iterator[tuple[Path, Any]]:
    for path in sorted(folder("firmware_recordings").iterdir()):
        if path.suffix == ".json":
            yield path, json.loads(path.read_text("utf-8"))
        elif path.suffix == ".jsonl":
            yield path, [json.loads(line) for line in path.read_text("utf-8").splitlines() if line]


def conversations() -> list[tuple[str, list]]:
    """Rows [seconds, ">" or "<", hex]."""
    return [
        (path.name, content)
        for path, content in _contents()
        if isinstance(content, list) and content and content[0][1] in ("<", ">")
    ]


def requests() -> list[tuple[str, list]]:
    """Rows [label, request hex, [answer hex, ...]]."""
    return [
        (path.name, content)
        for path, content in _contents()
        if isinstance(content, list) and content and isinstance(content[0][2], list)
    ]


def flights() -> list[tuple[str, dict]]:
    """Objects with ``log`` and ``ops``."""
    return [
        (path.name, content)
        for path, content in _contents()
        if isinstance(content, dict) and {"log", "ops"} <= set(content)
    ]


def tables() -> list[tuple[str, dict]]:
    """Objects with ``params`` and ``logs``."""
    return [
        (path.name, content)
        for path, content in _contents()
        if isinstance(content, dict) and {"params", "logs"} <= set(content)
    ]


def param_id(name: str) -> int:
    """Number of a parameter on the wire."""
    return [entry.name for entry in param_entries(Table.RECORDED)].index(name)


class Bench:
    """One bare vehicle in virtual time, fed its true pose."""

    def __init__(self, hardware: Hardware = Hardware.BARE, table: Table = Table.RECORDED) -> None:
        self.fleet = ArenaFleet(np.zeros((1, 3)))
        self.swarm = VirtualSwarm(self.fleet, hardware, FEED_RATE, table=table)
        self.vehicle = self.swarm.vehicles[0]
        self.heard: list[tuple[int, bytes]] = []

    def run_to(self, milliseconds: float) -> None:
        """Advance to a firmware time; what the vehicle says lands in ``heard``."""
        ticks = round(milliseconds) - self.fleet.tick
        if ticks > 0:
            self.swarm.advance(
                ticks, lambda _, datagram: self.heard.append((self.fleet.tick, datagram))
            )

    def ask(self, request: str | bytes) -> list[bytes]:
        """Send one datagram, in hex or bytes."""
        data = bytes.fromhex(request) if isinstance(request, str) else request
        return self.vehicle.receive(data)
