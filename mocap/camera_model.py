"""What a camera system does to true poses: rate, latency, noise, and everything that goes wrong."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from crazyarena.errors import InputError
from crazyarena.mocap.rotations import multiply, rotate
from crazyarena.types import Pose, Vector


@dataclass(frozen=True, slots=True)
class CameraModel:
    """Settings of a simulated camera system. The defaults are a well-kept 120 Hz arena.

    Attributes
    ----------
    rate: frames per second.
    latency: mean time from exposure to reception, s; latency_jitter: standard deviation of
        the part that varies (half-normal, so the mean delay is a little above), s.
    position_noise: per axis, m; attitude_noise: per axis, rad; marker_noise: per axis, m.
    dropout: probability per body (or marker) and frame that an occlusion begins;
        dropout_frames: mean length of an occlusion, frames (geometric).
    frame_loss: probability that a whole frame is lost on the way (its id is used up).
    jump, jump_distance: probability per body and frame of a one-frame outlier, and its size, m.
    flip: probability per body and frame of a one-frame turn by 180 degrees about a random
        body axis, as symmetric or merged markers produce.
    name_swap: probability per frame that two bodies exchange names; swap_frames: for how long.
    output: ``bodies`` (rigid bodies by name), ``markers`` (one unlabelled marker per body at
        its origin, or the constellation given in ``constellations``), or ``both``.
    constellations: marker positions (k, 3) in the body frame, by body name, m.
    merge_distance: markers closer than this are seen as one, m; 0 to keep all.
    """

    rate: float = 120.0
    latency: float = 0.008
    latency_jitter: float = 0.0005
    position_noise: float = 0.0005
    attitude_noise: float = 0.008
    marker_noise: float = 0.0005
    dropout: float = 0.0005
    dropout_frames: float = 2.0
    frame_loss: float = 0.0
    jump: float = 0.0
    jump_distance: float = 0.5
    flip: float = 0.0
    name_swap: float = 0.0
    swap_frames: int = 1
    output: Literal["bodies", "markers", "both"] = "bodies"
    constellations: Mapping[str, Vector] = field(default_factory=dict)
    merge_distance: float = 0.0

    def __post_init__(self) -> None:
        for name in ("dropout", "frame_loss", "jump", "flip", "name_swap"):
            value = getattr(self, name)
            if not 0 <= value <= 1:
                raise InputError(f"camera model {name}: found {value}; need a probability")
        for name in (
            "latency", "latency_jitter", "position_noise", "attitude_noise", "marker_noise",
            "jump_distance", "merge_distance",
        ):  # fmt: skip
            value = getattr(self, name)
            if not (value >= 0 and math.isfinite(value)):
                raise InputError(f"camera model {name}: found {value}; need 0 or more")
        if not (self.rate > 0 and math.isfinite(self.rate)):
            raise InputError(f"camera model rate: found {self.rate}; need frames per second > 0")
        if self.dropout_frames < 1 or self.swap_frames < 1:
            raise InputError("camera model dropout_frames and swap_frames: need 1 or more")
        if self.output not in ("bodies", "markers", "both"):
            raise InputError(
                f"camera model output: found {self.output!r}; choose bodies, markers or both"
            )


class Camera:
    """A :class:`CameraModel` at work: holds the random stream and running disturbances.

    Draws happen in a fixed order per frame, in the order of the bodies handed in, so equal
    seeds and equal truth give equal frames.
    """

    def __init__(self, model: CameraModel, rng: np.random.Generator) -> None:
        self.model = model
        self._rng = rng
        self._hidden: dict[str, int] = {}
        self._swap: tuple[str, str] | None = None
        self._swap_left = 0

    def delay(self) -> float:
        """Draw the time from exposure to reception of one frame, s."""
        model = self.model
        return model.latency + abs(self._rng.normal(0.0, 1.0)) * model.latency_jitter

    def lost(self) -> bool:
        """Draw whether a whole frame is lost."""
        return bool(self._rng.random() < self.model.frame_loss)

    def _occluded(self, key: str) -> bool:
        left = self._hidden.get(key, 0)
        draw = self._rng.random()
        if left > 0:
            self._hidden[key] = left - 1
            return True
        if draw < self.model.dropout:
            self._hidden[key] = int(self._rng.geometric(1.0 / self.model.dropout_frames)) - 1
            return True
        return False

    def _body(self, pose: Pose) -> Pose:
        model, rng = self.model, self._rng
        position = pose.position + rng.normal(0.0, 1.0, 3) * model.position_noise
        turn = np.empty(4)
        turn[:3] = rng.normal(0.0, 0.5, 3) * model.attitude_noise
        turn[3] = math.sqrt(max(0.0, 1.0 - float(turn[:3] @ turn[:3])))
        quaternion = multiply(pose.quaternion, turn)
        if model.jump and rng.random() < model.jump:
            direction = rng.normal(0.0, 1.0, 3)
            position = position + direction / np.linalg.norm(direction) * model.jump_distance
        if model.flip and rng.random() < model.flip:
            half_turn = np.zeros(4)
            half_turn[rng.integers(3)] = 1.0
            quaternion = multiply(quaternion, half_turn)
        return Pose(position, quaternion / np.linalg.norm(quaternion))

    def _swapped(self, names: Sequence[str]) -> dict[str, str]:
        model, rng = self.model, self._rng
        if model.name_swap == 0.0 or len(names) < 2:
            return {}
        if self._swap_left == 0 and rng.random() < model.name_swap:
            first, second = rng.choice(len(names), 2, replace=False)
            self._swap = (names[first], names[second])
            self._swap_left = model.swap_frames
        if self._swap is None or self._swap_left == 0:
            return {}
        self._swap_left -= 1
        first_name, second_name = self._swap
        return {first_name: second_name, second_name: first_name}

    def see(self, truth: Mapping[str, Pose]) -> tuple[dict[str, Pose], Vector]:
        """Return the bodies and markers the cameras report for the true poses."""
        model = self.model
        bodies: dict[str, Pose] = {}
        if model.output != "markers":
            renamed = self._swapped(list(truth))
            for name, pose in truth.items():
                measured = self._body(pose)
                if not self._occluded(name):
                    bodies[renamed.get(name, name)] = measured
        markers: Vector = np.empty((0, 3))
        if model.output != "bodies":
            markers = self._markers(truth)
        return bodies, markers

    def _markers(self, truth: Mapping[str, Pose]) -> Vector:
        model, rng = self.model, self._rng
        seen = []
        origin = np.zeros((1, 3))
        for name, pose in truth.items():
            local = np.asarray(model.constellations.get(name, origin), dtype=float)
            points = pose.position + rotate(pose.quaternion, local)
            points = points + rng.normal(0.0, 1.0, points.shape) * model.marker_noise
            for k, point in enumerate(points):
                if not self._occluded(f"{name}/{k}"):
                    seen.append(point)
        if not seen:
            return np.empty((0, 3))
        # Cameras report markers in no order that means anything.
        cloud = np.array(seen)[rng.permutation(len(seen))]
        return _merged(cloud, model.merge_distance) if model.merge_distance > 0 else cloud


def _merged(cloud: Vector, distance: float) -> Vector:
    kept: list[Vector] = []
    used = np.zeros(len(cloud), dtype=bool)
    for i in range(len(cloud)):
        if used[i]:
            continue
        near = ~used & (np.linalg.norm(cloud - cloud[i], axis=1) < distance)
        used |= near
        kept.append(cloud[near].mean(axis=0))
    return np.array(kept)
