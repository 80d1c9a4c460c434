"""Ways out of the arena."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from crazyarena.runner.campaign.flight import Flight


def outwards(f: Flight) -> np.ndarray:
    """Some level direction, roughly along an axis of the arena; (3,), unit."""
    angle = f.rng.choice((0.0, 0.5, 1.0, 1.5)) * math.pi + f.rng.uniform(-0.3, 0.3)
    return np.array([math.cos(angle), math.sin(angle), 0.0])
