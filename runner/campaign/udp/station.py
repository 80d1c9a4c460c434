"""The ground station of a campaign flight over UDP, in a process that can be killed.

``python -m crazyarena.runner.campaign.udp.station`` talks as :mod:`.json_child` does. It
is told ``fault``, ``seed`` and ``level_file``, then ``uri`` and ``endpoint`` once there is
a vehicle. It connects as ``crazyarena fly`` does, with a flight process, makes the vehicle ready,
answers ``ready``, is told ``go``, the host's time of the take-off, and flies a contestant's circuit
until it is told to end; then it tells what the watchdog has done.
"""

from __future__ import annotations

import contextlib
import math
import queue
import threading
from collections.abc import Callable
from dataclasses import asdict
from typing import cast

import numpy as np

from crazyarena.clock import Clock, WallClock
from crazyarena.crazyswarm_compat import commands as c
from crazyarena.errors import CommandError
from crazyarena.levels import Level, load_level
from crazyarena.mocap.opening import SourceSpec
from crazyarena.mocap.stamps import HostStamps
from crazyarena.runner.campaign.faults import FAULTS
from crazyarena.runner.campaign.plan import Plan, planned
from crazyarena.runner.campaign.setting import BODY, LAND_TIME, MISSION, RATE, VEHICLE
from crazyarena.runner.campaign.strikes.struck import Struck
from crazyarena.runner.campaign.udp.json_child import Message, Tell, converse
from crazyarena.runner.rig.flight_process.client import connected
from crazyarena.runner.rig.rig import Rig
from crazyarena.runner.rig.safeguard import limits_for
from crazyarena.runner.timing.realtime import quiet_collector
from crazyarena.runner.timing.scheduler import Scheduler
from crazyarena.runner.timing.steady import steady
from crazyarena.runner.trial.phase import Timeouts
from crazyarena.runner.trial.phases import Crew
from crazyarena.runner.trial.tracked_world import TrackedWorld
from crazyarena.safety.events import SafetyEvent
from crazyarena.safety.fence import Fence
from crazyarena.safety.limits import Limits
from crazyarena.sim_backend.crazyradio.environment import with_dongles

# What befalls the contestant and the control loop.
STRIKES = frozenset(
    {
        "radio_cut_at_wall",
        "outside",
        "straight_up",
        "wall",
        "wall_velocity",
        "position_step",
        "nan",
        "silent",
        "stuck",
        "oscillating",
        "late_scheduler",
    }
)
_MISSES = 15  # as `crazyarena fly` has it
_PID = 1


class FaultyLink:
    """Stands for the radio, whose faults are struck on its far side."""

    loss = 0.0
    cut = False


def _hang(seconds: float) -> None:
    """Not on the rig's clock, which lives on while somebody waits."""
    WallClock().sleep_until(seconds)


class Station:
    """Flies one contestant over a rig; public members are what faults use and change.

    ``hang(seconds)`` is what the control loop does when it is to be late.
    """

    def __init__(
        self, fault: str, plan: Plan, rig: Rig, hang: Callable[[float], None] = _hang
    ) -> None:
        assert rig.safeguard is not None
        self.rng = plan.rng
        self.clock: Clock = rig.clock
        self.link = FaultyLink()
        self.contestant: Callable[[float], c.Command | None] | None = None
        self.each: Callable[[float], None] | None = None
        self.silence_is_an_answer = False
        self.stall = 0.0
        self.onset = math.inf
        self._fault = fault
        self._plan = plan
        self._rig = rig
        self._guard = rig.safeguard
        self._hang = hang
        self._start = math.inf
        self._landing = False
        self._struck = False

    @property
    def fence(self) -> Fence:
        """That of the arena."""
        return self._guard.fence

    @property
    def setpoint(self) -> c.FullState:
        """What the contestant's own flight wants now."""
        return self._plan.circuit.at(self.clock.now() - self._start)

    def position(self) -> np.ndarray:
        """Where the cameras have it, m."""
        return self._rig.pipeline.estimate(BODY).state.position.copy()

    def fly(self, start: float, ended: threading.Event) -> None:
        """Take off at ``start`` s on the clock, and go on until ``ended``."""
        self._start = start
        self.onset = start + self._plan.onset
        self.clock.sleep_until(start)
        self._guard.begin()
        scheduler = Scheduler(self.clock, RATE)
        while not ended.is_set():
            self._control(self.clock.now())
            if self.stall > 0.0:
                self._hang(self.stall)
                self.stall = 0.0
            self._guard.late(scheduler.wait())

    def _control(self, now: float) -> None:
        if not self._struck and now >= self.onset:
            self._struck = True
            if self._fault in STRIKES:
                FAULTS[self._fault].strike(cast(Struck, self))
        # What a fault does time and again it does where the radio is, if that is part of it.
        if self.each is not None and self._fault == "late_scheduler":
            self.each(now - self.onset)
        if self._landing or self._guard.verdict() is not None:
            return
        if now >= self._start + MISSION:
            self._landing = True
            if not self._guard.end():
                self._send(c.NotifySetpointsStop())
                self._send(c.Land(0.0, LAND_TIME))
            return
        command = self.setpoint if self.contestant is None else self.contestant(now)
        if command is not None:
            self._send(command)
        if command is not None or self.silence_is_an_answer:
            self._guard.answered()

    def _send(self, command: c.Command) -> None:
        with contextlib.suppress(CommandError):  # counted by the gate
            self._rig.backend.send(command, VEHICLE)

    def record(self) -> list[SafetyEvent]:
        """What the watchdog has done."""
        return self._guard.record()


def _limits(level: Level, plan: Plan) -> Limits:
    return plan.limits(limits_for(level.control_frequency, _MISSES))


def _ready(rig: Rig, level: Level, plan: Plan) -> None:
    """The crew's work before a trial."""
    crew = Crew(rig, TrackedWorld(rig), level, timeouts=Timeouts(countdown=0.0))
    crew.prepare()
    if not plan.mellinger:
        rig.backend.send(c.SetParam("stabilizer.controller", _PID), VEHICLE)
    crew.launch()


def _run(heard: queue.Queue[Message | None], tell: Tell) -> None:
    config, place = heard.get(), heard.get()
    if config is None or place is None:
        return
    plan = planned(config)
    level = load_level(config["level_file"])

    rig = connected(
        level,
        place["uri"],
        SourceSpec("zenoh", {"connect": [place["endpoint"]]}),
        vehicle=VEHICLE,
        body=BODY,
        limits=_limits(level, plan),
        environment=with_dongles(place["air"]) if place["air"] else None,
    )
    with contextlib.closing(rig), quiet_collector(), steady(rig.clock):
        _ready(rig, level, plan)
        station = Station(config["fault"], plan, rig)
        tell({"ready": True})
        go = heard.get()
        if go is None:
            return
        ended = threading.Event()

        def listen() -> None:
            heard.get()
            ended.set()

        threading.Thread(target=listen, name="listen", daemon=True).start()
        start = HostStamps(rig.clock).to_session(go["go"])
        station.fly(start, ended)
        events = [asdict(event) for event in station.record()]
        tell({"events": [{**event, "time": event["time"] - start} for event in events]})


if __name__ == "__main__":
    converse(_run)
