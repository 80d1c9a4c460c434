"""Vehicles that come too close to each other."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyarena.safety.limits import Limits
from crazyarena.safety.neighbours import beside, in_the_way_down, nearest
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


def below(own, *others):
    return in_the_way_down(
        flying(position=own), [flying(position=one, airborne=one[2] > 0.1) for one in others]
    )


def test_who_is_below_is_in_the_way_down_flying_or_not():
    here = (0.0, 0.0, 1.0)
    assert below(here, (0.1, 0.0, 0.03)) == ((0.1, 0.0, 0.03),)
    assert below(here, (0.0, -0.2, 0.6), (2.0, 0.0, 0.03)) == ((0.0, -0.2, 0.6),)
    assert below(here, (0.1, 0.0, 1.5)) == ()
    assert below(here, (0.5, 0.0, 0.03)) == ()
    # Two at one height make way for each other.
    assert below(here, (0.2, 0.0, 1.0))
    assert in_the_way_down(flying(airborne=False), [flying()]) == ()
    assert in_the_way_down(flying(position=None, onboard=None), [flying()]) == ()


SPOTS = st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.floats(0.0, 1.0))


@given(SPOTS, st.lists(SPOTS, min_size=1, max_size=3))
def test_a_place_beside_them_is_free_and_at_this_height(place, others):
    found = beside(place, others, lambda there: there)
    assert found is not None
    assert found[2] == place[2]
    assert all(math.dist(found[:2], other[:2]) >= 0.4 for other in others)
    # Not further than it takes to get round them.
    assert min(math.dist(found[:2], other[:2]) for other in others) <= 0.56


def test_none_where_there_is_no_room():
    assert beside((0.0, 0.0, 1.0), [(0.1, 0.0, 0.0)], lambda there: (0.0, 0.0, 1.0)) is None
