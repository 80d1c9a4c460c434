"""External poses to the vehicles: at a set rate, on arrival of a frame, newest wins."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from crazyarena.clock import Clock
from crazyarena.errors import InputError
from crazyarena.types import Pose, Vector

SendPoses = Callable[[Mapping[int, Pose]], None]
SendPositions = Callable[[Mapping[int, Vector]], None]


@dataclass(frozen=True, slots=True)
class ForwardStatistics:
    """What one vehicle was sent lately.

    rate: poses per second over the last samples; age_p50, age_p99, age_max: time from capture
    to hand-over, s; sent: in total; overtaken: poses replaced by a newer one before they could
    be sent (only when the link is slower than the frames).
    """

    sent: int
    overtaken: int
    rate: float
    age_p50: float
    age_p99: float
    age_max: float


class _Vehicle:
    def __init__(self) -> None:
        self.due = -np.inf
        self.sent = 0
        self.overtaken = 0
        self.ages: deque[float] = deque(maxlen=512)
        self.times: deque[float] = deque(maxlen=512)
        self.captured = -np.inf


class PoseForwarder:
    """Forward measured poses to the vehicles that own them.

    Parameters
    ----------
    vehicles: vehicle id by body name.
    send: carries poses by vehicle id (``Backend.send_external_poses``).
    clock: the session clock.
    rate: largest number of poses per second and vehicle, Hz; frames in between are skipped.
    mode: ``pose``, or ``position`` for vehicles whose attitude the cameras see badly (single
        markers); then ``send_positions`` carries positions (3,) by vehicle id.
    threaded: send in a thread of its own, so that a slow link never delays the estimator;
        what it cannot keep up with is overtaken, never queued.
    max_age: poses older than this when they arrive are dropped, s: a vehicle takes whatever it
        is given for the present.
    """

    def __init__(
        self,
        vehicles: Mapping[str, int],
        send: SendPoses,
        clock: Clock,
        *,
        rate: float = 100.0,
        mode: Literal["pose", "position"] = "pose",
        send_positions: SendPositions | None = None,
        threaded: bool = False,
        max_age: float = 0.1,
    ) -> None:
        if not max_age > 0:
            raise InputError(f"external pose max_age: found {max_age}; need seconds above 0")
        if not rate > 0:
            raise InputError(f"external pose rate: found {rate}; need Hz above 0")
        if mode not in ("pose", "position"):
            raise InputError(f"external pose mode: found {mode!r}; choose pose or position")
        if mode == "position" and send_positions is None:
            raise InputError("external pose mode position: this vehicle link sends full poses only")
        if len(set(vehicles.values())) != len(vehicles):
            raise InputError(f"vehicles: an id occurs twice in {dict(vehicles)}")
        self._ids = dict(vehicles)
        self._send = send
        self._send_positions = send_positions
        self._clock = clock
        self._period = 1.0 / rate
        self._mode = mode
        self._vehicles = {vehicle: _Vehicle() for vehicle in vehicles.values()}
        self._lock = threading.Condition(threading.Lock())
        self._waiting: dict[int, tuple[float, Pose]] = {}
        self._closed = False
        self._max_age = max_age
        self.too_old = 0
        self.failures = 0
        self.last_failure: str | None = None
        self._thread: threading.Thread | None = None
        if threaded:
            self._thread = threading.Thread(target=self._run, name="pose-forwarder", daemon=True)
            self._thread.start()

    def submit(self, captured: float, poses: Mapping[str, Pose], received: float) -> None:
        """Offer the accepted poses of one frame; call for every frame, in order.

        captured, received: times of the frame, s. Bodies that are no vehicles are ignored.
        """
        with self._lock:
            for name, pose in poses.items():
                vehicle = self._ids.get(name)
                if vehicle is None:
                    continue
                state = self._vehicles[vehicle]
                # A pose counts once, however often it is offered.
                if captured <= state.captured:
                    continue
                if received - captured > self._max_age:
                    self.too_old += 1
                    continue
                # A frame that is early by jitter is sent rather than the next one late; the
                # raster of due times is kept, so that the mean rate is right.
                if received < state.due - 0.25 * self._period:
                    continue
                state.captured = captured
                state.due = max(state.due + self._period, received)
                if vehicle in self._waiting:
                    state.overtaken += 1
                self._waiting[vehicle] = (captured, pose)
            self._lock.notify()

    def flush(self) -> None:
        """Send what waits (the thread does this by itself)."""
        if self._thread is None:
            self._dispatch(self._collect())

    def _collect(self) -> dict[int, tuple[float, Pose]]:
        with self._lock:
            batch, self._waiting = self._waiting, {}
        return batch

    def _dispatch(self, batch: Mapping[int, tuple[float, Pose]]) -> None:
        if not batch:
            return
        try:
            if self._mode == "pose":
                self._send({vehicle: pose for vehicle, (_, pose) in batch.items()})
            else:
                assert self._send_positions is not None
                self._send_positions({v: pose.position for v, (_, pose) in batch.items()})
        except Exception as error:  # a link that fails must not stop the estimator
            self.failures += 1
            self.last_failure = f"{type(error).__name__}: {error}"
            return
        now = self._clock.now()
        with self._lock:
            for vehicle, (captured, _) in batch.items():
                state = self._vehicles[vehicle]
                state.sent += 1
                state.ages.append(now - captured)
                state.times.append(now)

    def _run(self) -> None:
        while True:
            with self._lock:
                self._lock.wait_for(lambda: self._waiting or self._closed)
                if self._closed:
                    return
            self._dispatch(self._collect())

    def statistics(self) -> dict[int, ForwardStatistics]:
        """Return rate and age per vehicle id."""
        result = {}
        with self._lock:
            for vehicle, state in self._vehicles.items():
                ages = np.array(state.ages) if state.ages else np.array([np.nan])
                span = state.times[-1] - state.times[0] if len(state.times) > 1 else 0.0
                rate = (len(state.times) - 1) / span if span > 0 else 0.0
                p50, p99 = np.percentile(ages, (50, 99)).tolist()
                result[vehicle] = ForwardStatistics(
                    state.sent, state.overtaken, rate, p50, p99, float(ages.max())
                )
        return result

    def close(self) -> None:
        """Stop the thread; what waits is not sent."""
        with self._lock:
            self._closed = True
            self._lock.notify_all()
        if self._thread is not None:
            self._thread.join(timeout=0.5)
