"""The table that recordings grow in."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from crazyarena.runner.timing.rows import Rows


@given(st.data(), st.integers(1, 7), st.lists(st.integers(0, 20), max_size=12))
def test_holds_what_was_put_in_in_whatever_portions(data, block, portions):
    rng = np.random.default_rng(0)
    rows = Rows(3, block)
    expected = np.empty((0, 3))
    for portion in portions:
        more = rng.random((portion, 3))
        if portion == 1:
            rows.next()[:] = more[0]
        else:
            rows.extend(more)
        expected = np.concatenate([expected, more])
    assert rows.count == len(expected)
    np.testing.assert_array_equal(rows.rows, expected)
    first, last = sorted(data.draw(st.lists(st.integers(0, rows.count), min_size=2, max_size=2)))
    np.testing.assert_array_equal(rows.between(first, last), expected[first:last])
    if rows.count:
        indices = data.draw(st.lists(st.integers(0, rows.count - 1), max_size=9))
        np.testing.assert_array_equal(rows.take(indices), expected[indices].reshape(-1, 3))


def test_a_row_stays_where_it_is():
    rows = Rows(2, 4)
    first = rows.next()
    for _ in range(100):
        rows.next()
    first[:] = 1.0, 2.0
    assert rows.rows[0].tolist() == [1.0, 2.0]
