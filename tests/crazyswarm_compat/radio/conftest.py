"""Virtual Crazyflies on loopback and a radio backend that talks to them."""

from __future__ import annotations

import contextlib
import threading
from dataclasses import replace

import numpy as np
import pytest

from crazyarena.clock import WallClock
from crazyarena.crazyswarm_compat import commands as c
from crazyarena.crazyswarm_compat.config import FleetConfig, VehicleConfig
from crazyarena.crazyswarm_compat.radio import RadioBackend, RadioOptions
from crazyarena.sim_backend.arena import ArenaFleet
from crazyarena.sim_backend.crtp.server import VirtualServer
from crazyarena.sim_backend.crtp.swarm import VirtualSwarm
from crazyarena.sim_backend.crtp.toc import Table
from crazyarena.sim_backend.decks import make_deck


class Hangar:
    """Virtual vehicles with ids 1, 2, ..., and what a test wants to know of them."""

    def __init__(self, count, port, feed_rate=0.0, table=Table.CF21, deck=None, **faults):
        self.fleet = ArenaFleet([[0.0, 0.7 * k, 0.0] for k in range(count)])
        if deck is not None:
            for k in range(count):
                self.fleet.decks.fit(k, make_deck(deck, np.random.default_rng(k)))
        # Compiled here, so that the server never stalls over it in flight.
        dry = ArenaFleet([[0.0, 0.0, 0.0]])
        dry.advance(50)
        hover = c.FullState([0, 0, 1], [0, 0, 0], [0, 0, 0], 0.0, [0, 0, 0])
        for command in (
            c.Takeoff(1.0, 1.0),
            c.GoTo([0, 0, 1], 0.0, 1.0),
            c.Land(0.0, 1.0),
            c.Stop(),
            hover,
            c.NotifySetpointsStop(),
            c.SetGroupMask(0),
            c.Emergency(),
        ):
            dry.send(command, 0)
            dry.advance(10)
        dry.emergency_watchdog(0)
        self.server = VirtualServer(
            VirtualSwarm(self.fleet, feed_rate=feed_rate, table=table), port=port
        )
        self.server.start()
        if faults:
            self.server.set_faults(**faults)
        self.uris = self.server.uris
        self._stop = threading.Event()
        self._feeders = []

    def config(self, **changes):
        """The fleet as a ground station knows it."""
        return FleetConfig(
            tuple(
                replace(
                    VehicleConfig(k + 1, f"cf{k + 1}", tuple(self.position(k + 1)), uri=uri),
                    **changes,
                )
                for k, uri in enumerate(self.uris)
            ),
            "test",
        )

    def position(self, vehicle):
        """True position, m."""
        return self.fleet.true_pose(vehicle - 1).position

    def info(self, vehicle=1):
        """Bits of supervisor.info."""
        return self.fleet.supervisor_info(vehicle - 1)

    def priority(self, vehicle=1):
        """Priority of the commander: 1 high level, 2 streamed."""
        return self.server.swarm.vehicles[vehicle - 1].flight.priority()

    def feed(self, backend, vehicles=None):
        """Forward true poses at 100 Hz until the end of the test."""
        chosen = tuple(backend.vehicles) if vehicles is None else vehicles

        def run():
            while not self._stop.wait(0.01):
                backend.send_external_poses({k: self.fleet.true_pose(k - 1) for k in chosen})

        self._feeders.append(threading.Thread(target=run, daemon=True))
        self._feeders[-1].start()

    def close(self):
        self._stop.set()
        for feeder in self._feeders:
            feeder.join()
        self.server.close()


@pytest.fixture(scope="session")
def toc_cache(tmp_path_factory):
    """Folder of tables of contents, filled by the first connection of the session."""
    return tmp_path_factory.mktemp("toc")


@pytest.fixture
def world(toc_cache):
    """Factory of connected worlds: ``world(count, options=..., faults...)`` gives a hangar and a
    backend; ``fed`` forwards poses."""
    with contextlib.ExitStack() as stack:

        def make(count=1, *, options=None, fed=True, port=0, config=None, **faults):
            hangar = Hangar(count, port, **faults)
            stack.callback(hangar.close)
            options = replace(options or RadioOptions(), cache=toc_cache)
            backend = RadioBackend(hangar.config(**(config or {})), WallClock(), options)
            stack.callback(backend.close)
            if fed:
                hangar.feed(backend)
            return hangar, backend

        yield make


def stream(backend, setpoint, duration, rate=30.0):
    """Send ``setpoint(t)`` at ``rate`` for ``duration`` s."""
    clock = WallClock()
    count = round(duration * rate)
    for k in range(count):
        clock.sleep_until(k / rate)
        backend.send(setpoint(k / rate), 1)
