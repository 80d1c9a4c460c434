"""What is wrong with the cameras' axes is named."""

from __future__ import annotations

import numpy as np
import pytest

from crazyarena.safety.axes import explain_axes

TRACK = np.array([[0.5, -2.5, 0.0], [2.0, -1.5, 0.0], [0.0, 0.2, 0.0], [-0.5, 1.5, 0.0]])


@pytest.mark.parametrize(
    ("seen", "said"),
    [
        (TRACK * [1, -1, 1], "mirrored: the arena's x, y, z are their x, -y, z"),
        (TRACK * [-1, 1, 1], "mirrored: the arena's x, y, z are their -x, y, z"),
        (TRACK[:, [1, 0, 2]], "mirrored: the arena's x, y, z are their y, x, z"),
        (TRACK[:, [0, 2, 1]], "their x, z, y"),
        (TRACK[:, [1, 0, 2]] * [1, -1, 1], "turned: the arena's x, y, z are their -y, x, z"),
        (TRACK * [-1, -1, 1], "turned: the arena's x, y, z are their -x, -y, z"),
    ],
)
def test_exchanged_and_mirrored_axes(seen, said):
    noise = np.random.default_rng(1).normal(0.0, 0.01, TRACK.shape)
    assert said in explain_axes(seen + noise, TRACK, 0.1)


def test_right_axes_and_what_axes_do_not_explain():
    assert explain_axes(TRACK + 0.02, TRACK, 0.1) is None
    moved = TRACK.copy()
    moved[1] += [0.6, 0.3, 0.0]
    assert explain_axes(moved, TRACK, 0.1) is None
    assert explain_axes([[0.1, 0.0, 0.0]], [[0.0, 0.1, 0.0]], 0.05) is None
    assert explain_axes(np.empty((0, 3)), np.empty((0, 3)), 0.1) is None
