"""Serve poses to others, by any protocol. Logic of ``crazyarena mocap-server``."""

from __future__ import annotations

import math
import threading
from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np

from crazyarena.clock import Clock
from crazyarena.mocap.sim_source import Truth
from crazyarena.mocap.source import PoseSource, SourceState
from crazyarena.types import Pose, PoseFrame


class Outlet(Protocol):
    """Where frames go: a vendor's server (:mod:`~crazyarena.mocap.vendor_server`,
    :mod:`~crazyarena.mocap.natnet_server`, :mod:`~crazyarena.mocap.vrpn_server`) or
    :class:`~crazyarena.mocap.zenoh_link.ZenohPublisher`."""

    def publish(self, frame: PoseFrame) -> None: ...

    def close(self) -> None: ...


def circling(names: Sequence[str], radius: float = 1.0, period: float = 6.0) -> Truth:
    """Truth for trials of the plumbing: bodies that circle level, one above the other."""

    def truth(time: float) -> Mapping[str, Pose]:
        poses = {}
        for i, name in enumerate(names):
            angle = 2.0 * math.pi * (time / period + i / max(1, len(names)))
            position = np.array([radius * math.cos(angle), radius * math.sin(angle), 0.5 + 0.1 * i])
            heading = 0.5 * (angle + 0.5 * math.pi)
            poses[name] = Pose(position, np.array([0.0, 0.0, math.sin(heading), math.cos(heading)]))
        return poses

    return truth


def relay(
    source: PoseSource,
    outlets: Sequence[Outlet],
    clock: Clock,
    duration: float = math.inf,
    stop: threading.Event | None = None,
) -> int:
    """Pass every frame of ``source`` on to every outlet; return how many.

    Ends after ``duration`` s, when the source ends, or when ``stop`` is set. With
    :class:`~crazyarena.mocap.motioncapture_source.MotionCaptureSource` and a zenoh outlet this
    is the machine that reads the cameras for all others.
    """
    end = clock.now() + duration
    count = 0
    while clock.now() < end and not (stop is not None and stop.is_set()):
        frames = source.frames(0.05)
        for frame in frames:
            for outlet in outlets:
                outlet.publish(frame)
        count += len(frames)
        if not frames and source.status.state in (SourceState.CLOSED, SourceState.ENDED):
            break
    return count
