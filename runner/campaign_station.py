"""The ground station of a campaign flight over UDP, in a process that can be killed.

``python -m crazyarena.runner.campaign_station`` talks as :mod:`.json_child` does. It is told
``fault``, ``seed`` and ``level_file``, then ``uri`` and ``endpoint`` once there is a vehicle. It
makes the vehicle ready as a trial does, answers ``ready``, is told ``go``, the host's time of the
take-off, and flies a contestant's circuit until nobody speaks to it any more. Meanwhile it tells
of every event of the watchdog.
"""

from __future__ import annotations

import contextlib
import math
import queue
import threading
from collections.abc import Callable
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, cast

import numpy as np

from crazyarena.clock import Clock, WallClock
from crazyarena.crazyswarm_compat import commands as c
from crazyarena.crazyswarm_compat.config import FleetConfig, VehicleConfig
from crazyarena.crazyswarm_compat.radio.backend import RadioBackend
from crazyarena.crazyswarm_compat.radio.options import RadioOptions
from crazyarena.crazyswarm_compat.radio.outbox import OutboxOptions
from crazyarena.errors import CommandError
from crazyarena.levels import Level, load_level
from crazyarena.mocap.stamps import HostStamps
from crazyarena.mocap.zenoh_link import ZenohSource
from crazyarena.runner.campaign import _LAND_TIME, _MISSION, _RATE, BODY, FAULTS, VEHICLE
from crazyarena.runner.campaign_plan import Plan, draw_plan
from crazyarena.runner.crew import Crew, Timeouts
from crazyarena.runner.json_child import Message, Tell, converse
from crazyarena.runner.realtime import quiet_collector, raise_priority
from crazyarena.runner.rig import EXTERNAL_POSE_RATE, Rig, make_pipeline
from crazyarena.runner.safeguard import Safeguard, limits_for
from crazyarena.runner.scheduler import Scheduler
from crazyarena.runner.tracked_world import TrackedWorld
from crazyarena.safety.limits import PID_BRAKING, Limits

if TYPE_CHECKING:
    from crazyarena.runner.campaign import Flight

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


class Station:
    """Flies one contestant over a rig; public members are what faults use and change."""

    def __init__(self, fault: str, plan: Plan, rig: Rig, guard: Safeguard, tell: Tell) -> None:
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
        self._guard = guard
        self._tell = tell
        self._told = 0
        self._start = math.inf
        self._landing = False
        self._struck = False

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
        scheduler = Scheduler(self.clock, _RATE)
        while not ended.is_set():
            self._control(self.clock.now())
            if self.stall > 0.0:
                self.clock.sleep_until(self.clock.now() + self.stall)
                self.stall = 0.0
            self._guard.late(scheduler.wait())
            self._tell_events()

    def _control(self, now: float) -> None:
        if not self._struck and now >= self.onset:
            self._struck = True
            if self._fault in STRIKES:
                FAULTS[self._fault].strike(cast("Flight", self))
        # What a fault does time and again it does where the radio is, if that is part of it.
        if self.each is not None and self._fault == "late_scheduler":
            self.each(now - self.onset)
        if self._landing or self._guard.watchdog.action(VEHICLE).takes_over:
            return
        if now >= self._start + _MISSION:
            self._landing = True
            self._guard.watchdog.controller_done(VEHICLE)
            self._send(c.NotifySetpointsStop())
            self._send(c.Land(0.0, _LAND_TIME))
            return
        command = self.setpoint if self.contestant is None else self.contestant(now)
        if command is not None:
            self._send(command)
        if command is not None or self.silence_is_an_answer:
            self._guard.answered()

    def _send(self, command: c.Command) -> None:
        with contextlib.suppress(CommandError):  # counted by the gate
            self._rig.backend.send(command, VEHICLE)

    def _tell_events(self) -> None:
        events = self._guard.watchdog.events
        while self._told < len(events):
            event = asdict(events[self._told])
            self._tell({"event": {**event, "time": event["time"] - self._start}})
            self._told += 1


def _limits(level: Level, plan: Plan) -> Limits:
    limits = limits_for(level.control_frequency, _MISSES)
    return limits if plan.mellinger else replace(limits, braking=PID_BRAKING)


def _connect(level: Level, uri: str, endpoint: str, limits: Limits) -> tuple[Rig, Safeguard]:
    """Vehicle link, cameras and safety of an arena, all in this process, running."""
    clock = WallClock()
    x, y, z = level.start.position
    config = VehicleConfig(id=VEHICLE, name=BODY, initial_position=(x, y, z), uri=uri)
    options = RadioOptions(outbox=OutboxOptions(extpose_rate=2.0 * EXTERNAL_POSE_RATE))
    with contextlib.ExitStack() as undo:
        source = ZenohSource(clock, connect=[endpoint])
        undo.callback(source.close)
        backend = RadioBackend(FleetConfig((config,), "campaign"), clock, options)
        undo.callback(backend.close)
        guard = Safeguard(
            level, backend, clock, VEHICLE, BODY, limits=limits, feed=backend.arm_watchdog
        )
        undo.callback(guard.close)
        pipeline, listeners = make_pipeline(
            source, clock, guard.gate.runner, {BODY: VEHICLE}, threaded=True
        )
        undo.callback(pipeline.close)
        guard.watch(pipeline)
        listeners.frames.append(guard.on_frame)
        pipeline.start()
        guard.watchdog.start()
        rig = Rig(
            clock,
            guard.gate.runner,
            pipeline,
            listeners,
            VEHICLE,
            BODY,
            lambda draw: None,
            guard,
            closers=[undo.pop_all().close],
        )
        return rig, guard
    raise AssertionError("unreachable")


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
    plan = draw_plan(config["fault"], config["seed"])
    level = load_level(config["level_file"])

    raise_priority(inherit=True)
    rig, guard = _connect(level, place["uri"], place["endpoint"], _limits(level, plan))
    with contextlib.closing(rig), quiet_collector():
        _ready(rig, level, plan)
        station = Station(config["fault"], plan, rig, guard, tell)
        tell({"ready": True})
        go = heard.get()
        if go is None:
            return
        ended = threading.Event()

        def listen() -> None:
            while heard.get() is not None:
                pass
            ended.set()

        threading.Thread(target=listen, name="listen", daemon=True).start()
        station.fly(HostStamps(rig.clock).to_session(go["go"]), ended)


if __name__ == "__main__":
    converse(_run)
