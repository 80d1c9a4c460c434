"""Rigs in wall time: a vehicle over its link (radio, USB or UDP), and a camera system."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack

from crazyarena.clock import WallClock
from crazyarena.crazyswarm_compat.config import FleetConfig, VehicleConfig
from crazyarena.levels.draw import Draw
from crazyarena.levels.schema import Level
from crazyarena.mocap.source import PoseSource
from crazyarena.runner.rig import EXTERNAL_POSE_RATE, Rig, make_pipeline
from crazyarena.runner.safeguard import Safeguard
from crazyarena.runner.wakeup import StampedClock
from crazyarena.safety.limits import Limits

OpenSource = Callable[[WallClock], PoseSource]


def _as_it_stands(draw: Draw) -> None:
    """In an arena nothing is drawn: people have built the track and placed the vehicle."""


def connected(
    level: Level,
    uri: str,
    open_source: OpenSource,
    *,
    vehicle: int = 1,
    body: str | None = None,
    limits: Limits | None = None,
    description: dict[str, object] | None = None,
) -> Rig:
    """Connect to a vehicle and a camera system; both run when this returns.

    Parameters
    ----------
    uri: link of the vehicle, as cflib opens it.
    open_source: opens the pose source on the session's clock.
    vehicle, body: id and name of the vehicle; the name is ``cf<id>`` by default.

    Raises
    ------
    BackendError: the vehicle does not answer.
    InputError: the link or the source is described wrongly.
    """
    from crazyarena.crazyswarm_compat.radio.backend import RadioBackend
    from crazyarena.crazyswarm_compat.radio.options import RadioOptions
    from crazyarena.crazyswarm_compat.radio.outbox import OutboxOptions

    body = body or f"cf{vehicle}"
    clock = StampedClock()
    start = level.start.position
    config = VehicleConfig(
        id=vehicle, name=body, initial_position=(start[0], start[1], start[2]), uri=uri
    )
    with ExitStack() as undo:
        source = open_source(clock)
        undo.callback(source.close)
        # The forwarder limits the rate; a second limit behind it would only make poses older.
        options = RadioOptions(outbox=OutboxOptions(extpose_rate=2.0 * EXTERNAL_POSE_RATE))
        backend = RadioBackend(FleetConfig((config,), "command line"), clock, options)
        undo.callback(backend.close)
        safeguard = Safeguard(
            level, backend, clock, vehicle, body, limits=limits, feed=backend.arm_watchdog
        )
        undo.callback(safeguard.close)
        pipeline, listeners = make_pipeline(
            source, clock, safeguard.gate.runner, {body: vehicle}, threaded=True
        )
        undo.callback(pipeline.close)
        safeguard.watch(pipeline)
        listeners.frames.append(safeguard.on_frame)
        pipeline.start()
        safeguard.watchdog.start()
        undo.pop_all()
    return Rig(
        clock,
        safeguard.gate.runner,
        pipeline,
        listeners,
        vehicle,
        body,
        _as_it_stands,
        safeguard,
        {"backend": uri, **(description or {})},
        [backend.close, safeguard.close, pipeline.close],
    )
