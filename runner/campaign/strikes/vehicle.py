"""Faults of the vehicle, and the wind."""

from __future__ import annotations

import numpy as np

from crazyarena.runner.campaign.strikes.directions import outwards
from crazyarena.runner.campaign.strikes.struck import Struck
from crazyarena.sim_backend.physics.arena_plant import (
    AB_CHARGE,
    AP_CAPACITY,
    AP_RESISTANCE,
    AP_STRENGTH,
)


def battery(f: Struck) -> None:
    """The battery resists more, or is nearly empty."""
    if f.rng.random() < 0.5:
        f.fleet.plants[0, AP_RESISTANCE] *= f.rng.uniform(1.5, 2.5)
    else:
        drawn = f.rng.uniform(0.93, 0.99)
        f.fleet.bodies[0, AB_CHARGE] = drawn * f.fleet.plants[0, AP_CAPACITY]


def motor(f: Struck) -> None:
    """One motor loses thrust, or all of it."""
    f.fleet.plants[0, AP_STRENGTH + f.rng.randrange(4)] *= f.rng.choice((0.0, 0.3, 0.6))


def gust(f: Struck) -> None:
    """A wind blows for a while."""
    # Up to what a wind of some 10 m/s does to a vehicle of this size, a third of its weight.
    direction = outwards(f)
    force, duration = f.rng.uniform(0.03, 0.1), f.rng.uniform(0.2, 1.5)

    def blow(since: float) -> None:
        f.gust = force * direction if since < duration else np.zeros(3)

    f.each = blow
