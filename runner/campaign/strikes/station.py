"""Faults of the ground station."""

from __future__ import annotations

from crazyarena.runner.campaign.strikes.struck import Struck


def late(f: Struck) -> None:
    """The control loop stalls time and again."""
    stall = f.rng.uniform(0.05, 1.0)
    gap = f.rng.uniform(0.2, 1.0)
    due = 0.0

    def stumble(since: float) -> None:
        nonlocal due
        if since >= due:
            f.stall = stall
            due = since + stall + gap

    f.each = stumble


def killed(f: Struck) -> None:
    """The ground station does nothing more."""
    f.ground_station_alive = False
