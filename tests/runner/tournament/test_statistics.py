"""Intervals and comparisons."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyarena.runner.tournament.statistics import compare, median_interval, success_interval


def flights(times, clean=None):
    clean = clean or [True] * len(times)
    return {
        ("level0", k): {"flight_time": t, "clean": c}
        for k, (t, c) in enumerate(zip(times, clean, strict=True))
    }


def test_wilsons_interval_as_published():
    # 15 of 50 and 0 of 10, as in textbooks.
    assert success_interval(15, 50) == pytest.approx((0.1910, 0.4375), abs=1e-4)
    assert success_interval(0, 10) == pytest.approx((0.0, 0.2775), abs=1e-4)
    assert success_interval(0, 0) is None


@given(st.integers(0, 30), st.integers(1, 30))
def test_an_interval_holds_its_rate_and_mirrors(k, n):
    k = min(k, n)
    low, high = success_interval(k, n)
    assert 0.0 <= low <= k / n + 1e-12
    assert k / n - 1e-12 <= high <= 1.0
    other = success_interval(n - k, n)
    assert other == pytest.approx((1 - high, 1 - low), abs=1e-9)


@given(st.lists(st.floats(1.0, 30.0), min_size=2, max_size=20))
def test_a_median_lies_in_its_interval_which_repeats(times):
    low, high = median_interval(times)
    assert min(times) <= low <= np.median(times) <= high <= max(times)
    assert (low, high) == median_interval(times)
    assert median_interval([7.0]) is None


def test_the_same_flights_are_not_distinguishable():
    times = [7.0, 8.0, 9.0, 7.5, 8.5, 9.5, 7.2]
    result = compare(flights(times), flights(times))
    assert result.better is None
    assert "not distinguishable" in result.words


def test_two_of_a_kind_are_not_told_apart_by_chance():
    rng = np.random.default_rng(3)
    told = 0
    for _ in range(200):
        a, b = rng.normal(8.0, 0.5, (2, 12))
        told += compare(flights(list(a)), flights(list(b))).better is not None
    assert told <= 20  # 5 % of 200 and some


def test_pairs_find_what_spread_between_draws_would_hide():
    rng = np.random.default_rng(4)
    draws = rng.uniform(6.0, 14.0, 12)
    result = compare(flights(list(draws)), flights(list(draws + rng.uniform(0.05, 0.2, 12))))
    assert result.better == "first"
    assert result.difference < 0.0
    assert "faster by" in result.words


def test_successes_come_before_times():
    fast_but_crashing = flights([5.0] * 12, [True] * 3 + [False] * 9)
    slow = flights([9.0] * 12)
    result = compare(fast_but_crashing, slow)
    assert (result.better, result.only_second) == ("second", 9)
    assert "9 draws against 0" in result.words


def test_few_pairs_tell_nothing():
    assert compare(flights([1.0, 1.0]), flights([9.0, 9.0])).better is None
    assert compare({}, flights([1.0])).words == "no draws in common"


@given(
    st.lists(st.tuples(st.floats(5, 9), st.booleans(), st.floats(5, 9), st.booleans()), max_size=14)
)
def test_a_comparison_turned_round_says_the_same(rows):
    first = flights([r[0] for r in rows], [r[1] for r in rows]) if rows else {}
    second = flights([r[2] for r in rows], [r[3] for r in rows]) if rows else {}
    there, back = compare(first, second), compare(second, first)
    assert (there.better, back.better) in {(None, None), ("first", "second"), ("second", "first")}
    assert there.success_p == pytest.approx(back.success_p)
