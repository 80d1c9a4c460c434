"""Smooth made-up flights for the motion-capture tests."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from crazyarena.types import Pose


class Flights:
    """``count`` bodies on sums of sines, tilted into their acceleration as a quadrotor is.

    Call with a time, s, for true poses by name; :meth:`velocity` (n, 3) m/s and
    :meth:`rates` (n, 3) rad/s body frame give the rest of the truth.
    """

    def __init__(self, count: int, seed: int, spacing: float = 0.0) -> None:
        rng = np.random.default_rng(seed)
        self.names = [f"cf{i + 1}" for i in range(count)]
        self._amplitude = rng.uniform(0.2, 0.9, (count, 3, 2)) * [1.0, 0.25]
        self._frequency = rng.uniform(0.4, 1.8, (count, 3, 2)) * [1.0, 2.0]
        self._phase = rng.uniform(0, 2 * np.pi, (count, 3, 2))
        self._centre = np.zeros((count, 3))
        self._centre[:, 0] = spacing * np.arange(count)
        self._centre[:, 2] = 1.5

    def _sine(self, time: float, derivative: int) -> np.ndarray:
        angle = self._frequency * time + self._phase + derivative * np.pi / 2
        return (self._amplitude * self._frequency**derivative * np.sin(angle)).sum(axis=2)

    def position(self, time: float) -> np.ndarray:
        return self._centre + self._sine(time, 0)

    def velocity(self, time: float) -> np.ndarray:
        return self._sine(time, 1)

    def quaternion(self, time: float) -> np.ndarray:
        thrust = self._sine(time, 2) * [1.0, 1.0, 0.5] + [0.0, 0.0, 9.81]
        z = thrust / np.linalg.norm(thrust, axis=1, keepdims=True)
        q = np.stack([-z[:, 1], z[:, 0], np.zeros(len(z)), 1.0 + z[:, 2]], axis=1)
        return q / np.linalg.norm(q, axis=1, keepdims=True)

    def rates(self, time: float, step: float = 1e-4) -> np.ndarray:
        from scipy.spatial.transform import Rotation

        before = Rotation.from_quat(self.quaternion(time - step))
        after = Rotation.from_quat(self.quaternion(time + step))
        return (before.inv() * after).as_rotvec() / (2 * step)

    def __call__(self, time: float) -> Mapping[str, Pose]:
        positions, quaternions = self.position(time), self.quaternion(time)
        return {n: Pose(p, q) for n, p, q in zip(self.names, positions, quaternions, strict=True)}


def standing(poses: Mapping[str, Pose]) -> Callable[[float], Mapping[str, Pose]]:
    """Truth of bodies that do not move."""
    return lambda time: poses
