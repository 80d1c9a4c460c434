"""Flights with a rigid body whose nose is not the vehicle's, in virtual time."""

from __future__ import annotations

import math
import random
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from crazyarena.clock import VirtualClock
from crazyarena.crazyswarm_compat import commands as c
from crazyarena.crazyswarm_compat.guard import FlightEnded
from crazyarena.crazyswarm_compat.options import CrazyswarmWarning
from crazyarena.levels import load_level
from crazyarena.mocap.camera_model import CameraModel
from crazyarena.mocap.estimator import PoseEstimator
from crazyarena.mocap.forwarder import PoseForwarder
from crazyarena.mocap.pipeline import PosePipeline
from crazyarena.mocap.sim_source import SimSource
from crazyarena.runner.campaign.cameras import FaultyCameras
from crazyarena.runner.campaign.flight import Flight
from crazyarena.runner.campaign.link import FleetLink
from crazyarena.runner.campaign.plan import draw_plan
from crazyarena.runner.campaign.setting import BODY, BOOT, VEHICLE
from crazyarena.safety.events import Action, SafetyEvent
from crazyarena.safety.limits import Limits
from crazyarena.safety.lookout import Lookout
from crazyarena.sim_backend.arena import ArenaFleet, SensorNoise
from crazyarena.types import Pose, PoseFrame

_RULES = ("body_turned", "body_turned_far", "yaw_apart")
_MOVES = 0.02  # m from where it stood: motion begins
_QUANTUM = 0.002  # s
_HOVER = 3.0  # s after the climb


@dataclass(frozen=True, slots=True)
class TurnedFlight:
    """What became of a flight.

    Attributes
    ----------
    warned: s of motion until the first warning about the heading; inf for none.
    told: its text, or that of the cut.
    cut: s of motion until motors were cut for the heading; inf if they were not.
    height, way: m, when they were: above the ground, and from the start in the plane.
    excursion: m beyond the hard fence, at most.
    taken: rules by which the watchdog took over.
    """

    warned: float
    told: str
    cut: float
    height: float
    way: float
    excursion: float
    taken: tuple[str, ...]


def turn(pose: Pose, angle: float) -> Pose:
    """The pose of a body whose nose points ``angle`` rad to the left of the vehicle's."""
    x, y, z, w = pose.quaternion.tolist()
    s, c = math.sin(0.5 * angle), math.cos(0.5 * angle)
    turned = np.array([x * c + y * s, y * c - x * s, z * c + w * s, w * c - z * s])
    return replace(pose, quaternion=turned)


def mirror(pose: Pose) -> Pose:
    """The pose as cameras with a left-handed world frame tell it."""
    x, y, z, w = pose.quaternion.tolist()
    return Pose(pose.position * [1.0, -1.0, 1.0], np.array([-x, y, -z, w]))


def fly_turned(
    angle: float,
    seed: int,
    *,
    turning: float = 0.0,
    mirrored: bool = False,
    climb: float | None = None,
    about: bool = False,
    limits: Limits | None = None,
) -> TurnedFlight:
    """Take off and fly with a body turned by ``angle`` rad, and by ``turning`` rad/s more from the
    take-off on: a circuit, or straight up for a metre in ``climb`` s and nothing else. The circuit
    is flown with the heading that the cameras saw on the ground, or ``about``: turning meanwhile to
    the one that they call zero."""
    flight = Flight("silent", seed, load_level("level0"), limits)
    flight.onset = math.inf  # nothing else strikes

    def spoil(frame: PoseFrame) -> PoseFrame:
        now = angle + turning * max(0.0, frame.timestamp - BOOT)
        bodies = {
            name: (mirror(pose) if mirrored else turn(pose, now)) if name == BODY else pose
            for name, pose in frame.bodies.items()
        }
        return replace(frame, bodies=bodies)

    flight.cameras.spoil = spoil
    if climb is not None:
        flight.contestant = _take_off(climb)
        flight.silence_is_an_answer = True
    elif not about:
        flight.contestant = lambda now: replace(flight.setpoint, yaw=angle)
    _take_heading(flight.fleet, angle)
    start = flight.position()
    begun, seen = math.inf, []

    def look(now: float) -> None:
        nonlocal begun
        gone = flight.position() - start
        if begun == math.inf and np.linalg.norm(gone) > _MOVES:
            begun = now
        seen.append((now, float(gone[2]), float(math.hypot(*gone[:2]))))

    flight.clock.on_advance(look)
    outcome = flight.run()
    heading = [event for event in outcome.events if event.rule in _RULES]
    warned = _first(heading, Action.WARN)
    cut = _first(heading, Action.CUT)
    at = math.inf if cut is None else cut.time
    _, height, way = next((row for row in seen if row[0] >= at), (0.0, math.nan, math.nan))
    last = cut or warned
    return TurnedFlight(
        math.inf if warned is None else max(0.0, warned.time - begun),
        "" if last is None else last.detail,
        max(0.0, at - begun) if math.isfinite(at) else math.inf,
        height,
        way,
        outcome.excursion,
        tuple(event.rule for event in outcome.events if event.severity.takes_over),
    )


def fly_unguarded(angle: float, seed: int, *, climb: float = 2.0) -> TurnedFlight:
    """Rise by a metre in ``climb`` s, go aside and land, as a script without a guard does: nothing
    but :class:`~crazyarena.safety.lookout.Lookout` looks."""
    clock, plan = VirtualClock(), draw_plan("silent", seed)
    fleet = ArenaFleet(
        [plan.start],
        vehicles=plan.vehicle,
        noise=SensorNoise(gyro=0.1, accelerometer=0.005, force=0.0),
        rng=np.random.default_rng([seed, 1]),
    )
    fleet.set_param(0, "stabilizer.controller", 2 if plan.mellinger else 1)
    _take_heading(fleet, angle)
    link = FleetLink(fleet, clock, random.Random(seed))
    source = SimSource(
        clock,
        lambda time: {BODY: turn(fleet.true_pose(0), angle)},
        CameraModel(rate=100.0),
        np.random.default_rng([seed, 2]),
    )
    lookout = Lookout(link, {BODY: VEHICLE}, clock)
    forwarder = PoseForwarder({BODY: VEHICLE}, lookout.send_external_poses, clock)
    pipeline = PosePipeline(
        FaultyCameras(source, clock),
        PoseEstimator([BODY]),
        clock,
        forwarder=forwarder,
        on_frame=[lookout.on_frame],
    )
    start = fleet.true_state(0).position
    goal = (start[0] + 0.6, start[1] + 0.3, 1.0)
    script: list[tuple[float, c.Command]] = [
        (BOOT, c.Takeoff(1.0, climb)),
        (BOOT + climb + 0.3, c.GoTo(goal, angle, 2.0)),
        (BOOT + climb + 2.5, c.Land(0.0, 2.0)),
    ]
    begun, warned, cut, told = math.inf, math.inf, math.inf, ""
    height = way = math.nan
    for step in range(round((BOOT + climb + _HOVER + 3.0) / _QUANTUM)):
        now = step * _QUANTUM
        clock.sleep_until(now)
        link.deliver()
        pipeline.poll()
        while script and now >= script[0][0]:
            link.send(script.pop(0)[1])
        gone = fleet.true_state(0).position - start
        if begun == math.inf and np.linalg.norm(gone) > _MOVES:
            begun = now
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", CrazyswarmWarning)
            try:
                lookout.check()
            except FlightEnded as end:
                cut, told = max(0.0, now - begun), str(end)  # it may be found before it moves
                height, way = float(gone[2]), float(math.hypot(*gone[:2]))
                break
        if caught and warned == math.inf:
            warned, told = now - begun, str(caught[0].message)
        fleet.advance(round(_QUANTUM * 1000))
    return TurnedFlight(warned, told, cut, height, way, math.nan, ())


def _take_heading(fleet: ArenaFleet, angle: float) -> None:
    """As preflight and crew begin: the estimator takes the heading from the cameras."""
    for name, value in (("initialYaw", angle), ("resetEstimation", 1), ("resetEstimation", 0)):
        fleet.set_param(0, f"kalman.{name}", value)
        fleet.advance(1)


def _take_off(climb: float) -> Callable[[float], c.Command | None]:
    commands = [c.Takeoff(1.0, climb)]
    return lambda now: commands.pop() if commands else None


def _first(events: list[SafetyEvent], severity: Action) -> SafetyEvent | None:
    return next((event for event in events if event.severity is severity), None)
