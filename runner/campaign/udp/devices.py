"""Cameras, radio and vehicle of a campaign flight over UDP, as faults reach them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from crazyarena.clock import Clock
from crazyarena.mocap.sim_source import SimSource
from crazyarena.runner.campaign.cameras import FaultyCameras
from crazyarena.sim_backend.crtp.server import VirtualServer
from crazyarena.sim_backend.crtp.swarm import Send, VirtualSwarm
from crazyarena.types import Pose

LOOK_MS = 4  # ms between looks at the vehicle


class ArenaCameras(FaultyCameras):
    """Faulty cameras that are shown the world by whoever simulates it."""

    def __init__(self, source: SimSource, clock: Clock) -> None:
        super().__init__(source, clock)
        self._pushed = source

    @property
    def next_exposure(self) -> float:
        """Session time of the next exposure, s."""
        return self._pushed.next_exposure

    @property
    def next_event(self) -> float:
        """Session time of the next exposure or arrival, s."""
        held = self._held[0][0] if self._held else math.inf
        return min(self._pushed.next_event, held)

    def expose(self, time: float, truth: Mapping[str, Pose]) -> None:
        """Take one frame of the true poses at ``time``."""
        self._pushed.expose(time, truth)


class FaultyRadio:
    """``loss`` and ``cut`` of a server's link, as the campaign's faults set them."""

    def __init__(self, server: VirtualServer) -> None:
        self._server = server

    @property
    def loss(self) -> float:
        """Probability that a packet is lost, each way."""
        return self._server.links[0].faults.loss

    @loss.setter
    def loss(self, share: float) -> None:
        self._server.set_faults(loss=share)

    @property
    def cut(self) -> bool:
        """Nothing passes while True."""
        return self._server.links[0].faults.cut_until == math.inf

    @cut.setter
    def cut(self, cut: bool) -> None:
        self._server.set_faults(cut_until=math.inf if cut else -math.inf)


class Witness(VirtualSwarm):
    """A swarm that lets ``look()`` see the vehicle every few milliseconds of its time."""

    look: Callable[[], None]

    def advance(self, ticks: int, send: Send) -> None:
        while ticks > 0:
            piece = min(ticks, LOOK_MS)
            super().advance(piece, send)
            self.look()
            ticks -= piece
