"""What scripts of Crazyswarm2 use of ROS, where no ROS is needed for it: messages, the node's
logger, clock and timers."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from crazyarena.clock import Clock
from crazyarena.errors import CommandError


@dataclass(slots=True)
class Point:
    """geometry_msgs/Point, m."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


@dataclass(slots=True)
class Quaternion:
    """geometry_msgs/Quaternion."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    w: float = 1.0


@dataclass(slots=True)
class PoseMessage:
    """geometry_msgs/Pose."""

    position: Point = field(default_factory=Point)
    orientation: Quaternion = field(default_factory=Quaternion)


@dataclass(slots=True)
class Stamp:
    """builtin_interfaces/Time."""

    sec: int = 0
    nanosec: int = 0


@dataclass(slots=True)
class Header:
    """std_msgs/Header."""

    stamp: Stamp = field(default_factory=Stamp)
    frame_id: str = "world"


class Record(dict[str, Any]):
    """A dict, as Crazyswarm2 hands out, whose entries are attributes too."""

    def __getattr__(self, name: str) -> Any:
        try:
            return self[name]
        except KeyError:
            raise AttributeError(
                f"no {name!r}; there are {', '.join(self) or 'none yet'}"
            ) from None


class PoseStamped(Record):
    """``id`` (frame), ``timestamp_sec``, ``timestamp_nsec`` and ``pose``; empty before the first
    one. ``header`` as in geometry_msgs/PoseStamped."""

    @property
    def header(self) -> Header:
        """Stamp and frame."""
        if not self:
            return Header()
        return Header(Stamp(self["timestamp_sec"], self["timestamp_nsec"]), self["id"])


def split_seconds(seconds: float) -> tuple[int, int]:
    """Whole seconds, and nanoseconds."""
    whole = math.floor(seconds)
    return whole, math.floor((seconds - whole) * 1e9)


class Instant:
    """rclpy's Time, as far as scripts read it."""

    def __init__(self, seconds: float) -> None:
        self.nanoseconds = round(seconds * 1e9)

    def seconds_nanoseconds(self) -> tuple[int, int]:
        """Whole seconds, and nanoseconds."""
        return divmod(self.nanoseconds, 1_000_000_000)

    def to_msg(self) -> Stamp:
        """As a message."""
        return Stamp(*self.seconds_nanoseconds())


class NodeClock:
    """rclpy's Clock on the session clock."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock

    def now(self) -> Instant:
        """The time now."""
        return Instant(self._clock.now())


class NodeLogger:
    """rclpy's logger; writes to standard error."""

    def __init__(self, name: str, clock: Clock) -> None:
        self.name = name
        self._clock = clock

    def _write(self, level: str, message: object) -> None:
        print(f"[{level}] [{self._clock.now():.3f}] [{self.name}]: {message}", file=sys.stderr)

    def debug(self, message: object, **_: Any) -> None:
        """Not shown, as by ROS's default."""

    def info(self, message: object, **_: Any) -> None:
        """Tell."""
        self._write("INFO", message)

    def warning(self, message: object, **_: Any) -> None:
        """Warn."""
        self._write("WARN", message)

    warn = warning

    def error(self, message: object, **_: Any) -> None:
        """Complain."""
        self._write("ERROR", message)

    def fatal(self, message: object, **_: Any) -> None:
        """Complain loudly."""
        self._write("FATAL", message)


class Timer:
    """rclpy's Timer: runs while the script sleeps, as callbacks of a spinning node do."""

    def __init__(self, period: float, callback: Callable[[], None], clock: Clock) -> None:
        self._period = period
        self._callback = callback
        self._clock = clock
        self._cancelled = False
        self._due = clock.now() + period

    @property
    def timer_period_ns(self) -> int:
        """Period, ns."""
        return round(self._period * 1e9)

    @property
    def due(self) -> float:
        """When it fires next, s; ``inf`` for never."""
        return math.inf if self._cancelled else self._due

    def cancel(self) -> None:
        """Fire no more until :meth:`reset`."""
        self._cancelled = True

    def is_canceled(self) -> bool:
        """Whether it was cancelled."""
        return self._cancelled

    def reset(self) -> None:
        """Begin a new period now."""
        self._cancelled = False
        self._due = self._clock.now() + self._period

    def fire(self, now: float) -> None:
        """Call back if due: once, however many periods have passed."""
        if now + 1e-9 < self.due:
            return
        late = math.floor((now + 1e-9 - self._due) / self._period)
        self._due += (late + 1) * self._period
        self._callback()


class NodeLike:
    """The part of a ROS node that ``allcfs`` is to its scripts."""

    _NAME = "CrazyflieAPI"

    def _init_node(self, timeHelper: Any) -> None:
        self._clock: Clock = timeHelper.clock
        self._timers: list[Timer] = []
        self._firing = False
        self._time_helper = timeHelper

    def get_name(self) -> str:
        """Name of the node."""
        return self._NAME

    def get_logger(self) -> NodeLogger:
        """Logger that writes to standard error."""
        return NodeLogger(self._NAME, self._clock)

    def get_clock(self) -> NodeClock:
        """The session's clock: simulated time in simulation."""
        return NodeClock(self._clock)

    def create_timer(
        self, timer_period_sec: float, callback: Callable[[], None], *_: Any, **__: Any
    ) -> Timer:
        """Call ``callback()`` every ``timer_period_sec`` s while the script sleeps (in
        simulation at the end of the tick in which it is due)."""
        if not (math.isfinite(timer_period_sec) and timer_period_sec > 0):
            raise CommandError(f"create_timer: period is {timer_period_sec}; it must be > 0 s")
        if not self._timers:
            self._time_helper.while_sleeping(self._fire, self._next_timer)
        timer = Timer(float(timer_period_sec), callback, self._clock)
        self._timers.append(timer)
        return timer

    def destroy_timer(self, timer: Timer) -> bool:
        """Cancel a timer for good."""
        timer.cancel()
        return True

    def _next_timer(self) -> float:
        return min(timer.due for timer in self._timers)

    def _fire(self) -> None:
        if self._firing:  # a callback that sleeps
            return
        self._firing = True
        try:
            for timer in tuple(self._timers):
                timer.fire(self._clock.now())
        finally:
            self._firing = False
