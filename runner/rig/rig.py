"""A rig: clock, vehicle link and pose source of one trial, however they came about.

This is the line behind which simulation and reality differ. :func:`simulated` builds the rig of
a dry run; that of a bench or arena flight is built from a radio link and a camera system by
:mod:`crazyarena.runner.rig.flight_process`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from crazyarena.clock import Clock
from crazyarena.crazyswarm_compat.backend import Backend
from crazyarena.levels.draw import Draw
from crazyarena.levels.schema import Level
from crazyarena.mocap.camera_model import CameraModel
from crazyarena.mocap.estimator import PoseEstimator
from crazyarena.mocap.forwarder import PoseForwarder
from crazyarena.mocap.pipeline import OnEvent, OnFrame, PosePipeline
from crazyarena.mocap.source import PoseSource
from crazyarena.runner.rig.safeguard import Safeguard
from crazyarena.runner.rig.watch import Guard
from crazyarena.safety.limits import Limits
from crazyarena.safety.own_estimate import OwnEstimate
from crazyarena.types import Pose

if TYPE_CHECKING:
    from crazyarena.sim_backend.arena_world import AnyTrack
    from crazyarena.sim_backend.vehicles import VehicleSupply

# Children of the trial's seed, so that the level's own draws stay what the seed says.
_RIG_STREAM = 0x51
EXTERNAL_POSE_RATE = 100.0  # Hz
_CARRIED = 0.2  # s for which a vehicle stands at its start before anybody looks
_WATCH_PERIOD = 0.005  # s, between looks at the vehicle when there are no frames


class FrameListeners:
    """Passes frames and events of a pipeline on to whoever has subscribed meanwhile."""

    def __init__(self) -> None:
        self.frames: list[OnFrame] = []
        self.events: list[OnEvent] = []

    def on_frame(self, frame: object, result: object) -> None:
        for listener in self.frames:
            listener(frame, result)  # type: ignore[arg-type]

    def on_event(self, event: object) -> None:
        for listener in self.events:
            listener(event)  # type: ignore[arg-type]


@dataclass
class Rig:
    """One vehicle in one room.

    Attributes
    ----------
    backend: behind the command gate where there is one.
    vehicle: id on the link; body: its name in the camera system.
    safeguard: None when nobody guards.
    pipeline: fed by whoever lets time pass: a thread, or the virtual clock.
    stage: called with the draw of an episode before it; what people do by hand in an arena.
    taped: poses of the track as people have measured it by other means than cameras, or None.
    renews: ``stage`` switches the vehicle off and on, so that whatever became of it in an episode
        does not keep it from the next.
    onboard: how the vehicle knows its place, if the poses are its own estimate; None where
        cameras see it.
    description: for the report.
    lost: why vehicle and cameras are out of reach for good, or None.
    """

    clock: Clock
    backend: Backend
    pipeline: PosePipeline
    listeners: FrameListeners
    vehicle: int
    body: str
    stage: Callable[[Draw], None]
    safeguard: Guard | None = None
    description: dict[str, object] = field(default_factory=dict)
    closers: list[Callable[[], None]] = field(default_factory=list)
    lost: Callable[[], str | None] = lambda: None
    taped: Callable[[], dict[str, Pose] | None] = lambda: None
    renews: bool = False
    onboard: OwnEstimate | None = None

    def close(self) -> None:
        """Release everything, last built first; idempotent."""
        while self.closers:
            self.closers.pop()()


def make_pipeline(
    source: PoseSource,
    clock: Clock,
    backend: Backend,
    bodies: dict[str, int],
    threaded: bool,
    forward: bool = True,
) -> tuple[PosePipeline, FrameListeners]:
    """Pipeline that forwards the poses of ``bodies`` (name to vehicle id) to the vehicles; not
    those that they have told themselves (``forward`` False)."""
    listeners = FrameListeners()
    forwarder = None
    if forward:
        forwarder = PoseForwarder(
            bodies,
            backend.send_external_poses,
            clock,
            rate=EXTERNAL_POSE_RATE,
            threaded=threaded,
        )
    pipeline = PosePipeline(
        source,
        PoseEstimator(tuple(bodies)),
        clock,
        forwarder=forwarder,
        on_frame=(listeners.on_frame,),
        on_event=(listeners.on_event,),
    )
    return pipeline, listeners


def simulated(
    level: Level,
    seed: int,
    cameras: CameraModel | None = None,
    limits: Limits | None = None,
    guarded: bool = True,
    supply: VehicleSupply | None = None,
    deck: str | None = None,
    track: Callable[[Draw], AnyTrack] | None = None,
    params: Mapping[str, float] | None = None,
) -> Rig:
    """The rig of a dry run: everything in this process, in virtual time.

    ``supply`` is of the vehicles that fly; that of the level if not given. With a positioning
    ``deck`` there are no cameras, and what is known of the vehicle is its own estimate.
    ``track`` builds the track of a draw, and ``params`` are written to the vehicle, as
    :class:`~crazyarena.sim_backend.arena_world.SimulatedArena` takes them.
    """
    from crazyarena.sim_backend.arena_world import SimulatedArena, motions
    from crazyarena.sim_backend.vehicles import level_supply

    rng = np.random.default_rng([seed, _RIG_STREAM])
    if supply is None:
        supply = level_supply(level, seed)
    arena = SimulatedArena(
        rng,
        cameras=cameras,
        motions=motions(level),
        supply=supply,
        nominal=level.vehicle,
        deck=deck,
        track=track,
        params=params,
    )
    onboard = None
    if deck is not None:
        vehicle = arena.vehicle
        onboard = OwnEstimate.of(lambda name: arena.link.get_param(vehicle, name), {})
    safeguard = None
    backend: Backend = arena.link
    if guarded:
        safeguard = Safeguard(
            level,
            arena.link,
            arena.clock,
            arena.vehicle,
            arena.body,
            limits=limits,
            feed=arena.link.feed_watchdog,
            independent=onboard is None,
        )
        backend = safeguard.gate.runner
    pipeline, listeners = make_pipeline(
        arena.source,
        arena.clock,
        backend,
        {arena.body: arena.vehicle},
        threaded=False,
        forward=onboard is None,
    )
    if safeguard is not None:
        safeguard.watch(pipeline)
        listeners.frames.append(safeguard.on_frame)

    stepped = 0.0

    def advance(now: float) -> None:
        nonlocal stepped
        frames = pipeline.poll()
        if safeguard is not None and (frames or now - stepped >= _WATCH_PERIOD):
            stepped = now
            safeguard.watchdog.step()

    arena.clock.on_advance(advance)

    staged = False

    def stage(draw: Draw) -> None:
        nonlocal staged
        arena.stage(draw)
        if staged:
            if safeguard is not None:
                safeguard.renew()  # else its keepalive would go on with the new vehicle
            # Frames of where it was are still on their way.
            arena.clock.sleep_until(arena.clock.now() + _CARRIED)
        staged = True
        if supply.spread:
            flown.append(supply.told())
        # The vehicle was carried: where it was says nothing of where it is.
        pipeline.estimator.reset(arena.body)
        if safeguard is not None:
            safeguard.renew()

    model = arena.source.model
    flown: list[dict[str, object]] = []
    return Rig(
        arena.clock,
        backend,
        pipeline,
        listeners,
        arena.vehicle,
        arena.body,
        stage,
        safeguard,
        {
            "backend": "sim",
            "vehicle": supply.vehicle.name,
            "vehicles": flown,
            "mocap": "sim" if deck is None else f"onboard ({deck})",
            "mocap_rate": model.rate,
            "mocap_latency": model.latency,
            "mocap_position_noise": model.position_noise,
        },
        [arena.close, pipeline.close, *([] if safeguard is None else [safeguard.close])],
        renews=True,
        onboard=onboard,
        taped=arena.track_poses if deck is not None else lambda: None,
    )
