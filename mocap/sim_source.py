"""Simulated motion capture: true poses seen through a :class:`CameraModel`."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping

import numpy as np

from crazyarena.clock import Clock, VirtualClock
from crazyarena.mocap.camera_model import Camera, CameraModel
from crazyarena.mocap.source import SourceState, SourceStatus
from crazyarena.types import Pose, PoseFrame

Truth = Callable[[float], Mapping[str, Pose]]


class SimSource:
    """Pose source of the simulated world.

    Parameters
    ----------
    clock: the session clock, virtual or wall.
    truth: ``truth(time)`` returns the true poses at an exposure time, s, which is never later
        than now. Leave it out when the simulator pushes instead: it then calls :meth:`expose`
        whenever its time reaches :attr:`next_exposure`.
    model: the camera system.
    seed: an integer or a Generator spawned from the trial's seed.
    """

    def __init__(
        self,
        clock: Clock,
        truth: Truth | None = None,
        model: CameraModel | None = None,
        seed: int | np.random.Generator = 0,
    ) -> None:
        self._clock = clock
        self._truth = truth
        self.model = model or CameraModel()
        self._camera = Camera(self.model, np.random.default_rng(seed))
        self._start = clock.now()
        self._frame = 0
        self._delivered = 0
        self._lost = 0
        self._closed = False
        self._flying: deque[PoseFrame] = deque()
        self._last_arrival = 0.0

    @property
    def next_exposure(self) -> float:
        """Session time of the next exposure, s."""
        return self._start + self._frame / self.model.rate

    @property
    def next_event(self) -> float:
        """Session time of whatever comes first: the next exposure, or a frame's arrival, s."""
        if self._flying:
            return min(self.next_exposure, self._flying[0].received)
        return self.next_exposure

    def expose(self, time: float, truth: Mapping[str, Pose]) -> None:
        """Take one frame of the true poses at ``time``."""
        frame_id = self._frame
        self._frame += 1
        bodies, markers = self._camera.see(truth)
        # One cable keeps the order: a frame that jitter delayed holds up the next.
        arrival = max(time + self._camera.delay(), self._last_arrival)
        if self._camera.lost():
            self._lost += 1
            return
        self._last_arrival = arrival
        self._flying.append(PoseFrame(time, arrival, frame_id, bodies, markers))

    def frames(self, timeout: float = 0.0) -> list[PoseFrame]:
        """Return the frames that have arrived by now.

        With a wall clock it waits up to ``timeout`` for one; a virtual clock is not advanced
        here, since only the simulation's owner may move time.
        """
        taken = self._arrived()
        if not taken and timeout > 0 and not isinstance(self._clock, VirtualClock):
            give_up = self._clock.now() + timeout
            while not taken and not self._closed:
                now = self._clock.now()
                if now >= give_up:
                    break
                due = min(self._flying[0].received if self._flying else give_up, self.next_exposure)
                self._clock.sleep_until(min(max(due, now + 1e-4), give_up, now + 0.05))
                taken = self._arrived()
        self._delivered += len(taken)
        return taken

    def _arrived(self) -> list[PoseFrame]:
        if self._closed:
            return []
        now = self._clock.now()
        if self._truth is not None:
            while self.next_exposure <= now:
                time = self.next_exposure
                self.expose(time, self._truth(time))
        taken = []
        while self._flying and self._flying[0].received <= now:
            taken.append(self._flying.popleft())
        return taken

    @property
    def status(self) -> SourceStatus:
        state = SourceState.CLOSED if self._closed else SourceState.LIVE
        return SourceStatus(state, frames=self._delivered, lost=self._lost)

    def close(self) -> None:
        self._closed = True
        self._flying.clear()
