"""What ``crazyarena virtual-cf`` runs: a swarm, its world and its link, from options as typed."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass, field

import numpy as np

from crazyarena.clock import WallClock
from crazyarena.crazyswarm_compat.config import load_crazyflies
from crazyarena.errors import InputError
from crazyarena.levels.draw import LevelRandom
from crazyarena.levels.load import load_level
from crazyarena.mocap.camera_model import CameraModel
from crazyarena.mocap.sim_source import SimSource
from crazyarena.mocap.zenoh_link import ZenohPublisher
from crazyarena.sim_backend.arena import ArenaFleet
from crazyarena.sim_backend.crazyradio.air import Air
from crazyarena.sim_backend.crazyradio.fleet import parse_plan, put_on_air
from crazyarena.sim_backend.crazyradio.gateway import Gateway
from crazyarena.sim_backend.crazyradio.wire import DEFAULT_PORT
from crazyarena.sim_backend.crtp import faults as ft
from crazyarena.sim_backend.crtp.film import IdealCameras
from crazyarena.sim_backend.crtp.link import BASE_PORT
from crazyarena.sim_backend.crtp.orders import obey
from crazyarena.sim_backend.crtp.server import VirtualServer
from crazyarena.sim_backend.crtp.swarm import VirtualSwarm
from crazyarena.sim_backend.crtp.toc import Table
from crazyarena.sim_backend.decks import make_deck
from crazyarena.sim_backend.physics.scene import build_scene
from crazyarena.sim_backend.vehicles import VehicleChoice, resolve, vehicle_rows

MAX_VEHICLES = 100
_SPACING = 0.5  # m, between vehicles on the ground


@dataclass(frozen=True, slots=True)
class Options:
    """Options of ``virtual-cf``; the texts are parsed by :func:`build`.

    count vehicles of the model ``vehicle`` from ``port`` on; ``level`` puts gates and obstacles
    into the world and the first vehicle at its start. ``feed_poses`` Hz, 0 for none. ``mocap``
    publishes the poses over zenoh at ``mocap_rate`` Hz on ``mocap_endpoint``, as ideal cameras see
    them or, with ``camera_noise``, as real ones do. ``radio`` puts the vehicles on the air instead
    of UDP ports, on these channels, for programs whose dongles look for it on ``radio_port``.
    ``table`` is whose parameters and log variables they have; by the vehicle if left out. ``fleet``
    is a vehicle list of Crazyswarm 1 or 2: how many, their numbers and where they stand. ``deck``
    is a positioning deck that each carries, see :mod:`crazyarena.sim_backend.decks`.
    """

    count: int = 1
    host: str = "127.0.0.1"
    port: int = BASE_PORT
    level: str | None = None
    vehicle: VehicleChoice = field(default_factory=VehicleChoice)
    loss: str | None = None
    latency: str | None = None
    battery: str | None = None
    safe_link: bool = True
    feed_poses: float = 0.0
    mocap: bool = True
    mocap_endpoint: str = "tcp/127.0.0.1:7447"
    mocap_rate: float = 120.0
    camera_noise: bool = False
    seed: int = 0
    radio: bool = False
    channel: str = "80"
    rate: str = "2M"
    dongles: int = 1
    radio_port: int = DEFAULT_PORT
    table: str | None = None
    fleet: str | None = None
    deck: str | None = None


def starts(count: int, first: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """Places on the ground (count, 3) m: rows of ten to the left of and behind the first."""
    places = np.zeros((count, 3))
    for index in range(count):
        places[index, 0] = first[0] - _SPACING * (index // 10)
        places[index, 1] = first[1] + _SPACING * (index % 10)
    return places


class Host:
    """A running set of virtual vehicles and the publisher of their poses."""

    def __init__(
        self,
        server: VirtualServer,
        publisher: ZenohPublisher | None,
        gateway: Gateway | None = None,
    ) -> None:
        self.server = server
        self.gateway = gateway
        self._publisher = publisher

    @property
    def air(self) -> Air | None:
        """What the dongles send on, None over UDP."""
        return None if self.gateway is None else self.gateway.air

    def close(self) -> None:
        """Release ports and session; idempotent."""
        if self.gateway is not None:
            self.gateway.close()
        self.server.close()
        if self._publisher is not None:
            self._publisher.close()
            self._publisher = None

    def command(self, line: str) -> str:
        """Inject a fault by a line of text; returns what was done, as :func:`.orders.obey`."""
        return obey(self.server, self.air, line)


def _say_behind(seconds: float) -> None:
    print(
        f"virtual-cf: {seconds:.1f} s behind real time: this computer is too busy; vehicles and "
        "cameras look late and jerky to whoever flies them (fewer vehicles, or other programs?)",
        file=sys.stderr,
        flush=True,
    )


def build(options: Options) -> Host:
    """Make everything, compile the kernels, listen; the server is not started yet.

    Raises
    ------
    InputError: an option is wrong or a port is taken.
    """
    if not 1 <= options.count <= MAX_VEHICLES:
        raise InputError(f"--count: found {options.count}; need 1 to {MAX_VEHICLES}")
    if not 0.0 <= options.feed_poses <= 1000.0:
        raise InputError(f"--feed-poses: found {options.feed_poses}; need 0 to 1000 Hz")
    faults = ft.Faults(safe_link=options.safe_link)
    if options.loss is not None:
        faults.loss = ft.parse_share(options.loss)
    if options.latency is not None:
        faults.latency, faults.jitter = ft.parse_latency(options.latency)
    volts = None if options.battery is None else ft.parse_volts(options.battery)
    plan = parse_plan(options.channel, options.rate, options.dongles) if options.radio else None

    scene, first = None, (0.0, 0.0)
    yaw = 0.0
    if options.level is None:
        model = options.vehicle.load()
    else:
        level, model = resolve(load_level(options.level), options.vehicle)
        draw = LevelRandom(level).reset()
        scene = build_scene(draw.gates.tolist(), draw.obstacles.tolist())
        first = (float(draw.start[0]), float(draw.start[2]))
        yaw = float(draw.start[8])
    if options.table is None:
        table = Table.CF21_BRUSHLESS if model.name.startswith("cf21b") else Table.CF21
    elif options.table in set(Table):
        table = Table(options.table)
    else:
        raise InputError(f"--table: found {options.table!r}; choose {', '.join(Table)}")
    places, ids, uris = starts(options.count, first), None, None
    if options.fleet is not None:
        if options.level is not None or options.count != 1:
            raise InputError(
                "--fleet: says how many vehicles there are, and where; leave out "
                "--count and --level"
            )
        listed = load_crazyflies(options.fleet).vehicles
        places = np.array([(*vehicle.initial_position[:2], 0.0) for vehicle in listed])
        ids = [vehicle.id for vehicle in listed]
        uris = [vehicle.uri for vehicle in listed]
    fleet = ArenaFleet(
        places,
        np.full(len(places), yaw),
        ids=ids,
        vehicles=vehicle_rows(model),
        scene=scene,
    )
    if options.deck is not None:
        for index, rng in enumerate(np.random.default_rng(options.seed).spawn(len(fleet))):
            fleet.decks.fit(index, make_deck(options.deck, rng))
    # The first tick compiles the kernels, which must not happen in flight.
    fleet.advance(1)
    swarm = VirtualSwarm(fleet, feed_rate=options.feed_poses, table=table)
    for vehicle in swarm.vehicles:
        vehicle.warm_up()

    clock = WallClock()
    cameras: SimSource | IdealCameras | None = None
    publisher = None
    if options.mocap:
        rate = options.mocap_rate
        if not (math.isfinite(rate) and 0.0 < rate <= 500.0):
            raise InputError(f"--mocap-rate: found {rate}; need up to 500 Hz")
        publisher = ZenohPublisher(clock, listen=[options.mocap_endpoint])
        if options.camera_noise:
            cameras = SimSource(clock, model=CameraModel(rate=rate), seed=options.seed)
        else:
            cameras = IdealCameras(clock.now(), rate)
    gateway, links = None, None
    try:
        if plan is not None:
            links, air = put_on_air(fleet.ids, clock, plan, faults, options.seed, uris)
            gateway = Gateway(air, clock, options.host, options.radio_port)
        server = VirtualServer(
            swarm,
            options.host,
            options.port,
            links=links,
            faults=faults,
            clock=clock,
            cameras=cameras,
            publisher=publisher,
            seed=options.seed,
            on_behind=_say_behind,
        )
    except InputError:
        if publisher is not None:
            publisher.close()
        raise
    if volts is not None:
        server.set_battery(volts)
    return Host(server, publisher, gateway)
