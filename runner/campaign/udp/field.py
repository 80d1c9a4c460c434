"""The far side of a campaign flight over UDP: vehicle, radio and cameras, in a process of its own.

``python -m crazyarena.runner.campaign.udp.field`` talks as :mod:`.json_child`
does. It is told ``fault``, ``seed``, ``level_file`` and ``radio``, answers with ``uri``,
``endpoint`` and ``air``, is told ``go``, the host's time of the take-off, and answers at the end
with what truly happened. It serves until nobody speaks to it any more.
"""

from __future__ import annotations

import math
import queue
import socket
import threading
from collections.abc import Callable
from typing import cast

import numpy as np

from crazyarena.clock import Clock, WallClock
from crazyarena.crazyswarm_compat import commands as c
from crazyarena.errors import InputError
from crazyarena.levels import load_level
from crazyarena.mocap.camera_model import CameraModel
from crazyarena.mocap.sim_source import SimSource
from crazyarena.mocap.stamps import HostStamps
from crazyarena.mocap.zenoh_link import ZenohPublisher
from crazyarena.runner.campaign.cameras import FaultyCameras
from crazyarena.runner.campaign.excursion import Excursion
from crazyarena.runner.campaign.faults import FAULTS
from crazyarena.runner.campaign.plan import Plan, planned
from crazyarena.runner.campaign.setting import BODY, LAND_TIME, MISSION, OTHER, PATIENCE, VEHICLE
from crazyarena.runner.campaign.strikes.struck import Struck
from crazyarena.runner.campaign.udp.devices import LOOK_MS, ArenaCameras, FaultyRadio, Witness
from crazyarena.runner.campaign.udp.json_child import Message, Tell, converse
from crazyarena.runner.timing.realtime import SERVING, raise_priority
from crazyarena.safety.fence import Fence
from crazyarena.safety.monitors import CRASHED, LOCKED
from crazyarena.sim_backend.arena import ArenaFleet
from crazyarena.sim_backend.arena_world import sensor_noise
from crazyarena.sim_backend.crazyradio.fleet import put_on_air
from crazyarena.sim_backend.crazyradio.gateway import Gateway
from crazyarena.sim_backend.crtp.faults import Faults
from crazyarena.sim_backend.crtp.server import VirtualServer
from crazyarena.sim_backend.physics.competition_step import B_VEL, P_MASS

# What befalls cameras, radio and vehicle; the rest befalls the ground station.
STRIKES = frozenset(
    {
        "mocap_dropout",
        "mocap_freeze",
        "mocap_hiccup",
        "mocap_jump",
        "latency_growth",
        "radio_loss",
        "radio_burst",
        "radio_cut",
        "radio_cut_at_wall",
        "battery_sag",
        "motor_failure",
        "wind_gust",
    }
)
_RADIO = Faults(latency=0.006, jitter=0.003)  # one way
_CAMERA_RATE = 100.0  # Hz
_PORTS = 5  # tried, until one is free


class Field:
    """One flight as it truly is; public members are what faults use and change.

    Parameters
    ----------
    on_end: called once with the report, when the motors are off for good or patience ends.
    """

    def __init__(
        self,
        fault: str,
        plan: Plan,
        fence: Fence,
        clock: Clock,
        fleet: ArenaFleet,
        cameras: FaultyCameras,
        radio: FaultyRadio,
        on_end: Callable[[Message], None],
    ) -> None:
        self.seed = plan.seed
        self.body, self.other = BODY, OTHER
        self.rng = plan.rng
        self.fence = fence
        self.clock = clock
        self.fleet = fleet
        self.cameras = cameras
        self.link = radio
        self.gust = np.zeros(3)
        self.each: Callable[[float], None] | None = None
        # Of the ground station, which strikes its own faults itself.
        self.contestant: Callable[[float], c.Command | None] | None = None
        self.silence_is_an_answer = False
        self.onset = math.inf
        self._fault = fault
        self._plan = plan
        self._on_end = on_end
        self._start = math.inf
        self._looked = clock.now()
        self._struck = False
        self._flown = False
        self._over = False
        self._off_since: float | None = None
        self._speed = 0.0
        self._excursion = Excursion(self.fence)

    def begin(self, start: float) -> None:
        """The take-off is at ``start`` s on the clock; any thread."""
        self.onset = start + self._plan.onset
        self._start = start

    @property
    def setpoint(self) -> c.FullState:
        """What the contestant's own flight wants now."""
        return self._plan.circuit.at(self.clock.now() - self._start)

    def position(self) -> np.ndarray:
        """True position, m."""
        return self.fleet.true_state(0).position

    def look(self) -> None:
        """See how it goes, and let the fault set in when it is time."""
        now = self.clock.now()
        if now < self._start or self._over:
            return
        state = self.fleet.true_state(0)
        if not self._struck and now >= self.onset:
            self._struck = True
            self._speed = float(np.linalg.norm(state.velocity))
            if self._fault in STRIKES:
                FAULTS[self._fault].strike(cast(Struck, self))
        if self._struck and self.each is not None:
            self.each(now - self.onset)
        if self.gust.any():
            push = self.gust / self.fleet.plants[0, P_MASS] * 1e-3 * LOOK_MS
            self.fleet.bodies[0, B_VEL : B_VEL + 3] += push
        self._flown = self._flown or bool(state.position[2] > 0.3)
        off = self._flown and not self.fleet.rows(0).motors.any()
        self._excursion.see(state, off)
        self._off_since = (now if self._off_since is None else self._off_since) if off else None
        lies = self._excursion.lies
        done = self._off_since is not None and lies and now - self._off_since > 0.5
        patient = now < self._start + MISSION + LAND_TIME + PATIENCE
        if (self._struck and done) or not patient:
            self._over = True
            self._on_end(self._report())

    def _report(self) -> Message:
        since = self._off_since
        return {
            "excursion": self._excursion.worst,
            "safe_after": None if since is None else max(0.0, since - self.onset),
            "locked": bool(self.fleet.supervisor_info(0) & (LOCKED | CRASHED)),
            "speed": self._speed,
        }


def _publisher(clock: Clock) -> tuple[ZenohPublisher, str]:
    for attempt in range(_PORTS):
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
        try:
            return ZenohPublisher(clock, listen=[endpoint]), endpoint
        except InputError:  # somebody was faster
            if attempt == _PORTS - 1:
                raise
    raise AssertionError("unreachable")


def _serve(heard: queue.Queue[Message | None], tell: Tell) -> None:
    config = heard.get()
    if config is None:
        return
    seed = config["seed"]
    plan = planned(config)
    fence = Fence.from_level(load_level(config["level_file"]))
    fleet = ArenaFleet(
        [plan.start],
        ids=(VEHICLE,),
        vehicles=plan.vehicle,
        noise=sensor_noise(plan.vehicle),
        rng=np.random.default_rng([seed, 1]),
    )
    fleet.advance(1)  # compiles, which must not happen in flight
    swarm = Witness(fleet)
    for vehicle in swarm.vehicles:
        vehicle.warm_up()
    # Real vehicles and cameras are never short of processors.
    raise_priority(SERVING, inherit=True)
    clock = WallClock()
    model = CameraModel(rate=_CAMERA_RATE)
    source = SimSource(clock, None, model, np.random.default_rng([seed, 2]))
    cameras = ArenaCameras(source, clock)
    publisher, endpoint = _publisher(clock)
    links, gateway = None, None
    if config["radio"]:
        links, air = put_on_air(fleet.ids, clock, seed=seed)
        gateway = Gateway(air, clock, port=0)
    server = VirtualServer(
        swarm,
        port=0,
        links=links,
        faults=_RADIO,
        clock=clock,
        cameras=cameras,
        publisher=publisher,
        seed=seed,
    )

    def report(what: Message) -> None:
        tell({**what, "worst_ms": server.pace.worst})

    field = Field(config["fault"], plan, fence, clock, fleet, cameras, FaultyRadio(server), report)
    swarm.look = field.look

    def listen() -> None:
        stamps = HostStamps(clock)
        while (message := heard.get()) is not None:
            field.begin(stamps.to_session(message["go"]))
        server.stop()

    threading.Thread(target=listen, name="listen", daemon=True).start()
    air_at = "" if gateway is None else gateway.address
    tell({"uri": server.uris[0], "endpoint": endpoint, "air": air_at})
    try:
        server.run()
    finally:
        if gateway is not None:
            gateway.close()
        server.close()
        publisher.close()


if __name__ == "__main__":
    converse(_serve)
