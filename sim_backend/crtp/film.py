"""Cameras without faults: the true poses at a steady rate, with no delay."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from crazyarena.types import Pose, PoseFrame


class PushedCameras(Protocol):
    """Cameras that are shown the world by whoever simulates it, at the times they name."""

    @property
    def next_exposure(self) -> float:
        """When the next frame is to be taken, s."""
        ...

    @property
    def next_event(self) -> float:
        """When the next frame is to be taken, or one that was taken arrives, s."""
        ...

    def expose(self, time: float, truth: Mapping[str, Pose]) -> None:
        """Take one frame of the true poses at ``time``."""
        ...

    def frames(self, timeout: float = 0.0) -> list[PoseFrame]:
        """Frames that have arrived since the last call."""
        ...


class IdealCameras:
    """Stands in for :class:`~crazyarena.mocap.sim_source.SimSource` where nothing goes wrong.

    Parameters
    ----------
    start: time of the first exposure, s. rate: Hz.
    """

    def __init__(self, start: float, rate: float) -> None:
        self._start = start
        self._rate = rate
        self._count = 0
        self._taken: list[PoseFrame] = []

    @property
    def next_exposure(self) -> float:
        """When the next frame is to be taken, s."""
        return self._start + self._count / self._rate

    @property
    def next_event(self) -> float:
        """When the next frame is to be taken, s."""
        return self.next_exposure

    def expose(self, time: float, truth: Mapping[str, Pose]) -> None:
        """Take one frame."""
        self._taken.append(PoseFrame(time, time, self._count, truth))
        self._count += 1

    def frames(self, timeout: float = 0.0) -> list[PoseFrame]:
        """Frames taken since the last call."""
        taken, self._taken = self._taken, []
        return taken
