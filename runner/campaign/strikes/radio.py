"""Faults of the radio."""

from __future__ import annotations

from crazyarena.runner.campaign.strikes import contestant
from crazyarena.runner.campaign.strikes.struck import Struck


def loss(f: Struck) -> None:
    """Lose a share of the packets."""
    f.link.loss = f.rng.uniform(0.2, 0.7)


def burst(f: Struck) -> None:
    """Come and go."""
    duration = f.rng.uniform(0.1, 0.9)
    pause = f.rng.uniform(0.3, 2.0)

    def come_and_go(since: float) -> None:
        f.link.cut = since % (duration + pause) < duration

    f.each = come_and_go


def cut(f: Struck) -> None:
    """Lose everything from now on."""
    f.link.cut = True


def cut_at_wall(f: Struck) -> None:
    """Lose the radio anywhere on the way to a wall, by whatever means the vehicle heads for it."""
    kind = f.rng.choice(
        (
            contestant.wall,
            contestant.wall,
            contestant.wall_velocity,
            contestant.position_step,
            contestant.go_to_wall,
            contestant.up,
        )
    )
    kind(f)
    after = f.rng.uniform(0.1, 1.6)

    def listen(since: float) -> None:
        f.link.cut = since >= after

    f.each = listen
