"""Time as a script sees it: simulated in ticks, or the wall clock."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from crazyarena.clock import Clock, VirtualClock
from crazyarena.crazyswarm_compat.csv_log import CsvLog
from crazyarena.crazyswarm_compat.options import warn
from crazyarena.crazyswarm_compat.registry import SimOptions
from crazyarena.crazyswarm_compat.video import VideoWriter, frame_period
from crazyarena.crazyswarm_compat.visualizers import VisNull
from crazyarena.errors import CommandError

_RESIDUAL_TOLERANCE = 1e-9
_SHORTEST = 1e-3  # s
_SLICE = 0.05  # s, of a real sleep between looks at what might end it


def _check_duration(duration: float) -> None:
    if not (math.isfinite(duration) and duration >= 0):
        raise CommandError(f"timeHelper.sleep: duration is {duration}; it must be finite and >= 0")


def _check_rate(rate: float) -> None:
    if not (math.isfinite(rate) and rate > 0):
        raise CommandError(f"timeHelper.sleepForRate: rate is {rate} Hz; it must be > 0")


class WallTimeHelper:
    """Sleeps on a real clock; ``sleepForRate`` keeps absolute deadlines."""

    def __init__(self, clock: Clock, vis: VisNull | None = None) -> None:
        self.clock = clock
        self.visualizer = vis if vis is not None else VisNull()
        self._rate = 0.0
        self._next = 0.0
        self._after_sleep: list[Callable[[], None]] = []
        self._while_sleeping: list[Callable[[], None]] = []
        self._due: list[Callable[[], float]] = []

    def time(self) -> float:
        """Seconds since the start."""
        return self.clock.now()

    def after_sleep(self, callback: Callable[[], None]) -> None:
        """Call ``callback()`` whenever a sleep ends."""
        self._after_sleep.append(callback)

    def while_sleeping(
        self, callback: Callable[[], None], due: Callable[[], float] | None = None
    ) -> None:
        """Call ``callback()`` again and again in a sleep, also at ``due()`` s; what it raises
        ends the sleep."""
        self._while_sleeping.append(callback)
        if due is not None:
            self._due.append(due)

    def _sleep_until(self, deadline: float) -> None:
        if self._while_sleeping:
            while (wake := self._wake()) < deadline:
                self.clock.sleep_until(wake)
                self._look()
        self.clock.sleep_until(deadline)
        self._look()
        for callback in self._after_sleep:
            callback()

    def _wake(self) -> float:
        now = self.clock.now()
        return min(now + _SLICE, *(max(now + _SHORTEST, due()) for due in self._due), math.inf)

    def _look(self) -> None:
        for callback in self._while_sleeping:
            callback()

    def sleep(self, duration: float) -> None:
        """Wait for ``duration`` s."""
        _check_duration(duration)
        self._sleep_until(self.clock.now() + duration)

    def sleepForRate(self, rateHz: float) -> None:
        """Wait until the next period of a loop that runs at ``rateHz``."""
        _check_rate(rateHz)
        if rateHz != self._rate:
            self._rate, self._next = rateHz, self.clock.now()
        self._next += 1.0 / rateHz
        self._sleep_until(self._next)

    def isShutdown(self) -> bool:
        """False: a script ends by itself."""
        return False


class TimeHelper:
    """Simulated time, which advances only in whole ticks while a script sleeps.

    Parameters
    ----------
    vis: viewer (see :mod:`.visualizers`).
    dt: tick, s.
    writecsv: write ``logcf<id>.csv`` files in the working directory.
    disturbanceSize: standard deviation of the velocity noise, m/s.
    maxVel: limit on the speed, m/s.
    videopath: film to write, or None; it plays in real time.
    """

    def __init__(
        self,
        vis: Any,
        dt: float,
        writecsv: bool,
        disturbanceSize: float,
        maxVel: float = math.inf,
        videopath: str | None = None,
    ) -> None:
        self.visualizer = vis
        self.dt = dt
        self.clock = VirtualClock()
        self.options = SimOptions(disturbanceSize, maxVel)
        self.crazyflies: list[Any] = []
        self.sleepResidual = 0.0
        self.output = CsvLog() if writecsv else None
        self.videoWriter = None
        if videopath is not None:
            frame = vis.render()
            self._frame_period = frame_period(videopath)
            self.videoWriter = VideoWriter(videopath, self._frame_period, frame.shape[:2])
            self._frames = 0
        self._observers: list[Any] = []
        self._after_sleep: list[Callable[[], None]] = []
        self._while_sleeping: list[Callable[[], None]] = []

    @property
    def t(self) -> float:
        """Simulated time, s."""
        return self.clock.now()

    @property
    def disturbanceSize(self) -> float:
        """Standard deviation of the velocity noise, m/s."""
        return self.options.disturbance

    @disturbanceSize.setter
    def disturbanceSize(self, value: float) -> None:
        self.options.disturbance = value

    @property
    def maxVel(self) -> float:
        """Limit on the speed, m/s."""
        return self.options.max_velocity

    @maxVel.setter
    def maxVel(self, value: float) -> None:
        self.options.max_velocity = value

    def time(self) -> float:
        """Simulated time, s."""
        return self.clock.now()

    def isShutdown(self) -> bool:
        """False: a script ends by itself."""
        return False

    def sleep(self, duration: float) -> None:
        """Advance by as many whole ticks as ``duration`` s and the last remainder hold."""
        _check_duration(duration)
        total = duration + self.sleepResidual
        ticks = math.floor(total / self.dt)
        residual = total - self.dt * ticks
        if not -_RESIDUAL_TOLERANCE <= residual < self.dt:
            raise AssertionError(f"sleep: residual {residual} s is outside 0..{self.dt}")
        self.sleepResidual = residual
        for _ in range(ticks):
            self.step(self.dt)
        for callback in self._after_sleep:
            callback()

    def sleepForRate(self, rateHz: float) -> None:
        """Advance by one period of ``rateHz``."""
        _check_rate(rateHz)
        self.sleep(1.0 / rateHz)

    def step(self, duration: float) -> None:
        """Advance by exactly one step of ``duration`` s."""
        now = self.clock.now()
        self.visualizer.update(now, self.crazyflies)
        for observer in self._observers:
            observer(now, self.crazyflies)
        if self.output is not None:
            self.output.add(now, self.crazyflies)
        if self.videoWriter is not None:
            self._film(now + duration)
        self.clock.sleep_until(now + duration)
        for callback in self._while_sleeping:
            callback()

    def _film(self, until: float) -> None:
        """Write the frames due before ``until`` s, which all show the present."""
        due = math.ceil(until / self._frame_period - 1e-6)
        if due > self._frames:
            assert self.videoWriter is not None
            frame = self.visualizer.render()
            for _ in range(due - self._frames):
                self.videoWriter.writeFrame(frame)
            self._frames = due

    def addObserver(self, observer: Any) -> None:
        """Call ``observer(t, crazyflies)`` (or its ``update``) before every tick."""
        call = getattr(observer, "update", observer)
        if not callable(call):
            raise CommandError(
                f"addObserver: {observer!r} is neither callable nor has a method update(t, cfs)"
            )
        self._observers.append(call)

    def after_sleep(self, callback: Callable[[], None]) -> None:
        """Call ``callback()`` whenever a sleep ends."""
        self._after_sleep.append(callback)

    def while_sleeping(
        self, callback: Callable[[], None], due: Callable[[], float] | None = None
    ) -> None:
        """Call ``callback()`` after every step (so ``due`` is not asked); what it raises ends
        the sleep."""
        self._while_sleeping.append(callback)

    def close(self) -> None:
        """Finish the log files and the film; idempotent."""
        if self.output is not None:
            self.output.close()
        if self.videoWriter is not None:
            self.videoWriter.close()

    _atexit = close


class ExactTimeHelper(TimeHelper):
    """Simulated time that stops exactly where a sleep ends (Crazyswarm2's rule)."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._rate = 0.0
        self._next = 0.0

    def _sleep_until(self, deadline: float) -> None:
        # A last step shorter than this would only be the rounding of the sum of the others.
        while (remaining := deadline - self.clock.now()) > _RESIDUAL_TOLERANCE:
            self.step(min(self.dt, remaining))
        for callback in self._after_sleep:
            callback()

    def sleep(self, duration: float) -> None:
        """Advance by ``duration`` s, in steps of at most ``dt``."""
        _check_duration(duration)
        self._sleep_until(self.clock.now() + duration)

    def sleepForRate(self, rateHz: float) -> None:
        """Advance to the next period of a loop that runs at ``rateHz``."""
        _check_rate(rateHz)
        if rateHz != self._rate:
            self._rate, self._next = rateHz, self.clock.now()
        self._next += 1.0 / rateHz
        self._sleep_until(self._next)


def make_time_helper(parsed: Any, vis: Any, kind: type[TimeHelper]) -> TimeHelper:
    """Time helper of class ``kind`` for parsed simulation flags."""
    if parsed.backend != "ideal":
        for flag, given in (
            ("disturbance", parsed.disturbance > 0),
            ("maxvel", math.isfinite(parsed.maxvel)),
        ):
            if given:
                warn(f"--{flag} only acts on --backend ideal, not on {parsed.backend}")
    else:
        given = {
            "--downwash": parsed.downwash,
            "--vehicle": parsed.vehicle is not None,
            "--vehicle-set": bool(parsed.vehicle_set),
        }
        for flag in (flag for flag, is_given in given.items() if is_given):
            warn(f"{flag}: perfect tracking knows no forces; it needs --backend sim or pybullet")
    helper = kind(
        vis,
        parsed.dt,
        parsed.writecsv,
        disturbanceSize=parsed.disturbance,
        maxVel=parsed.maxvel,
        videopath=parsed.video,
    )
    helper.options.downwash = parsed.downwash
    helper.options.vehicle = parsed.vehicle
    helper.options.vehicle_set = tuple(parsed.vehicle_set)
    return helper
