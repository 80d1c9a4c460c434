"""Poses without cameras: what a vehicle estimates of itself, by lighthouse, LPS or flow deck.

Nothing looks at the vehicle from outside, so nothing here can contradict it. What the vehicle
tells of its own uncertainty is all there is: an estimate of which its filter is not sure counts as
a body that is not seen.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Any

from crazyarena.clock import Clock
from crazyarena.errors import InputError
from crazyarena.mocap.source import FrameQueue, SourceState, SourceStatus
from crazyarena.mocap.stamps import StampReader
from crazyarena.types import Pose, PoseFrame, Telemetry

KIND = "onboard"
_TICKS = 1 << 24  # ms, after which the vehicle's stamps begin anew
_BREAK = 10_000  # ms from one estimate to the next, after which its clock is another


class Certainty:
    """How sure a vehicle must be of its estimate.

    Parameters
    ----------
    relative: nothing on board knows the place itself, as with a flow deck alone: then only the
        velocity is asked of, and the position drifts.
    position_std: m; velocity_std: m/s.

    Raises
    ------
    InputError: a limit is not above 0.
    """

    def __init__(
        self, relative: bool = False, position_std: float = 0.15, velocity_std: float = 0.5
    ) -> None:
        for name, value in (("position_std", position_std), ("velocity_std", velocity_std)):
            if not value > 0:
                raise InputError(f"mocap onboard {name}: found {value}; need a number above 0")
        self.relative = relative
        self._position_std = position_std
        self._velocity_std = velocity_std

    def doubt(self, told: Telemetry) -> str | None:
        """Why the estimate must not be believed, in words; None if it may be."""
        position, velocity = told.position_std, told.velocity_std
        if position is None or velocity is None:
            return "the vehicle does not tell how sure it is of its place (kalman.var*)"
        if not self.relative and not position <= self._position_std:
            return (
                f"the vehicle is sure of its place to {position:.2f} m only (limit "
                f"{self._position_std:g} m)"
            )
        if not velocity <= self._velocity_std:
            return (
                f"the vehicle is sure of its speed to {velocity:.2f} m/s only (limit "
                f"{self._velocity_std:g} m/s)"
            )
        return None


def certainty(relative: bool, options: Mapping[str, Any]) -> Certainty:
    """The limits that ``--mocap-option`` changes: ``position_std`` and ``velocity_std``.

    Raises
    ------
    InputError: another option, or a limit that is not a number above 0.
    """
    unknown = set(options) - {"position_std", "velocity_std"}
    if unknown:
        raise InputError(
            f"mocap source onboard: unknown option {min(unknown)!r}; there are position_std and "
            "velocity_std"
        )
    return Certainty(relative, **options)


class _VehicleClock:
    """A vehicle's stamps on the session's clock."""

    def __init__(self, clock: Clock) -> None:
        self._reader = StampReader(clock)
        self._last: int | None = None
        self._time = 0
        self._boots = 0

    def time_of(self, stamp: int, received: float) -> float:
        """s, of a stamp (ms modulo 2^24) that came at ``received`` s."""
        elapsed = 0 if self._last is None else (stamp - self._last) % _TICKS
        if elapsed > _BREAK:
            self._boots += 1
            elapsed = 0
        self._last = stamp
        self._time += elapsed
        sent = 1e-3 * self._time
        return self._reader.capture_time(self._boots, sent, sent, received)


class OnboardSource:
    """Pose frames of one body each, from the estimates that vehicles send; see :meth:`told`.

    The capture time is that of the vehicle's own stamp, on a clock that is set by its fastest
    recent message: what the radio always takes (some milliseconds) is not seen, what repeats and
    queues add is.
    """

    def __init__(self, clock: Clock, certainty: Certainty | None = None) -> None:
        self.certainty = certainty or Certainty()
        self._clock = clock
        self._queue = FrameQueue()
        self._vehicles: dict[str, _VehicleClock] = {}
        self._frames = 0
        self._lock = threading.Lock()

    def told(self, body: str, told: Telemetry, stamp: int) -> None:
        """Take the estimate in ``told.state``; ``stamp`` is the vehicle's, ms modulo 2^24.

        Any thread.
        """
        state = told.state
        if state is None:
            return
        doubt = self.certainty.doubt(told)
        bodies = {} if doubt else {body: Pose(state.position, state.quaternion)}
        with self._lock:
            received = self._clock.now()
            clock = self._vehicles.setdefault(body, _VehicleClock(self._clock))
            captured = clock.time_of(stamp, received)
            self._frames += 1
            self._queue.put(PoseFrame(captured, received, self._frames, bodies), 0)
        error = None if doubt is None else f"{body}: {doubt}"
        if self._queue.status.error != error:
            self._queue.note(error=error)

    def frames(self, timeout: float = 0.0) -> list[PoseFrame]:
        return self._queue.take(timeout)

    @property
    def status(self) -> SourceStatus:
        return self._queue.status

    def close(self) -> None:
        self._queue.note(SourceState.CLOSED)
