"""A vehicle over its link (radio, USB or UDP), a camera system, and what guards the two."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING

from crazyarena.clock import WallClock
from crazyarena.crazyswarm_compat.backend import Backend
from crazyarena.crazyswarm_compat.config import FleetConfig, VehicleConfig
from crazyarena.levels.schema import Level
from crazyarena.mocap.onboard import KIND as ONBOARD
from crazyarena.mocap.onboard import OnboardSource
from crazyarena.mocap.opening import SourceSpec
from crazyarena.mocap.pipeline import PosePipeline
from crazyarena.mocap.source import PoseSource
from crazyarena.runner.rig.rig import EXTERNAL_POSE_RATE, FrameListeners, make_pipeline
from crazyarena.runner.rig.safeguard import Safeguard
from crazyarena.safety.limits import Limits
from crazyarena.safety.own_estimate import OwnEstimate

if TYPE_CHECKING:
    from crazyarena.crazyswarm_compat.radio.options import RadioOptions

# Hz, of 30-byte packets: a tenth of what a Crazyradio carries, and as often as a flight process
# tells of a vehicle.
PLANT_RATE = 50.0
# Hz, of the vehicle's own estimate where there are no cameras, and of how sure it is of it.
ESTIMATE_RATE = 100.0
CERTAINTY_RATE = 10.0


@dataclass(frozen=True, slots=True)
class HardwareSetup:
    """What is to be connected; plain data, for another process.

    Attributes
    ----------
    uri: link of the vehicle, as cflib opens it.
    vehicle, body: its id and its name in the camera system.
    origin: of the session's clock.
    params: firmware parameters by name, written before anything else.
    source: ``onboard`` for the vehicle's own estimate.
    plant_log: log motors, accelerometer and voltage, from which a model can be identified.
    real_time: ask for locked memory and real-time scheduling.
    """

    level: Level
    uri: str
    source: SourceSpec
    vehicle: int
    body: str
    origin: float
    limits: Limits | None = None
    real_time: bool = True
    params: Mapping[str, float] = field(default_factory=dict)
    plant_log: bool = True


@dataclass(frozen=True, slots=True)
class Hardware:
    """Connected and running; ``backend`` is behind the command gate."""

    clock: WallClock
    backend: Backend
    pipeline: PosePipeline
    listeners: FrameListeners
    safeguard: Safeguard
    _closers: ExitStack

    def close(self) -> None:
        """Release everything, last built first; idempotent."""
        self._closers.close()


def onboard_options(options: RadioOptions) -> RadioOptions:
    """With estimates often enough to be flown by, and how sure the vehicle is of them."""
    return replace(options, state_rate=ESTIMATE_RATE, certainty_rate=CERTAINTY_RATE)


def connect(setup: HardwareSetup) -> Hardware:
    """Connect to a vehicle and a camera system; both run when this returns.

    Raises
    ------
    BackendError: the vehicle does not answer.
    InputError: the link or the source is described wrongly.
    """
    from crazyarena.crazyswarm_compat.radio.backend import RadioBackend
    from crazyarena.crazyswarm_compat.radio.options import RadioOptions
    from crazyarena.crazyswarm_compat.radio.outbox import OutboxOptions

    clock = WallClock(setup.origin)
    vehicle, body = setup.vehicle, setup.body
    start = setup.level.start.position
    config = VehicleConfig(
        id=vehicle, name=body, initial_position=(start[0], start[1], start[2]), uri=setup.uri
    )
    onboard = setup.source.kind == ONBOARD
    with ExitStack() as undo:
        # The forwarder limits the rate; a second limit behind it would only make poses older.
        options = RadioOptions(
            outbox=OutboxOptions(extpose_rate=2.0 * EXTERNAL_POSE_RATE),
            plant_rate=PLANT_RATE if setup.plant_log else 0.0,
        )
        source: PoseSource | None = None
        if onboard:
            options = onboard_options(options)
        else:
            source = setup.source.open(clock)
            undo.callback(source.close)
        backend = RadioBackend(FleetConfig((config,), "command line"), clock, options)
        undo.callback(backend.close)
        if source is None:
            known = OwnEstimate.of(partial(backend.get_param, vehicle), setup.source.options)
            source = own = OnboardSource(clock, known.certainty)
            backend.on_state(vehicle, partial(own.told, body))
        names = set(backend.param_names(vehicle))
        for name, value in setup.params.items():
            if name in names:  # older firmware has fewer
                backend.set_param(vehicle, name, value)
        safeguard = Safeguard(
            setup.level,
            backend,
            clock,
            vehicle,
            body,
            limits=setup.limits,
            feed=backend.arm_watchdog,
            independent=not onboard,
        )
        undo.callback(safeguard.close)
        pipeline, listeners = make_pipeline(
            source,
            clock,
            safeguard.gate.runner,
            {body: vehicle},
            threaded=True,
            forward=not onboard,
        )
        undo.callback(pipeline.close)
        safeguard.watch(pipeline)
        listeners.frames.append(safeguard.on_frame)
        pipeline.start()
        safeguard.watchdog.start()
        closers = undo.pop_all()
    return Hardware(clock, safeguard.gate.runner, pipeline, listeners, safeguard, closers)
