"""One flight of the fault campaign, in virtual time."""

from __future__ import annotations

import contextlib
import math
import random
from collections.abc import Callable
from typing import Any

import numpy as np

from crazyarena.clock import VirtualClock
from crazyarena.crazyswarm_compat import commands as c
from crazyarena.errors import CommandError, InputError
from crazyarena.levels import Level
from crazyarena.mocap.camera_model import CameraModel
from crazyarena.mocap.estimator import PoseEstimator
from crazyarena.mocap.forwarder import PoseForwarder
from crazyarena.mocap.pipeline import PosePipeline
from crazyarena.mocap.sim_source import SimSource
from crazyarena.runner.campaign.attitude_pilot import AttitudePilot
from crazyarena.runner.campaign.cameras import FaultyCameras
from crazyarena.runner.campaign.excursion import Excursion
from crazyarena.runner.campaign.faults import ALL_FAULTS
from crazyarena.runner.campaign.link import FleetLink
from crazyarena.runner.campaign.outcome import Outcome
from crazyarena.runner.campaign.plan import draw_plan
from crazyarena.runner.campaign.setting import (
    BODY,
    BOOT,
    LAND_TIME,
    MISSION,
    OTHER,
    PATIENCE,
    RATE,
    VEHICLE,
)
from crazyarena.safety.events import Action
from crazyarena.safety.fence import Fence
from crazyarena.safety.gate import CommandGate
from crazyarena.safety.limits import Limits
from crazyarena.safety.monitors import CRASHED, LOCKED
from crazyarena.safety.watchdog import Watchdog
from crazyarena.sim_backend.arena import ArenaFleet, SensorNoise
from crazyarena.sim_backend.arena_params import YAW_MODE
from crazyarena.sim_backend.physics.competition_step import B_VEL, P_MASS
from crazyarena.sim_backend.vehicles import VehicleChoice
from crazyarena.types import Pose

_QUANTUM = 0.002  # s, of virtual time between looks at everything


class Flight:
    """One flight of the campaign; public members are what faults change.

    Parameters
    ----------
    fault: name in :data:`.faults.ALL_FAULTS`.
    seed: of everything random in it.
    level: its arena is flown in.
    limits: in place of those of the fault; vehicle: what flies, drawn from its spread.
    """

    def __init__(
        self,
        fault: str,
        seed: int,
        level: Level,
        limits: Limits | None = None,
        vehicle: VehicleChoice | None = None,
    ) -> None:
        if fault not in ALL_FAULTS:
            raise InputError(f"fault {fault!r}: choose from {', '.join(ALL_FAULTS)}")
        self.fault = fault
        self.seed = seed
        self.body, self.other = BODY, OTHER
        plan = draw_plan(fault, seed, vehicle)
        kind = ALL_FAULTS[fault]
        self.rng = plan.rng
        # Attitudes mean something else to the other controller's loops.
        self.mellinger = plan.mellinger or kind.attitude
        self.circuit = plan.circuit
        self.onset = plan.rng.uniform(BOOT + 0.05, plan.struck) if kind.early else plan.struck
        self._early = kind.early
        self._by_attitude: AttitudePilot | None = None
        self.fence = Fence.from_arena(level.arena)
        self.clock = VirtualClock()
        self.fleet = ArenaFleet(
            [plan.start],
            vehicles=plan.vehicle,
            noise=SensorNoise(gyro=0.1, accelerometer=0.005, force=0.0),
            rng=np.random.default_rng([seed, 1]),
        )
        self.fleet.set_param(0, "stabilizer.controller", 2 if self.mellinger else 1)
        if kind.attitude:
            self.fleet.set_param(0, YAW_MODE, 1)
            self._by_attitude = AttitudePilot(plan.lift)
        self.link = FleetLink(self.fleet, self.clock, random.Random(seed))
        source = SimSource(
            self.clock, self._truth, CameraModel(rate=100.0), np.random.default_rng([seed, 2])
        )
        self.cameras = FaultyCameras(source, self.clock)
        self.gate = CommandGate(
            self.link,
            self.fence,
            self.clock,
            plan.limits(limits or ALL_FAULTS[fault].limits),
            state=self._believed,
        )
        forwarder = PoseForwarder({BODY: VEHICLE}, self.gate.send_external_poses, self.clock)
        self.watchdog: Watchdog
        self.pipeline = PosePipeline(
            self.cameras,
            PoseEstimator([BODY, OTHER]),
            self.clock,
            forwarder=forwarder,
            on_frame=[lambda frame, result: self.watchdog.on_frame(frame, result)],
        )
        self.watchdog = Watchdog(
            self.gate,
            self.fence,
            self.clock,
            {BODY: VEHICLE},
            self.pipeline.estimate,
            feed=self.link.feed,
            props=(OTHER,),
            grounds={VEHICLE: float(plan.start[2])},
        )
        self.ground_station_alive = True
        self.contestant: Callable[[float], c.Command | None] | None = None
        self.silence_is_an_answer = False
        self.stall = 0.0
        self.gust = np.zeros(3)
        self.each: Callable[[float], None] | None = None
        self._excursion = Excursion(self.fence)

    # What faults use

    @property
    def setpoint(self) -> c.FullState:
        """What the contestant's own flight wants now."""
        return self.circuit.at(self.clock.now() - BOOT)

    def position(self) -> np.ndarray:
        """True position, m."""
        return self.fleet.true_state(0).position

    # The flight

    def run(self) -> Outcome:
        """Fly until the motors are off for good, or patience ends."""
        struck = False
        next_step = BOOT
        landing = False
        speed = 0.0
        off_since: float | None = None
        flown = False
        end = MISSION + LAND_TIME + PATIENCE
        now = 0.0
        while now < end:
            self.clock.sleep_until(now)
            if not struck and now >= self.onset:
                struck = True
                speed = float(np.linalg.norm(self.fleet.true_state(0).velocity))
                ALL_FAULTS[self.fault].strike(self)
            if struck and self.each is not None:
                self.each(now - self.onset)
            self.link.deliver()
            if self.ground_station_alive:
                frames = self.pipeline.poll()
                if frames or now - self._watched_at() >= 0.005:
                    self.watchdog.step()
                    self._stepped = now
                if now >= next_step:
                    if self.stall > 0.0:
                        next_step = now + self.stall
                        self.stall = 0.0
                    else:
                        self.watchdog.step_late(max(0.0, now - next_step))
                        landing = self._control(now, landing)
                        next_step = max(next_step + 1.0 / RATE, now - 1.0 / RATE)
            self.fleet.advance(round(_QUANTUM * 1000))
            if self.gust.any():
                mass = self.fleet.plants[0, P_MASS]
                self.fleet.bodies[0, B_VEL : B_VEL + 3] += self.gust / mass * _QUANTUM
            state = self.fleet.true_state(0)
            turning = bool(self.fleet.rows(0).motors.any())
            # What goes wrong from the take-off on may never get high.
            flown = flown or state.position[2] > 0.3 or (self._early and struck and turning)
            off = flown and not turning
            self._excursion.see(state, off)
            off_since = (now if off_since is None else off_since) if off else None
            if struck and self._excursion.lies and off_since is not None and now - off_since > 0.5:
                break
            now += _QUANTUM
        return self._outcome(off_since, speed)

    _stepped = -math.inf

    def _watched_at(self) -> float:
        return self._stepped

    def _control(self, now: float, landing: bool) -> bool:
        if self.watchdog.action(VEHICLE).takes_over:
            return True
        if now >= BOOT + MISSION and not landing:
            self.watchdog.controller_done(VEHICLE)
            self._try(c.Land(0.0, LAND_TIME))
            self._try(c.NotifySetpointsStop())
            return True
        if landing:
            return True
        if self.contestant is None:
            self._try(self._usual(now))
            self.watchdog.controller_answered(VEHICLE)
        else:
            command = self.contestant(now)
            if command is not None:
                self._try(command)
            if command is not None or self.silence_is_an_answer:
                self.watchdog.controller_answered(VEHICLE)
        return False

    def _usual(self, now: float) -> c.Command:
        """What the contestant asks for until the fault sets in."""
        pilot, state = self._by_attitude, self._believed(VEHICLE)
        if pilot is None or state is None:
            return self.setpoint
        return pilot.command(now, state, self.setpoint)

    def _try(self, command: c.Command) -> None:
        with contextlib.suppress(CommandError):  # counted by the gate
            self.gate.runner.send(command, VEHICLE)

    def _truth(self, time: float) -> dict[str, Pose]:
        other = Pose(np.array([2.6, 2.6, 0.03]))
        return {BODY: self.fleet.true_pose(0), OTHER: other}

    def _believed(self, vehicle: int) -> Any:
        estimate = self.pipeline.estimate(BODY)
        return estimate.state if estimate.age < 0.3 else self.link.telemetry(vehicle).state

    def _outcome(self, off_since: float | None, speed: float) -> Outcome:
        events = self.watchdog.events
        action = self.watchdog.action(VEHICLE)
        taken = [e.rule for e in events if e.action.takes_over]
        end = "flying"
        if off_since is not None:
            # The firmware alone knows whether it was locked in the air.
            locked = bool(self.fleet.supervisor_info(0) & (LOCKED | CRASHED))
            end = "cut" if action is Action.CUT or locked else "landed"
        return Outcome(
            self.fault,
            self.seed,
            self._excursion.worst,
            math.inf if off_since is None else max(0.0, off_since - self.onset),
            end,
            int(action),
            taken[0] if taken else "",
            speed,
            self.onset,
            list(events),
        )
