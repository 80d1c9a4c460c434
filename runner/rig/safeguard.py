"""The watchdog, the command gate and the emergency stop of one trial, put together."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

from crazyarena.clock import Clock
from crazyarena.crazyswarm_compat.backend import Backend
from crazyarena.levels.schema import Level
from crazyarena.mocap.estimator import FrameResult
from crazyarena.mocap.pipeline import PosePipeline
from crazyarena.runner.judging.referee import Event
from crazyarena.runner.rig.stops import StopOptions, Stops, open_stops
from crazyarena.safety.estop import EmergencyStop, Hold, say_loudly
from crazyarena.safety.events import Action, SafetyEvent
from crazyarena.safety.fence import Fence
from crazyarena.safety.flight_model import FlightModel
from crazyarena.safety.gate import CommandGate
from crazyarena.safety.limits import Limits
from crazyarena.safety.watchdog import Watchdog
from crazyarena.types import PoseFrame, VehicleState

LANDING = 20.0  # s, for the watchdog to bring a vehicle down
TICK = 0.02  # s


def limits_for(rate: float, max_misses: int, vehicle: FlightModel | None = None) -> Limits:
    """Limits of a vehicle, the default one if none is given, with the runner's own patience for
    a contestant that does not answer."""
    hold = (max_misses + 2) / rate
    default = Limits()
    if vehicle is not None:
        default = default.for_vehicle(vehicle)
    return replace(
        default,
        controller_hold=max(default.controller_hold, hold),
        controller_warn=min(default.controller_warn, 0.5 * hold),
    )


class Safeguard:
    """Guards one vehicle of a trial; a :class:`~crazyarena.runner.rig.watch.Guard`.

    Parameters
    ----------
    backend: the vehicle link itself.
    feed: feeds the vehicle's own emergency-stop watchdog; None if it has none.
    dead_man: what the operator holds while the vehicle flies; None for nothing.
    independent: see :class:`~crazyarena.safety.watchdog.Watchdog`.
    """

    def __init__(
        self,
        level: Level,
        backend: Backend,
        clock: Clock,
        vehicle: int,
        body: str,
        *,
        limits: Limits | None = None,
        feed: Callable[[int], None] | None = None,
        dead_man: Hold | None = None,
        independent: bool = True,
    ) -> None:
        self._dead_man = dead_man
        self._independent = independent
        self._stops: Stops | None = None
        self._keys: Stops | None = None
        self._clock = clock
        self._vehicle = vehicle
        self._body = body
        self._epoch = 0.0
        self._feed = feed
        self._told: list[SafetyEvent] = []
        self._pipeline: PosePipeline | None = None
        self._watchdog: Watchdog | None = None
        self.fence = Fence.from_level(level)
        self.limits = limits or limits_for(level.control_frequency, 15)
        self.estop = EmergencyStop([backend], clock)
        self.gate = CommandGate(
            backend,
            self.fence,
            clock,
            self.limits,
            state=self._believed,
            on_event=self._told.append,
        )

    def watch(self, pipeline: PosePipeline) -> None:
        """Begin to watch through the estimates of ``pipeline``."""
        self._pipeline = pipeline
        self._watchdog = Watchdog(
            self.gate,
            self.fence,
            self._clock,
            {self._body: self._vehicle},
            pipeline.estimate,
            feed=self._feed,
            estop=self.estop,
            dead_man=self._dead_man,
            independent=self._independent,
            on_event=self._told.append,
        )

    @property
    def watchdog(self) -> Watchdog:
        assert self._watchdog is not None, "watch() comes first"
        return self._watchdog

    def must_hold(self, dead_man: Hold | None) -> None:
        """Land the vehicle from now on when the operator lets go."""
        self._dead_man = dead_man
        if self._watchdog is not None:
            self._watchdog.dead_man = dead_man

    def open_stops(self, options: StopOptions) -> tuple[list[str], Hold | None]:
        """Open sources of the emergency stop; the terminal's keys are another matter.

        Returns what is in force, in words, and what must be held, if anything.
        """
        self._stops = open_stops(
            options, self.estop, self._clock, say=self._trouble, land=self._land
        )
        self.must_hold(self._stops.dead_man)
        return self._stops.notes, self._stops.dead_man

    def open_keys(self, options: StopOptions) -> list[str]:
        """Let the terminal's keys stop, and be held for what must be held."""
        held = None if self._stops is None else self._stops.dead_man
        self._keys = open_stops(options, self.estop, self._clock, dead_man=held, say=self._trouble)
        return self._keys.notes

    def _land(self, reason: str) -> None:
        """The operator wants it down; from the thread of a source."""
        self.watchdog.request(Action.LAND, "operator_land", self._vehicle)

    @property
    def ladder(self) -> str:
        """Where the watchdog's ladder stands, by name."""
        return self.watchdog.action(self._vehicle).name

    def _trouble(self, text: str) -> None:
        """A source of the stop was tampered with or is gone; from its thread."""
        say_loudly(text)
        now, nothing = self._clock.now(), math.nan
        self._told.append(
            SafetyEvent("stop_source", Action.WARN, nothing, nothing, Action.WARN, now, None, text)
        )

    def close_keys(self) -> None:
        """Give the keys back; idempotent."""
        if self._keys is not None:
            self._keys.close()
            self._keys = None

    def close_stops(self) -> None:
        """Close every source; nothing has to be held any more. Idempotent."""
        self.close_keys()
        if self._stops is not None:
            self.must_hold(None)
            self._stops.close()
            self._stops = None

    @property
    def held(self) -> float:
        """When the operator last held what must be held, s; -inf if never."""
        return -math.inf if self._dead_man is None else self._clock.now() - self._dead_man.age()

    def on_frame(self, frame: PoseFrame, result: FrameResult) -> None:
        """For the pipeline."""
        if self._watchdog is not None:
            self._watchdog.on_frame(frame, result)

    def close(self) -> None:
        """Stop watching; idempotent."""
        self.close_stops()
        if self._watchdog is not None:
            self._watchdog.close()
        self.estop.close()

    def renew(self) -> None:
        """Begin anew: the vehicle was put down at its start and switched on."""
        self.gate.renew()
        self.watchdog.renew()
        self._told.clear()

    # Watch

    def begin(self) -> None:
        self._epoch = self._clock.now()

    def answered(self) -> None:
        self.watchdog.controller_answered(self._vehicle)

    def late(self, seconds: float) -> None:
        self.watchdog.step_late(seconds)

    def verdict(self) -> str | None:
        if not self.watchdog.action(self._vehicle).takes_over:
            return None
        cause = next((e for e in self._told if e.severity.takes_over), None)
        if cause is None:
            return "the watchdog has taken over"
        return f"the watchdog has taken over: {cause.cause}"

    def stop(self, source: str, reason: str) -> None:
        self.estop.trigger(source, reason)

    def hand_over(self, rule: str) -> None:
        self.watchdog.request(Action.HOLD, rule, self._vehicle)
        self._clock.sleep_until(self._clock.now() + TICK)

    def done(self) -> bool:
        """No more answers of the contestant are to be expected; True if the watchdog has the
        vehicle."""
        self.watchdog.controller_done(self._vehicle)
        return self.watchdog.action(self._vehicle).takes_over

    @property
    def over(self) -> bool:
        """The watchdog has brought the vehicle to a safe end."""
        return self.watchdog.over(self._vehicle)

    def end(self) -> bool:
        if not self.done():
            return False
        end = self._clock.now() + LANDING
        while not self.over and self._clock.now() < end:
            self._clock.sleep_until(self._clock.now() + TICK)
        return True

    def record(self) -> list[SafetyEvent]:
        """Everything the watchdog has done so far."""
        return list(self.watchdog.events)

    def events(self) -> list[Event]:
        told, self._told[:] = list(self._told), []
        return [
            Event(
                f"safety: {e.rule}",
                0,
                max(0.0, e.time - self._epoch),
                f"{e.severity.name} -> {e.action.name} {e.detail}".rstrip(),
            )
            for e in told
        ]

    def _believed(self, vehicle: int) -> VehicleState | None:
        if self._pipeline is None:
            return None
        return self._pipeline.estimate(self._body).state
