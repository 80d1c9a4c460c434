"""Vehicles that come too close to each other."""

from __future__ import annotations

import pytest

from crazyarena.safety.limits import Limits
from crazyarena.safety.neighbours import nearest
from tests.safety.scenes import flying

N = Limits()


def between(first, second, **changes):
    return nearest(flying(**first), [flying(**second, **changes)], N)


def test_two_that_hover():
    found = between({"position": (0.0, 0.0, 1.0)}, {"position": (0.3, 0.0, 1.4)})
    assert found == pytest.approx((0.5, 0.5))


def test_two_that_fly_at_each_other_will_be_closer():
    now, then = between(
        {"position": (-0.6, 0.0, 1.0), "velocity": (1.5, 0.0, 0.0)},
        {"position": (0.6, 0.0, 1.0), "velocity": (-1.5, 0.0, 0.0)},
    )
    assert now == pytest.approx(1.2)
    # Each goes on for the reaction, and brakes.
    assert then == pytest.approx(1.2 - 2.0 * (1.5 * 0.15 + 1.5**2 / (2.0 * N.braking)))


def test_two_that_fly_side_by_side_stay_as_they_are():
    along = {"velocity": (2.0, 0.0, 0.0)}
    found = between({"position": (0.0, 0.0, 1.0), **along}, {"position": (0.0, 0.5, 1.0), **along})
    assert found == pytest.approx((0.5, 0.5))


def test_of_several_the_nearest_counts():
    others = [flying(position=(x, 0.0, 1.0)) for x in (2.0, 0.4, -1.0)]
    assert nearest(flying(position=(0.0, 0.0, 1.0)), others, N) == pytest.approx((0.4, 0.4))


def test_who_stands_or_is_not_seen_does_not_count():
    close = {"position": (0.1, 0.0, 1.0)}
    assert between({}, close, airborne=False) is None
    assert nearest(flying(airborne=False), [flying(**close)], N) is None
    assert nearest(flying(position=None, onboard=None), [flying(**close)], N) is None
    assert nearest(flying(), [], N) is None
