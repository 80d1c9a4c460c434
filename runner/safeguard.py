"""The watchdog, the command gate and the emergency stop of one trial, put together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from crazyarena.clock import Clock
from crazyarena.crazyswarm_compat.backend import Backend
from crazyarena.levels.schema import Level
from crazyarena.mocap.estimator import FrameResult
from crazyarena.mocap.pipeline import PosePipeline
from crazyarena.runner.referee import Event
from crazyarena.safety.estop import EmergencyStop, Hold
from crazyarena.safety.events import Action, SafetyEvent
from crazyarena.safety.fence import Fence
from crazyarena.safety.gate import CommandGate
from crazyarena.safety.limits import Limits
from crazyarena.safety.watchdog import Watchdog
from crazyarena.types import PoseFrame, VehicleState

_LANDING = 20.0  # s, for the watchdog to bring a vehicle down
_TICK = 0.02  # s


def limits_for(rate: float, max_misses: int) -> Limits:
    """Default limits, with the runner's own patience for a contestant that does not answer."""
    hold = (max_misses + 2) / rate
    default = Limits()
    return replace(
        default,
        controller_hold=max(default.controller_hold, hold),
        controller_warn=min(default.controller_warn, 0.5 * hold),
    )


class Safeguard:
    """Guards one vehicle of a trial; a :class:`~crazyarena.runner.flight.Watch`.

    Parameters
    ----------
    backend: the vehicle link itself.
    feed: feeds the vehicle's own emergency-stop watchdog; None if it has none.
    dead_man: what the operator holds while the vehicle flies; None for nothing.
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
    ) -> None:
        self._dead_man = dead_man
        self._clock = clock
        self._vehicle = vehicle
        self._body = body
        self._epoch = 0.0
        self._feed = feed
        self._told: list[SafetyEvent] = []
        self._pipeline: PosePipeline | None = None
        self._watchdog: Watchdog | None = None
        self.fence = Fence.from_level(level)
        self.estop = EmergencyStop([backend], clock)
        self.gate = CommandGate(
            backend,
            self.fence,
            clock,
            limits or limits_for(level.control_frequency, 15),
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

    def on_frame(self, frame: PoseFrame, result: FrameResult) -> None:
        """For the pipeline."""
        if self._watchdog is not None:
            self._watchdog.on_frame(frame, result)

    def close(self) -> None:
        """Stop watching; idempotent."""
        if self._watchdog is not None:
            self._watchdog.close()
        self.estop.close()

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
        self._clock.sleep_until(self._clock.now() + _TICK)

    def end(self) -> bool:
        self.watchdog.controller_done(self._vehicle)
        if not self.watchdog.action(self._vehicle).takes_over:
            return False
        end = self._clock.now() + _LANDING
        while not self.watchdog.over(self._vehicle) and self._clock.now() < end:
            self._clock.sleep_until(self._clock.now() + _TICK)
        return True

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
