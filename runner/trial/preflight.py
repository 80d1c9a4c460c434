"""Gathers what the pre-flight checklist looks at from live vehicles and cameras."""

from __future__ import annotations

import cmath
import contextlib
import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from crazyarena.clock import Clock, WallClock
from crazyarena.errors import BackendError, CommandError, InputError
from crazyarena.levels import Level
from crazyarena.levels.lsy.arena import bare_arena
from crazyarena.mocap.estimator import BodyEstimate, Freshness
from crazyarena.mocap.onboard import KIND as ONBOARD
from crazyarena.mocap.onboard import OnboardSource, certainty
from crazyarena.mocap.source import PoseSource
from crazyarena.runner.rig.cameras import named_source
from crazyarena.runner.rig.flight_model import foretold, known
from crazyarena.runner.rig.stops import StopOptions, open_stops
from crazyarena.safety import preflight as pf
from crazyarena.safety.estop import EmergencyStop, Rehearsal
from crazyarena.safety.fence import Fence
from crazyarena.safety.frame_rate import FrameRate
from crazyarena.safety.own_estimate import OwnEstimate
from crazyarena.safety.preflight import (
    Preflight,
    VehicleFacts,
)
from crazyarena.safety.preflight_onboard import Onboard
from crazyarena.safety.preflight_track import gates_free
from crazyarena.safety.rehearsal import Rehearsals
from crazyarena.safety.tipping import nose_between, tilt, tipped_body
from crazyarena.sim_backend.vehicles import Vehicle, VehicleChoice, resolve
from crazyarena.types import Pose, PoseFrame

_PERIOD = 0.05  # s
_FRESH = 10.0  # s, for the cameras to find a vehicle
_TIP_PATIENCE = 20.0  # s
_TIP_TIME = 0.5  # s for which the same body must be tipped
_UPRIGHT = 0.1  # rad
_DOWN_TIME = 1.0  # s that a vehicle must stand before its estimator is reset
_GONE = 0.5  # s after which a body that is not seen any more counts as gone
_TRACK = ("gate", "obstacle")
_PEOPLE = ("person",)


@dataclass(frozen=True, slots=True)
class Wanted:
    """What ``crazyarena preflight`` is asked for; options as typed."""

    level: str
    uris: Sequence[str] = ()
    mocap: str | None = None
    host: str | None = None
    options: Sequence[str] = ()
    overrides: Sequence[str] = ()
    controller: int = 2
    tip: bool = False
    wait: float = 5.0
    out: Path = Path("runs")
    stops: StopOptions = field(default_factory=StopOptions)
    vehicle: VehicleChoice = field(default_factory=VehicleChoice)

    def vehicles(self) -> dict[str, str]:
        """Links by name; raises InputError."""
        vehicles: dict[str, str] = {}
        for pair in self.uris:
            name, equals, uri = pair.partition("=")
            if not equals or not name or not uri:
                raise InputError(f"--uri: found {pair!r}; write NAME=URI, e.g. cf1=radio://0/80/2M")
            if name in vehicles:
                raise InputError(f"--uri: the name {name} occurs twice; each body is one vehicle")
            vehicles[name] = uri
        return vehicles


class Bodies:
    """What the cameras see, and what of it belongs there."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._seen: dict[str, tuple[float, Pose]] = {}
        self.frames = FrameRate()

    def note(self, frame: PoseFrame, _: object) -> None:
        """For the pipeline."""
        now = self._clock.now()
        self.frames.note(frame.timestamp)
        self._seen.update({name: (now, pose) for name, pose in frame.bodies.items()})

    def now(self) -> dict[str, Pose]:
        """Bodies that are seen now."""
        oldest = self._clock.now() - _GONE
        return {name: pose for name, (time, pose) in dict(self._seen).items() if time >= oldest}

    def known(self, fence: Fence) -> list[str]:
        """Parts of the track, and people outside the fence."""
        return [
            name
            for name, pose in self.now().items()
            if name.startswith(_TRACK)
            or (name.startswith(_PEOPLE) and fence.clearance(*pose.position.tolist()) < 0.0)
        ]

    def gates(self) -> dict[int, Pose]:
        """Gates by index; the first is body ``gate1``."""
        return {
            int(name[4:]) - 1: pose
            for name, pose in self.now().items()
            if name.startswith("gate") and name[4:].isdecimal()
        }


def gather(wanted: Wanted, say: Callable[[str], None]) -> Preflight:
    """Connect, listen, and return the filled-in checklist.

    A vehicle that does not answer is a red line, not an error.

    Raises
    ------
    InputError, DependencyMissing: an option is wrong, or something cannot be opened.
    """
    clock = WallClock()
    vehicles = wanted.vehicles()
    flown = bare_arena(wanted.level, wanted.overrides)
    _, model = resolve(flown, wanted.vehicle)
    wanted.stops.check()
    with contextlib.ExitStack() as stack:
        return _Gathering(wanted, flown, model, vehicles, clock, say, stack).run()


class _Gathering:
    """One look around."""

    def __init__(
        self,
        wanted: Wanted,
        level: Level,
        model: Vehicle,
        vehicles: dict[str, str],
        clock: Clock,
        say: Callable[[str], None],
        stack: contextlib.ExitStack,
    ) -> None:
        self._wanted = wanted
        self._level = level
        self._model = model
        self._vehicles = vehicles
        self._ids = {name: index + 1 for index, name in enumerate(vehicles)}
        self._clock = clock
        self._say = say
        self._bodies = Bodies(clock)
        self._in_hand: set[int] = set()
        self._facts = {name: VehicleFacts(name, name, own=[]) for name in vehicles}
        self._rehearsals = Rehearsals()
        self._onboard = wanted.mocap == ONBOARD
        self._checks: Onboard | None = None
        if self._onboard and wanted.tip:
            raise InputError("--tip: compares a vehicle with its body; without cameras it has none")
        # Only rehearsed here: no link is given to it, so nothing can be stopped by mistake.
        self._estop = EmergencyStop([], clock)
        tried = Rehearsal(self._estop, lambda source: say(f"Emergency stop tried: {source}."))
        self._stops = open_stops(wanted.stops, tried, clock)
        stack.callback(self._stops.close)
        self._backend = self._connect(stack)
        self._pipeline = self._watch(stack)

    def _connect(self, stack: contextlib.ExitStack) -> Any:
        from crazyarena.crazyswarm_compat.config import FleetConfig, VehicleConfig
        from crazyarena.crazyswarm_compat.radio import RadioBackend, RadioOptions
        from crazyarena.runner.rig.hardware import onboard_options

        if not self._vehicles:
            return None
        start = self._level.start.position
        place = (start[0], start[1], start[2])
        fleet = FleetConfig(
            tuple(
                VehicleConfig(self._ids[name], name, place, uri=uri)
                for name, uri in self._vehicles.items()
            ),
            "--uri",
        )
        options = onboard_options(RadioOptions()) if self._onboard else RadioOptions()
        try:
            backend = RadioBackend(fleet, self._clock, options)
        except BackendError as error:
            self._say(str(error))
            return None
        stack.callback(backend.close)
        return backend

    def _watch(self, stack: contextlib.ExitStack) -> Any:
        from crazyarena.mocap.estimator import PoseEstimator
        from crazyarena.mocap.forwarder import PoseForwarder
        from crazyarena.mocap.pipeline import PosePipeline

        w = self._wanted
        if w.mocap is None:
            return None
        spec = named_source(w.mocap, w.host, w.options)
        forwarder = None
        poses: PoseSource
        if self._onboard:
            if self._backend is None:
                return None  # that it is silent, its own lines say
            poses = self._own_estimates(spec.options)
        else:
            poses = spec.open(self._clock)
        if self._backend is not None and not self._onboard:
            forwarder = PoseForwarder(self._ids, self._forward, self._clock)
        pipeline = PosePipeline(
            poses,
            PoseEstimator(list(self._vehicles)),
            self._clock,
            forwarder=forwarder,
            on_frame=[self._bodies.note],
        )
        stack.callback(pipeline.close)
        pipeline.start()
        return pipeline

    def _own_estimates(self, options: dict[str, Any]) -> OnboardSource:
        known = {}
        for name, ident in self._ids.items():
            own = OwnEstimate.of(partial(self._backend.get_param, ident), options)
            known[name] = own
        relative = all(own.decks.relative for own in known.values())
        source = OnboardSource(self._clock, certainty(relative, options))
        for name, ident in self._ids.items():
            self._backend.on_state(ident, partial(source.told, name))
        self._checks = Onboard(known)
        return source

    def _forward(self, poses: Any) -> None:
        """A vehicle in somebody's hand must feel by itself how it is held."""
        chosen = {k: pose for k, pose in poses.items() if k not in self._in_hand}
        if chosen:
            self._backend.send_external_poses(chosen)

    def run(self) -> Preflight:
        """Prepare each vehicle as a flight does, have it tipped, listen."""
        w, clock = self._wanted, self._clock
        for name in self._facts:
            self._prepare(name)
        if w.tip:
            for name, fact in self._facts.items():
                self._tip(name, fact)
        self._say(
            f"Listening for {w.wait:g} s. Try the emergency stop now: crazyarena estop --test"
            + ("" if not self._sources() else f", or {self._sources()}")
        )
        end = clock.now() + w.wait
        while clock.now() < end:
            clock.sleep_until(clock.now() + _PERIOD)
            for name, fact in self._facts.items():
                self._listen(name, fact)
        return self._checklist()

    def _sources(self) -> str:
        w = self._wanted.stops
        named = [
            word
            for word, there in (
                ("the space bar", w.keyboard),
                ("the gamepad's button B", w.gamepad is not None),
                ("crazyarena estop over zenoh", w.over_zenoh),
            )
            if there
        ]
        return ", ".join(named)

    def _until(self, condition: Callable[[], bool], patience: float) -> bool:
        end = self._clock.now() + patience
        while not condition():
            if self._clock.now() >= end:
                return False
            self._clock.sleep_until(self._clock.now() + _PERIOD)
        return True

    def _prepare(self, name: str) -> None:
        """What a flight writes before it arms; nothing turns by it."""
        from crazyarena.runner.trial.phases import preparations

        if self._backend is None or self._pipeline is None:
            return
        seen: list[BodyEstimate] = []

        def fresh() -> bool:
            seen[:] = [self._pipeline.estimate(name)]
            return seen[0].freshness is Freshness.FRESH

        if not self._until(fresh, _FRESH):
            return
        try:
            for command in preparations(seen[0].state, self._wanted.controller):
                self._backend.send(command, self._ids[name])
                self._clock.sleep_until(self._clock.now() + 0.02)
        except (BackendError, CommandError) as error:
            self._say(f"{name}: {error}")

    def _tip(self, name: str, fact: VehicleFacts) -> None:
        if self._backend is None or self._pipeline is None:
            return
        ident = self._ids[name]
        self._in_hand.add(ident)
        found: list[str | None] = []
        turns: list[complex] = []
        needed = round(_TIP_TIME / _PERIOD)

        def tipped() -> bool:
            state = self._backend.telemetry(ident).state
            poses = self._bodies.now()
            body = None if state is None else tipped_body(poses, state.quaternion)
            found.append(body)
            if body is None or state is None:
                turns.clear()
                return False
            turns.append(cmath.rect(1.0, nose_between(state.quaternion, poses[body].quaternion)))
            return found[-needed:] == [body] * needed

        def upright() -> bool:
            state = self._backend.telemetry(ident).state
            poses = self._bodies.now()
            low = state is not None and tilt(state.quaternion) < _UPRIGHT
            own = poses.get(fact.tipped or name)
            return low and (own is None or tilt(own.quaternion) < _UPRIGHT)

        self._say(f"Tip {name} by hand, by more than 15 degrees, and hold it.")
        if self._until(tipped, _TIP_PATIENCE):
            fact.tipped = found[-1]
            fact.turned = cmath.phase(sum(turns[-needed:]))
            self._say(
                f"Body {fact.tipped} was tipped, its nose {math.degrees(fact.turned):+.0f} deg "
                f"from the vehicle's. Put {name} back where it stood."
            )
            self._until(upright, _TIP_PATIENCE)
            self._clock.sleep_until(self._clock.now() + _DOWN_TIME)
        else:
            self._say(f"No body was tipped as {name} felt it.")
        self._in_hand.discard(ident)
        self._prepare(name)

    def _listen(self, name: str, fact: VehicleFacts) -> None:
        if self._backend is None:
            return
        fact.telemetry = self._backend.telemetry(self._ids[name])
        state = fact.telemetry.state
        if state is not None:
            # Only the last second counts: before, the estimator may still have moved.
            fact.own = [*fact.own, state.position][-round(1.0 / _PERIOD) :]

    def _checklist(self) -> Preflight:
        w = self._wanted
        p = Preflight(
            self._level,
            list(self._facts.values()),
            controller=w.controller,
            estop=self._estop,
            out=w.out,
            clock=self._clock,
            machine_checks=(*pf.MACHINE_CHECKS, gates_free),
        )
        if self._checks is not None:
            p.machine_checks, p.vehicle_checks = self._checks.all_checks()
        for name, fact in self._facts.items():
            if self._backend is not None:
                with contextlib.suppress(BackendError):
                    fact.controller = int(
                        self._backend.get_param(self._ids[name], "stabilizer.controller")
                    )
                fact.model = foretold(
                    self._model,
                    known(w.controller),
                    functools.partial(self._backend.get_param, self._ids[name]),
                )
            if self._pipeline is not None:
                fact.seen = self._pipeline.estimate(name)
        remember(p, self._rehearsals, self._vehicles)
        p.poses = self._bodies.now()
        p.bodies = sorted(p.poses)
        p.camera_rate = self._bodies.frames.rate
        with contextlib.suppress(InputError):  # a contradictory fence has a line of its own
            p.known = self._bodies.known(Fence.from_level(self._level))
        p.gates = self._bodies.gates()
        return p


def remember(p: Preflight, rehearsals: Rehearsals, uris: dict[str, str]) -> None:
    """Exchange what was tried by hand with earlier and later commands.

    ``uris``: link by body name.
    """
    assert p.estop is not None
    if p.estop.last_test is not None:
        rehearsals.note_stop()
    elif math.isfinite(age := rehearsals.stop_age()):
        p.estop.tested(age)
    for fact in p.vehicles:
        if fact.tipped is not None:
            rehearsals.note_body(uris[fact.name], fact.tipped, fact.turned)
            continue
        body, age = rehearsals.body(uris[fact.name])
        if age <= p.tolerances.body_age:
            fact.tipped, fact.turned = body, rehearsals.turned(uris[fact.name])
