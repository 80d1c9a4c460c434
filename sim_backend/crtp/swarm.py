"""Virtual Crazyflies sharing one simulated world, in whatever time their owner keeps."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from crazyarena.sim_backend.arena import ArenaFleet
from crazyarena.sim_backend.crtp.toc import Table
from crazyarena.sim_backend.crtp.vehicle import Hardware, VirtualCrazyflie
from crazyarena.types import Pose

Send = Callable[[int, bytes], None]

# Of simulated time per compiled call, at least; log data and poses are at most so late, less one.
_BATCH_MS = 2


class VirtualSwarm:
    """The vehicles of a fleet, advanced together.

    Parameters
    ----------
    fleet: advanced by nobody else.
    hardware: of each vehicle.
    feed_rate: Hz at which every vehicle is given its true pose as if a ground station had
        measured and sent it; 0 leaves that to the real ground station.
    stored: persistent parameters by vehicle index.
    table: whose parameters and log variables they have.
    """

    def __init__(
        self,
        fleet: ArenaFleet,
        hardware: Hardware = Hardware.FULL,
        feed_rate: float = 0.0,
        stored: Mapping[int, dict[str, float]] | None = None,
        table: Table = Table.CF21,
    ) -> None:
        self.fleet = fleet
        stored = stored or {}
        self.vehicles = tuple(
            VirtualCrazyflie(fleet, index, hardware, stored.get(index), table)
            for index in range(len(fleet))
        )
        self._feed_period = 1000.0 / feed_rate if feed_rate > 0.0 else None
        self._next_feed = 0.0

    def advance(self, ticks: int, send: Send) -> None:
        """Let ``ticks`` milliseconds pass; ``send(vehicle, datagram)`` takes what is said."""
        end = self.fleet.tick + ticks
        while self.fleet.tick < end:
            if self._feed_period is not None and self.fleet.tick >= self._next_feed:
                self._next_feed += self._feed_period
                self._feed()
            ahead = max(_BATCH_MS, self._due() - self.fleet.tick)
            self.fleet.advance(min(ahead, end - self.fleet.tick))
            for index, vehicle in enumerate(self.vehicles):
                for datagram in vehicle.advance():
                    send(index, datagram)

    def _due(self) -> int:
        """Tick at which the next log data or pose is due."""
        due = [vehicle.due() for vehicle in self.vehicles]
        if self._feed_period is not None:
            due.append(math.ceil(self._next_feed))
        return min(due)

    def _feed(self) -> None:
        for index in range(len(self.vehicles)):
            self.fleet.external_pose(index, self.fleet.tracked_pose(index))

    def truth(self) -> dict[str, Pose]:
        """True poses by the names ``cf1``, ``cf2``, ... of the vehicles' ids."""
        return {f"cf{ident}": self.fleet.tracked_pose(i) for i, ident in enumerate(self.fleet.ids)}
