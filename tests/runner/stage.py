"""An arena before a flight: virtual vehicles on UDP, cameras on zenoh, and somebody's hand."""

from __future__ import annotations

import math
import socket
import threading
import time

import numpy as np

from crazyarena.clock import WallClock
from crazyarena.levels import load_level
from crazyarena.levels.draw import LevelRandom
from crazyarena.mocap.camera_model import CameraModel
from crazyarena.mocap.sim_source import SimSource
from crazyarena.mocap.zenoh_link import ZenohPublisher
from crazyarena.runner.campaign.turned import turn
from crazyarena.sim_backend.arena import ArenaFleet, SensorNoise
from crazyarena.sim_backend.arena_kernel import N_FORCE
from crazyarena.sim_backend.arena_world import feet, track_truth
from crazyarena.sim_backend.crtp.server import VirtualServer
from crazyarena.sim_backend.crtp.swarm import VirtualSwarm
from crazyarena.sim_backend.physics.arena_plant import GRAVITY
from crazyarena.sim_backend.physics.competition_step import B_OMEGA, set_pose
from crazyarena.types import Pose

_RATE = 1.0  # rad/s at which a hand tips
_LIFTED = 0.15  # m


class Hand:
    """Bears the weight of a vehicle; what the fleet takes for its disturbances."""

    def __init__(self):
        self.weights = {}

    def standard_normal(self, shape):
        force = np.zeros(shape)
        for vehicle, weight in self.weights.items():
            force[vehicle, :, N_FORCE + 2] = weight
        return force


class Swarm(VirtualSwarm):
    """Vehicles that may be held in a hand, and a track around them."""

    track: dict[str, Pose]
    names: dict[str, str | None]
    noses: dict[str, float]
    hand: int | None = None
    angle = 0.0
    wanted = 0.0

    def advance(self, ticks, send):
        if self.hand is None:
            super().advance(ticks, send)
            return
        while ticks > 0:
            step = min(2, ticks)
            self._hold(step)
            super().advance(step, send)
            ticks -= step

    def _hold(self, step):
        body = self.fleet.bodies[self.hand]
        change = min(abs(self.wanted - self.angle), _RATE * 1e-3 * step)
        change = math.copysign(change, self.wanted - self.angle)
        x, y, _ = self.fleet.true_pose(self.hand).position
        set_pose(body, x, y, _LIFTED, self.angle, 0.0, 0.0)
        body[B_OMEGA] = change / (1e-3 * step)
        self.angle += change

    def truth(self):
        seen = {
            self.names.get(name, name): turn(pose, self.noses.get(name, 0.0))
            for name, pose in super().truth().items()
        }
        return {**{k: v for k, v in seen.items() if k is not None}, **self.track}


class Stage:
    """Use as a context manager.

    places: (x, y) of the vehicles, m; the level's start by default.
    names: other names under which the cameras see bodies; None for not at all.
    noses: rad by which bodies' noses lie to the left of their vehicles'.
    seed: of the cameras' noise.
    """

    def __init__(self, level="sim2real", overrides=(), places=None, names=None, noses=None, seed=3):
        draw = LevelRandom(load_level(level, list(overrides))).reset()
        places = places or [(draw.start[0], draw.start[2])]
        self._hand = Hand()
        self.fleet = ArenaFleet(
            [(x, y, 0.0) for x, y in places], noise=SensorNoise(force=1.0), rng=self._hand
        )
        self.fleet.advance(1)
        self.swarm = Swarm(self.fleet)
        self.swarm.track = track_truth(feet(draw), draw.obstacles)
        self.swarm.names = dict(names or {})
        self.swarm.noses = dict(noses or {})
        for vehicle in self.swarm.vehicles:
            vehicle.warm_up()
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
        clock = WallClock()
        self._publisher = ZenohPublisher(clock, listen=[self.endpoint])
        self.server = VirtualServer(
            self.swarm,
            clock=clock,
            port=0,
            cameras=SimSource(clock, model=CameraModel(), seed=seed),
            publisher=self._publisher,
        )
        self.uris = self.server.uris

    def __enter__(self):
        self.server.start()
        return self

    def __exit__(self, *exception):
        self.server.close()
        self._publisher.close()

    def tip(self, vehicle: int, angle: float) -> None:
        """Take a vehicle (by index) in hand and tip it."""
        with self.server._lock:
            self.swarm.wanted = angle
            self._hand.weights = {vehicle: self.fleet.plants[vehicle, 0] * GRAVITY}
            self.swarm.hand = vehicle

    def put_down(self) -> None:
        """Upright again, and back where it stood."""
        self.swarm.wanted = 0.0
        deadline = time.monotonic() + 10.0
        while self.swarm.angle > 1e-3 and time.monotonic() < deadline:
            threading.Event().wait(0.05)
        with self.server._lock:
            index = self.swarm.hand
            self.swarm.hand = None
            self._hand.weights = {}
            x, y, _ = self.fleet.true_pose(index).position
            self.fleet.place(index, (x, y, 0.0))
