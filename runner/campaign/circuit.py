"""What the contestant of a campaign flight flies until the fault sets in."""

from __future__ import annotations

import math
import random

import numpy as np

from crazyarena.crazyswarm_compat import commands as c
from crazyarena.runner.campaign.setting import CLIMB, MISSION


class Circuit:
    """A contestant's flight: off the ground, on a closed curve at up to ``speed`` m/s."""

    def __init__(
        self, start: np.ndarray, rng: random.Random, speed: float, climb: float = CLIMB
    ) -> None:
        self._start = start
        self._climb = climb
        self._height = rng.uniform(0.7, 1.3)
        self._size = np.array([rng.uniform(1.0, 2.0), rng.uniform(1.0, 2.0), 0.25])
        self._phase = np.array([rng.choice((0.0, math.pi)) for _ in range(3)])
        ratio = np.array([1.0, rng.choice((0.5, 1.0, 2.0)), rng.choice((1.0, 2.0))])
        self._rate = ratio * speed / float(np.linalg.norm(self._size * ratio))
        times = np.arange(0.0, MISSION, 0.05)
        fastest = max(float(np.linalg.norm(self._derivative(t, 1)[:2])) for t in times)
        self._size *= min(1.0, speed / fastest)

    def at(self, t: float) -> c.FullState:
        """Setpoint ``t`` s after the take-off."""
        place, velocity, acceleration = (self._derivative(t, order) for order in range(3))
        return c.FullState(place, velocity, acceleration, 0.0, np.zeros(3))

    def _place(self, t: float) -> np.ndarray:
        climb = _smooth(t / self._climb)
        grown = _smooth((t - 0.6 * self._climb) / 1.5)
        place = self._start + grown * self._size * np.sin(self._rate * t + self._phase)
        place[2] += climb * (self._height - self._start[2])
        return place

    def _derivative(self, t: float, order: int) -> np.ndarray:
        h = 1e-3
        if order == 0:
            return self._place(t)
        if order == 1:
            return (self._place(t + h) - self._place(t - h)) / (2.0 * h)
        return (self._place(t + h) - 2.0 * self._place(t) + self._place(t - h)) / h**2


def _smooth(x: float) -> float:
    x = min(max(x, 0.0), 1.0)
    return x**3 * (10.0 - x * (15.0 - 6.0 * x))
