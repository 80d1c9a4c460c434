"""Ways out of the arena."""

from __future__ import annotations

import math

import numpy as np

from crazyarena.runner.campaign.strikes.struck import Struck


def outwards(f: Struck) -> np.ndarray:
    """Some level direction, roughly along an axis of the arena; (3,), unit."""
    angle = f.rng.choice((0.0, 0.5, 1.0, 1.5)) * math.pi + f.rng.uniform(-0.3, 0.3)
    return np.array([math.cos(angle), math.sin(angle), 0.0])
