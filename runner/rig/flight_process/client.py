"""The runner's end: a rig whose parts are reached over the channel to the flight process.

There are no threads here. What the flight process has pushed is taken in when somebody lets
time pass on the rig's clock, or asks; what it pushes meanwhile waits, however long that is.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from crazyarena.clock import WallClock
from crazyarena.crazyswarm_compat.checks import check
from crazyarena.crazyswarm_compat.commands import STREAMED, Command
from crazyarena.errors import BackendError
from crazyarena.levels.draw import Draw
from crazyarena.levels.schema import Level
from crazyarena.mocap.estimator import BodyEstimate, PoseEstimator
from crazyarena.mocap.onboard import KIND as ONBOARD
from crazyarena.mocap.opening import SourceSpec
from crazyarena.mocap.pipeline import PosePipeline
from crazyarena.mocap.source import SourceStatus
from crazyarena.runner.judging.referee import Event
from crazyarena.runner.rig.flight_process.process import SIGN_OF_LIFE, VEHICLE, FlightProcess
from crazyarena.runner.rig.hardware import HardwareSetup
from crazyarena.runner.rig.rig import FrameListeners, Rig
from crazyarena.runner.rig.safeguard import LANDING, TICK
from crazyarena.runner.rig.stops import StopOptions
from crazyarena.runner.timing.wakeup import StampedClock
from crazyarena.safety.events import SafetyEvent
from crazyarena.safety.fence import Fence
from crazyarena.safety.limits import Limits
from crazyarena.safety.own_estimate import OwnEstimate
from crazyarena.sim_backend.vehicles import Vehicle, load_vehicle
from crazyarena.sim_backend.vehicles.rows import told_params
from crazyarena.types import Pose, PoseFrame, Telemetry

# How long before a deadline the clock turns to nothing else, s.
_ALONE = 0.006
# The same if it was woken too late for that, s.
_BARELY = 0.005


class FlightClock(StampedClock):
    """Lets what the flight process pushes happen while somebody waits.

    The last moments before a deadline it only sleeps, so that nothing makes the wake-up late.
    """

    def __init__(self, origin: float) -> None:
        super().__init__(origin)
        self.process: FlightProcess | None = None
        self.pipeline: PosePipeline | None = None

    def sleep_until(self, deadline: float) -> float:
        process, pipeline = self.process, self.pipeline
        if process is None or pipeline is None:
            return super().sleep_until(deadline)
        self.expect(deadline)
        process.sign_of_life(self.now())
        while (now := self.now()) < deadline - _ALONE:
            if not process.frames:
                self.doze(min(deadline - _ALONE, now + SIGN_OF_LIFE), process.descriptor)
            if self.now() < deadline - _BARELY:
                pipeline.poll()
                process.sign_of_life(self.now())
        late = super().sleep_until(deadline)
        pipeline.poll()
        return late


class _Frames:
    """The frames of the flight process as a :class:`~crazyarena.mocap.source.PoseSource`."""

    def __init__(self, process: FlightProcess) -> None:
        self._process = process

    def frames(self, timeout: float = 0.0) -> list[PoseFrame]:
        process = self._process
        process.listen(0.0 if process.frames else timeout)
        taken, process.frames = process.frames, []
        return taken

    @property
    def status(self) -> SourceStatus:
        return self._process.status.source

    def close(self) -> None:
        """The process itself is closed by the rig."""


class RemotePipeline(PosePipeline):
    """Repeats over here what the pipeline over there makes of the same frames."""

    _polling = False

    def poll(self, timeout: float = 0.0) -> int:
        # Listeners may ask for estimates, which must not overtake the frame they are told of.
        if self._polling:
            return 0
        self._polling = True
        try:
            return super().poll(timeout)
        finally:
            self._polling = False

    def estimate(self, name: str, at: float | None = None) -> BodyEstimate:
        self.poll()
        return super().estimate(name, at)


class RemoteBackend:
    """The runner's port of the command gate, over there."""

    def __init__(self, process: FlightProcess, vehicle: int) -> None:
        self._process = process
        self.vehicles: Sequence[int] = (vehicle,)

    def send(self, command: Command, vehicle: int | None = None) -> None:
        """As the gate, but that a setpoint is not waited for, so that no tick waits for another
        process: if one is refused, the next setpoint raises it.

        Raises
        ------
        BackendError: the flight process is gone.
        """
        process = self._process
        if not isinstance(command, STREAMED):
            process.ask("send", command, vehicle)
            process.refused = None
            return
        refused, process.refused = process.refused, None
        if refused is not None:
            raise refused
        process.post("send", command, vehicle)
        if process.lost is not None:
            raise BackendError(process.lost)
        # What no gate would pass is known here as well.
        check(command, "all vehicles" if vehicle is None else f"cf{vehicle}")

    def send_external_poses(self, poses: Mapping[int, Pose]) -> None:
        self._process.ask("send_external_poses", dict(poses))

    def telemetry(self, vehicle: int) -> Telemetry:
        self._process.listen()
        return self._process.status.telemetry

    def get_param(self, vehicle: int, name: str) -> float:
        value: float = self._process.ask("get_param", vehicle, name, timeout=VEHICLE)
        return value

    def close(self) -> None:
        self._process.close()


class RemoteHold:
    """What the operator holds, as the flight process sees it."""

    def __init__(self, process: FlightProcess, clock: FlightClock) -> None:
        self._process = process
        self._clock = clock

    def age(self) -> float:
        """s since it was last held; inf if never."""
        self._process.listen()
        return self._clock.now() - self._process.status.held


class RemoteSafeguard:
    """The watchdog and the emergency stop over there.

    A :class:`~crazyarena.runner.rig.watch.Guard`; once the flight process is gone, its verdict says
    so, and the vehicle counts as taken.
    """

    def __init__(
        self, process: FlightProcess, clock: FlightClock, fence: Fence, limits: Limits
    ) -> None:
        self.limits = limits
        self._process = process
        self._clock = clock
        self._terminal: list[Any] | None = None
        self.fence = fence

    # Watch

    def begin(self) -> None:
        self._process.ask("begin")

    def answered(self) -> None:
        self._process.tell("answered")

    def late(self, seconds: float) -> None:
        self._process.tell("late", seconds)

    def verdict(self) -> str | None:
        self._process.listen()
        return self._process.lost or self._process.status.verdict

    @property
    def ladder(self) -> str:
        """As told last."""
        return self._process.status.ladder

    def hand_over(self, rule: str) -> None:
        with contextlib.suppress(BackendError):
            self._process.ask("hand_over", rule)

    def end(self) -> bool:
        process, clock = self._process, self._clock
        try:
            if not process.ask("done"):
                return False
        except BackendError:
            return True
        end = clock.now() + LANDING
        while not process.status.over and process.lost is None and clock.now() < end:
            clock.sleep_until(clock.now() + TICK)
        return True

    def events(self) -> list[Event]:
        told: list[Event] = []
        with contextlib.suppress(BackendError):
            told = self._process.ask("events")
        return told

    def record(self) -> list[SafetyEvent]:
        """Everything the watchdog has done so far; raises BackendError if it is gone."""
        told: list[SafetyEvent] = self._process.ask("record")
        return told

    def stop(self, source: str, reason: str) -> None:
        self._process.tell("stop", source, reason)

    # Sources of the emergency stop

    def open_stops(self, options: StopOptions) -> tuple[list[str], RemoteHold | None]:
        """As :meth:`.Safeguard.open_stops`; over there nothing the runner does delays them."""
        notes, held = self._process.ask("open_stops", options, timeout=VEHICLE)
        return notes, RemoteHold(self._process, self._clock) if held else None

    def open_keys(self, options: StopOptions) -> list[str]:
        """As :meth:`.Safeguard.open_keys`: the terminal is the same over there."""
        self._terminal = _terminal()
        notes: list[str] = self._process.ask("open_keys", options)
        return notes

    def close_keys(self) -> None:
        """Idempotent. The terminal is as before, whatever has become of the flight process."""
        if self._terminal is None:
            return
        with contextlib.suppress(BackendError):
            self._process.ask("close_keys")
        _restore(self._terminal)
        self._terminal = None


def _terminal() -> list[Any] | None:
    import termios

    with contextlib.suppress(termios.error):
        return termios.tcgetattr(0)
    return None


def _restore(terminal: list[Any]) -> None:
    import termios

    with contextlib.suppress(termios.error):
        termios.tcsetattr(0, termios.TCSADRAIN, terminal)


def _as_it_stands(draw: Draw) -> None:
    """In an arena nothing is drawn: people have built the track and placed the vehicle."""


def connected(
    level: Level,
    uri: str,
    source: SourceSpec,
    *,
    vehicle: int = 1,
    body: str | None = None,
    limits: Limits | None = None,
    real_time: bool = True,
    description: dict[str, object] | None = None,
    environment: Mapping[str, str] | None = None,
    model: Vehicle | None = None,
    plant_log: bool = True,
    params: Mapping[str, float] | None = None,
) -> Rig:
    """Start a flight process that connects to a vehicle and a camera system.

    Parameters
    ----------
    uri: link of the vehicle, as cflib opens it.
    vehicle, body: id and name of the vehicle; the name is ``cf<id>`` by default.
    real_time: ask for real-time scheduling and locked memory there.
    environment: of that process, this one's own by default.
    model: what vehicle it is, the default one if not given: its parameters are written.
    plant_log: have it tell of motors, accelerometer and voltage.
    params: further firmware parameters to write.

    Raises
    ------
    BackendError: the vehicle does not answer.
    InputError: the link or the source is described wrongly.
    """
    body = body or f"cf{vehicle}"
    origin = WallClock().origin
    process = FlightProcess(
        HardwareSetup(
            level,
            uri,
            source,
            vehicle,
            body,
            origin,
            limits,
            real_time,
            {**told_params(load_vehicle() if model is None else model), **(params or {})},
            plant_log,
        ),
        environment,
    )
    try:
        # Both are compiled, while the other process connects.
        clock = FlightClock(origin)
        estimator = PoseEstimator((body,))
        estimator.warm_up()
        process.await_ready()
        backend = RemoteBackend(process, vehicle)
        onboard = None
        if source.kind == ONBOARD:
            onboard = OwnEstimate.of(partial(backend.get_param, vehicle), source.options)
        listeners = FrameListeners()
        pipeline = RemotePipeline(
            _Frames(process),
            estimator,
            clock,
            on_frame=(listeners.on_frame,),
            on_event=(listeners.on_event,),
        )
    except BaseException:
        process.close()
        raise
    clock.process, clock.pipeline = process, pipeline
    guard = RemoteSafeguard(process, clock, Fence.from_level(level), limits or Limits())
    about: dict[str, object] = {"backend": uri, "flight_process": process.notes}
    if model is not None:
        about["vehicle"] = model.name
    return Rig(
        clock,
        backend,
        pipeline,
        listeners,
        vehicle,
        body,
        _as_it_stands,
        guard,
        {**about, **(description or {})},
        [process.close, guard.close_keys],
        lambda: process.lost,
        onboard=onboard,
    )
