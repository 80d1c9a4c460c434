"""Faults of the cameras and of the way of their frames."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from crazyarena.runner.campaign.strikes.struck import Struck
from crazyarena.types import Pose, PoseFrame


def dropout(f: Struck) -> None:
    """The vehicle, or every frame, is missing for a while or for good."""
    duration = f.rng.choice((0.05, 0.2, 0.6, 60.0))

    def spoil(frame: PoseFrame) -> PoseFrame | None:
        gone = frame.timestamp - f.onset < duration
        bodies = {k: v for k, v in frame.bodies.items() if k != f.body}
        return replace(frame, bodies=bodies) if gone else frame

    def silent(frame: PoseFrame) -> PoseFrame | None:
        return None if frame.timestamp - f.onset < duration else frame

    f.cameras.spoil = f.rng.choice((spoil, silent))


def freeze(f: Struck) -> None:
    """Every frame from now on is the same."""
    frozen: dict[str, Pose] = {}

    def spoil(frame: PoseFrame) -> PoseFrame:
        if not frozen:
            frozen.update(frame.bodies)
        return replace(frame, bodies=frozen)

    f.cameras.spoil = spoil


def hiccup(f: Struck) -> None:
    """Again and again the cameras tell of one place, with noise and fresh stamps, and catch up."""
    duration, gap = f.rng.uniform(0.06, 0.2), f.rng.uniform(0.2, 1.0)
    noise = np.random.default_rng(f.seed)
    old: Pose | None = None

    def spoil(frame: PoseFrame) -> PoseFrame:
        nonlocal old
        pose = frame.bodies.get(f.body)
        since = (frame.timestamp - f.onset) % (duration + gap)
        if pose is None or since > duration:
            old = None
            return frame
        old = old or pose
        stuck = Pose(old.position + noise.normal(0.0, 3e-4, 3), pose.quaternion)
        return replace(frame, bodies={**frame.bodies, f.body: stuck})

    f.cameras.spoil = spoil


def jump(f: Struck) -> None:
    """The vehicle is seen somewhere else for a while or for good."""
    duration = f.rng.choice((0.01, 0.05, 0.3, 60.0))
    angle = f.rng.uniform(0.0, 2.0 * math.pi)
    size = f.rng.uniform(0.3, 3.0)
    offset = np.array([size * math.cos(angle), size * math.sin(angle), f.rng.uniform(-0.3, 0.3)])

    def spoil(frame: PoseFrame) -> PoseFrame:
        pose = frame.bodies.get(f.body)
        if pose is None or frame.timestamp - f.onset > duration:
            return frame
        moved = Pose(pose.position + offset, pose.quaternion)
        return replace(frame, bodies={**frame.bodies, f.body: moved})

    f.cameras.spoil = spoil


def swap(f: Struck) -> None:
    """The vehicle and the other body change names for a while or for good."""
    duration = f.rng.choice((0.03, 0.5, 60.0))

    def spoil(frame: PoseFrame) -> PoseFrame:
        if frame.timestamp - f.onset > duration:
            return frame
        names = {f.body: f.other, f.other: f.body}
        return replace(frame, bodies={names.get(k, k): v for k, v in frame.bodies.items()})

    f.cameras.spoil = spoil


def latency(f: Struck) -> None:
    """Frames come later and later."""
    rate, most = f.rng.uniform(0.05, 0.5), f.rng.uniform(0.05, 0.5)

    def grow(since: float) -> None:
        f.cameras.delay = min(rate * since, most)

    f.each = grow
