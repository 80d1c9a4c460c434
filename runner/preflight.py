"""Gathers what the pre-flight checklist looks at from live vehicles and cameras."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from pathlib import Path

from crazyarena.clock import WallClock
from crazyarena.errors import BackendError, InputError
from crazyarena.levels import load_level
from crazyarena.safety.estop import EmergencyStop
from crazyarena.safety.estop_sources import SocketSource
from crazyarena.safety.preflight import Preflight, VehicleFacts, tipped_body
from crazyarena.types import Pose, PoseFrame

_PERIOD = 0.05  # s
_TIP_PATIENCE = 20.0  # s


def _vehicles(pairs: Sequence[str]) -> dict[str, str]:
    vehicles = {}
    for pair in pairs:
        name, equals, uri = pair.partition("=")
        if not equals or not name or not uri:
            raise InputError(f"--uri: found {pair!r}; write NAME=URI, e.g. cf1=radio://0/80/2M")
        vehicles[name] = uri
    return vehicles


def gather(
    level: str,
    uris: Sequence[str],
    mocap: str | None,
    host: str | None,
    options: Sequence[str],
    controller: int,
    tip: bool,
    wait: float,
    out: Path,
    say: Callable[[str], None],
) -> Preflight:
    """Connect, listen for ``wait`` s, and return the filled-in checklist.

    Raises
    ------
    InputError, BackendError: something could not be opened.
    """
    from crazyarena.crazyswarm_compat.config import FleetConfig, VehicleConfig
    from crazyarena.crazyswarm_compat.radio import RadioBackend
    from crazyarena.mocap.estimator import PoseEstimator
    from crazyarena.mocap.forwarder import PoseForwarder
    from crazyarena.mocap.pipeline import PosePipeline
    from crazyarena.runner.cli.mocap_options import open_named_source

    clock = WallClock()
    vehicles = _vehicles(uris)
    flown = load_level(level)
    checklist = Preflight(flown, [], controller=controller, out=out, clock=clock)
    latest: dict[str, Pose] = {}

    def note(frame: PoseFrame, _: object) -> None:
        latest.update(frame.bodies)

    with contextlib.ExitStack() as stack:
        # Only rehearsed here: no link is given to it, so nothing can be stopped by mistake.
        checklist.estop = EmergencyStop([], clock)
        source = SocketSource(checklist.estop)
        stack.callback(source.close)
        backend = None
        ids = {name: index + 1 for index, name in enumerate(vehicles)}
        if vehicles:
            start = flown.start.position
            fleet = FleetConfig(
                tuple(
                    VehicleConfig(ids[name], name, (start[0], start[1], start[2]), uri=uri)
                    for name, uri in vehicles.items()
                ),
                "--uri",
            )
            backend = RadioBackend(fleet, clock)
            stack.callback(backend.close)
        pipeline = None
        if mocap is not None:
            poses = open_named_source(mocap, host, options, clock)
            forwarder = (
                None if backend is None else PoseForwarder(ids, backend.send_external_poses, clock)
            )
            pipeline = PosePipeline(
                poses, PoseEstimator(list(vehicles)), clock, forwarder=forwarder, on_frame=[note]
            )
            stack.callback(pipeline.close)
            pipeline.start()
        facts = {name: VehicleFacts(name, name, own=[]) for name in vehicles}
        say(f"Listening for {wait:g} s. Try the emergency stop now: crazyarena estop --test")
        end = clock.now() + wait
        while clock.now() < end:
            clock.sleep_until(clock.now() + _PERIOD)
            for name, fact in facts.items():
                if backend is None:
                    continue
                fact.telemetry = backend.telemetry(ids[name])
                state = fact.telemetry.state
                if state is not None:
                    # Only the last second counts: before, the estimator may still have moved.
                    fact.own = [*fact.own, state.position][-round(1.0 / _PERIOD) :]
        for name, fact in facts.items():
            if backend is not None:
                with contextlib.suppress(BackendError):
                    fact.controller = int(backend.get_param(ids[name], "stabilizer.controller"))
            if pipeline is not None:
                fact.seen = pipeline.estimate(name)
            if tip and backend is not None and pipeline is not None:
                say(f"Tip {name} by hand, by more than 15 degrees, and hold it.")
                end = clock.now() + _TIP_PATIENCE
                while fact.tipped is None and clock.now() < end:
                    clock.sleep_until(clock.now() + _PERIOD)
                    state = backend.telemetry(ids[name]).state
                    if state is not None:
                        fact.tipped = tipped_body(dict(latest), state.quaternion)
        checklist.vehicles = list(facts.values())
        checklist.bodies = sorted(latest)
        checklist.known = [n for n in latest if n.startswith(("gate", "obstacle"))]
        checklist.gates = {
            int(name[4:]): pose
            for name, pose in latest.items()
            if name.startswith("gate") and name[4:].isdigit()
        }
    return checklist
