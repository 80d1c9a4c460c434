"""A whole arena in a process of its own: a virtual Crazyflie on UDP or on the air, and cameras
on zenoh or as one of the emulated systems.

``python -m crazyarena.runner.rig.virtual_arena CONFIG`` with a JSON object: level_file (path),
seed, lsy (name and overrides of a level of lsy_drone_racing, or null), vehicle (id),
vehicle_file, port, radio (on the air, not on the port), place of the cameras, cameras (fields of
CameraModel), battery (times the usual capacity), deck (on the vehicle, instead of cameras; none if
empty). Prints one line of JSON with
``uri`` and ``air`` once it runs, and on SIGTERM one with how it kept up, then ends; also 20 s after
its standard input was closed.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np

from crazyarena.clock import WallClock
from crazyarena.errors import BackendError
from crazyarena.levels import dump_level, load_level
from crazyarena.levels.draw import LevelRandom
from crazyarena.levels.schema import Level
from crazyarena.mocap.onboard import KIND as ONBOARD
from crazyarena.mocap.opening import SourceSpec
from crazyarena.runner.rig import arena_cameras
from crazyarena.runner.timing.realtime import SERVING, lock_memory, lower_priority, raise_priority
from crazyarena.types import Pose

if TYPE_CHECKING:
    from crazyarena.levels.draw import Draw
    from crazyarena.sim_backend.arena_world import AnyTrack
    from crazyarena.sim_backend.vehicles import VehicleSupply

_START_TIMEOUT = 300.0  # s; the first run compiles
_AFTER_RUNNER = 20.0  # s


def _serve(config: dict[str, Any]) -> None:
    from crazyarena.mocap.camera_model import CameraModel
    from crazyarena.mocap.sim_source import SimSource
    from crazyarena.sim_backend.arena import ArenaFleet
    from crazyarena.sim_backend.arena_kernel import DT
    from crazyarena.sim_backend.arena_world import (
        LinkModel,
        Track,
        motions,
        sensor_noise,
    )
    from crazyarena.sim_backend.crazyradio.fleet import put_on_air
    from crazyarena.sim_backend.crazyradio.gateway import Gateway
    from crazyarena.sim_backend.crtp.faults import Faults
    from crazyarena.sim_backend.crtp.server import VirtualServer
    from crazyarena.sim_backend.crtp.swarm import Send, VirtualSwarm
    from crazyarena.sim_backend.decks import make_deck
    from crazyarena.sim_backend.physics.arena_plant import AP_CAPACITY
    from crazyarena.sim_backend.physics.competition_step import PLANT_SIZE
    from crazyarena.sim_backend.vehicles import load_vehicle, vehicle_rows

    class Swarm(VirtualSwarm):
        """Vehicles among the gates and obstacles that the cameras see as well."""

        track: AnyTrack

        def advance(self, ticks: int, send: Send) -> None:
            if self.track.moves:
                self.fleet.move_scene(self.track.scene(self.fleet.time + ticks * DT))
            super().advance(ticks, send)

        def truth(self) -> dict[str, Pose]:
            return {**super().truth(), **self.track.bodies(self.fleet.time)}

    lower_priority()  # whatever the runner had: first comes a lot of work that may wait
    level = load_level(config["level_file"])
    track: AnyTrack
    if config["lsy"] is None:
        draw = LevelRandom(level, config["seed"]).reset()
        track = Track(draw, motions(level))
    else:
        draw, track = _lsy_track(level, config["seed"], **config["lsy"])
    # Not the numbers of the dry run: measurement noise never repeats in an arena either.
    noise = np.random.default_rng([config["seed"], os.getpid()])
    for_cameras, for_sensors, for_deck = noise.spawn(3)
    model = vehicle_rows(load_vehicle(config["vehicle_file"]))
    nominal = level.vehicle
    model.plant[:PLANT_SIZE] += np.array((draw.mass, *draw.inertia)) - (
        nominal.mass,
        nominal.ixx,
        nominal.iyy,
        nominal.izz,
    )
    fleet = ArenaFleet(
        [(draw.start[0], draw.start[2], 0.0)],
        [float(draw.start[8])],
        ids=(config["vehicle"],),
        scene=track.scene(0.0),
        vehicles=model,
        noise=sensor_noise(model),
        rng=for_sensors,
    )
    fleet.plants[0, AP_CAPACITY] *= config["battery"]
    if config["deck"]:
        fleet.decks.fit(0, make_deck(config["deck"], for_deck))
    fleet.advance(1)  # compiles, which must not happen in flight
    swarm = Swarm(fleet)
    swarm.track = track
    for vehicle in swarm.vehicles:
        vehicle.warm_up()
    # Real vehicles and cameras are never short of processors or memory.
    lock_memory()
    raise_priority(SERVING, inherit=True)
    clock = WallClock()
    cameras, publisher = None, None
    if not config["deck"]:
        cameras = SimSource(clock, None, CameraModel(**config["cameras"]), for_cameras)
        publisher = arena_cameras.serve(config["place"], list(swarm.truth()), clock)
    links, gateway = None, None
    if config["radio"]:
        links, air = put_on_air(fleet.ids, clock)
        gateway = Gateway(air, clock, port=0)
    # The air between the two takes as long as that of a dry run.
    link = LinkModel()
    server = VirtualServer(
        swarm,
        "127.0.0.1",
        config["port"],
        links=links,
        faults=None
        if config["radio"]
        else Faults(latency=link.latency + link.jitter, jitter=link.jitter),
        clock=clock,
        cameras=cameras,
        publisher=publisher,
    )
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: server.stop())

    def outlive_the_runner() -> None:
        """For as long as it takes to land a vehicle whose runner was killed."""
        os.read(0, 1)  # returns when nobody holds the other end any more
        clock.sleep_until(clock.now() + _AFTER_RUNNER)
        server.stop()

    threading.Thread(target=outlive_the_runner, daemon=True).start()
    told = {"uri": server.uris[0], "air": "" if gateway is None else gateway.address}
    print(json.dumps(told), flush=True)
    try:
        server.run()
        end = fleet.true_pose(0).position
        info = fleet.supervisor_info(0)
        pace = server.pace
        print(
            json.dumps(
                {
                    "position": end.tolist(),
                    "supervisor": info,
                    "stalls": pace.stalls,
                    "worst_ms": pace.worst,
                    "link": server.links[0].report(),
                }
            ),
            flush=True,
        )
    finally:
        if gateway is not None:
            gateway.close()
        server.close()
        if publisher is not None:
            publisher.close()


def _lsy_track(level: Level, seed: int, name: str, overrides: list[str]) -> tuple[Draw, AnyTrack]:
    """Draw and track of a level of lsy_drone_racing; ``level`` is its arena."""
    from crazyarena.levels.lsy import load_lsy_level
    from crazyarena.levels.lsy.arena import ArenaDraws
    from crazyarena.sim_backend.lsy_track import LsyTrack

    body = level.vehicle
    own = load_lsy_level(name, overrides)
    draw = ArenaDraws(own, body.mass, (body.ixx, body.iyy, body.izz), seed).reset()
    return draw, LsyTrack(draw)


class VirtualArena:
    """Runs the arena of a level in a child process; use as a context manager.

    Attributes
    ----------
    uri: of the virtual vehicle. air: where dongles find it, empty over UDP. source: the pose
    source that sees it. endpoint: of the cameras, where they are on zenoh.
    report: what the child told at its end.

    Raises
    ------
    BackendError: it does not come up.
    """

    def __init__(
        self,
        level: Level,
        seed: int,
        folder: Path,
        *,
        vehicle: int = 1,
        cameras: dict[str, Any] | None = None,
        battery: float = 1.0,
        radio: bool = False,
        supply: VehicleSupply | None = None,
        mocap: str = "zenoh",
        mocap_options: dict[str, Any] | None = None,
        lsy: dict[str, Any] | None = None,
    ) -> None:
        from crazyarena.sim_backend.vehicles import level_supply, vehicle_file

        place: dict[str, Any] = {}
        options = dict(mocap_options or {})
        deck, self.endpoint = "", ""
        if mocap == ONBOARD:
            deck = str(options.pop("deck", "lighthouse"))
            self.source = SourceSpec(ONBOARD, options)
        else:
            place = arena_cameras.free_places(mocap)
            self.endpoint = arena_cameras.endpoint(place)
            self.source = arena_cameras.source(place, cameras or {}, **options)
        self.report: dict[str, Any] = {}
        level_file = folder / "level.yaml"
        level_file.write_text(dump_level(level))
        flown = (supply or level_supply(level, seed)).next()
        config = {
            "level_file": str(level_file),
            "seed": seed,
            "lsy": lsy,
            "vehicle": vehicle,
            "vehicle_file": str(vehicle_file(folder, flown)),
            "port": 0,
            "place": place,
            "cameras": cameras or {},
            "battery": battery,
            "radio": radio,
            "deck": deck,
        }
        self._errors = open(folder / "virtual_arena.log", "w+")  # noqa: SIM115 - closed by close()
        self._process = subprocess.Popen(
            [sys.executable, "-m", "crazyarena.runner.rig.virtual_arena", json.dumps(config)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            text=True,
        )
        try:
            told = self._line(_START_TIMEOUT)
            self.uri, self.air = str(told["uri"]), str(told["air"])
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> VirtualArena:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    @property
    def pid(self) -> int:
        """Process id of the child."""
        return self._process.pid

    def _line(self, timeout: float) -> dict[str, Any]:
        assert self._process.stdout is not None
        deadline = time.monotonic() + timeout
        ready, _, _ = select.select([self._process.stdout], [], [], deadline - time.monotonic())
        line = self._process.stdout.readline() if ready else ""
        if not line:
            self._errors.seek(0)
            words = self._errors.read()[-2000:].strip() or f"silent for {timeout:g} s"
            raise BackendError(f"the virtual arena did not start: {words}")
        answer: dict[str, Any] = json.loads(line)
        return answer

    def close(self) -> None:
        """End the child; ``report`` is set. Idempotent."""
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGTERM)
            with contextlib.suppress(BackendError, ValueError):
                self.report = self._line(10.0)
            try:
                self._process.wait(timeout=10.0)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                pipe.close()
        self._errors.close()


if __name__ == "__main__":
    _serve(json.loads(sys.argv[1]))
