"""Simulated vehicles behind virtual dongles, for a program in the same process."""

from __future__ import annotations

from collections.abc import Callable

from crazyarena.clock import Clock, WallClock
from crazyarena.sim_backend.crazyradio.air import Air
from crazyarena.sim_backend.crazyradio.air_time import UsbTiming
from crazyarena.sim_backend.crazyradio.fleet import RadioPlan, put_on_air
from crazyarena.sim_backend.crazyradio.usb_backend import install
from crazyarena.sim_backend.crtp.faults import Faults
from crazyarena.sim_backend.crtp.server import VirtualServer
from crazyarena.sim_backend.crtp.swarm import VirtualSwarm


class VirtualRadio:
    """Runs a swarm, puts it on the air and lets pyusb find the dongles; a context manager.

    Attributes
    ----------
    server: runs the vehicles; its faults are those of the radio. air: where dongles are plugged
    and unplugged. uris: what cflib opens, by vehicle.

    Parameters
    ----------
    swarm: nobody else may advance it.
    plan: channels, rate, dongles.
    faults: at the start.
    timing: of USB.
    seed: of what is lost.
    """

    server: VirtualServer
    air: Air

    def __init__(
        self,
        swarm: VirtualSwarm,
        plan: RadioPlan | None = None,
        *,
        faults: Faults | None = None,
        clock: Clock | None = None,
        timing: UsbTiming | None = None,
        seed: int = 0,
    ) -> None:
        clock = clock or WallClock()
        links, self.air = put_on_air(swarm.fleet.ids, clock, plan, faults, seed)
        self.links = links
        self.server = VirtualServer(swarm, links=links, clock=clock)
        self._clock = clock
        self._timing = timing
        self._undo: Callable[[], None] | None = None

    @property
    def uris(self) -> list[str]:
        """What cflib opens, by vehicle."""
        return [link.uri for link in self.links]

    def __enter__(self) -> VirtualRadio:
        self.server.start()
        self._undo = install(self.air, self._clock, self._timing)
        return self

    def __exit__(self, *exception: object) -> None:
        if self._undo is not None:
            self._undo()
        self.server.close()
