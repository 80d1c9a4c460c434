"""Growing paths: every point is shown once, in order, and little is sent again."""

from __future__ import annotations

import numpy as np
import pytest

from crazyarena.runner.viewer.trails import Trails


class Scene:
    def __init__(self):
        self.nodes, self.sent = {}, 0

    def add_line_segments(self, name, segments, colours, **look):
        assert segments.shape == colours.shape
        self.nodes[name] = segments
        self.sent += len(segments)
        scene = self

        class Handle:
            def remove(self):
                del scene.nodes[name]

        return Handle()


@pytest.mark.parametrize("count", [1, 50])
def test_a_growing_path_is_shown_whole_and_not_sent_again_and_again(count):
    scene = Scene()
    trails = Trails(scene)
    shades = np.zeros((count, 3), np.uint8)
    way = np.cumsum(np.ones((count, 1000, 3)), axis=1)
    for end in range(7, 1001, 7):
        first = max(0, end - 300)  # as much as the flight still has
        trails.show(way[:, first:end], end, shades)
    total = count * 993
    shown = np.concatenate(list(scene.nodes.values()))
    assert len(shown) == total
    lengths = np.linalg.norm(shown[:, 1] - shown[:, 0], axis=1)
    np.testing.assert_allclose(lengths, np.sqrt(3.0))
    assert len(np.unique(shown[:, 0, 0])) == 993
    assert scene.sent < 25 * total
    trails.clear()
    assert scene.nodes == {}


def test_a_very_long_path_loses_its_beginning():
    scene = Scene()
    trails = Trails(scene)
    way = np.cumsum(np.ones((100, 8000, 3)), axis=1)
    for end in range(20, 8001, 20):
        trails.show(way[:, max(0, end - 600) : end], end, np.zeros((100, 3), np.uint8))
    assert sum(map(len, scene.nodes.values())) < 160_000


def test_gaps_are_not_bridged():
    scene = Scene()
    way = np.cumsum(np.ones((1, 10, 3)), axis=1)
    way[0, 5] = np.nan
    Trails(scene).show(way, 10, np.zeros((1, 3), np.uint8))
    assert sum(map(len, scene.nodes.values())) == 7
