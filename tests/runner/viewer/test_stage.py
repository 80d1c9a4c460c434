"""Scenes in a viewer: everything is drawn, and again only if it has changed."""

from __future__ import annotations

import numpy as np
import pytest

from crazyarena.levels import load_level
from crazyarena.levels.draw import LevelRandom
from crazyarena.runner.records.shown_scene import level_scene
from crazyarena.runner.viewer.recorded import Flight
from crazyarena.runner.viewer.stage import Stage


class Scene:
    """Remembers what is drawn, and how often anything was."""

    def __init__(self):
        self.nodes, self.calls = {}, 0

    def set_up_direction(self, direction):
        pass

    def _add(self, name, *shape, **look):
        self.calls += 1
        self.nodes[name] = shape
        scene = self

        class Handle:
            def remove(self):
                scene.nodes.pop(name)

        return Handle()

    add_grid = add_mesh_simple = add_line_segments = _add


@pytest.fixture
def fields():
    level = load_level("level1")
    draw = LevelRandom(level, 3).reset()
    scene = level_scene(level, draw.gates, draw.obstacles)
    zone = {"kind": "box", "low": [1, 1, 0], "high": [2, 2, 1]}
    arena = {**scene["arena"], "keep_out": [{"name": "desk", "shape": zone}]}
    return {**scene, "arena": arena}


def test_a_scene_has_floor_fence_margin_zones_and_track(fields):
    scene = Scene()
    Stage(scene).show(fields)
    parts = {name.split("/")[1] for name in scene.nodes}
    assert parts == {"floor", "fence", "track", "nominal"}
    assert {"/fence/hard", "/fence/soft margin", "/fence/keep out"} <= set(scene.nodes)
    hard, soft = (scene.nodes[f"/fence/{kind}"][0] for kind in ("hard", "soft margin"))
    margin = fields["arena"]["soft_margin"]
    np.testing.assert_allclose(soft.max(axis=(0, 1)), hard.max(axis=(0, 1)) - margin)


def test_only_what_has_changed_is_drawn_again(fields):
    scene = Scene()
    stage = Stage(scene)
    stage.show(fields)
    first = scene.calls
    stage.show(fields)
    assert scene.calls == first
    line = {
        "type": 0,
        "points": [{"x": 0, "y": 0, "z": 0}, {"x": 1, "y": 0, "z": 1}],
        "color": {"r": 1, "g": 0, "b": 0, "a": 1},
    }
    stage.show({**fields, "drawn": [{"id": "drawings", "lines": [line]}]})
    assert scene.calls == first + 1
    assert any(name.startswith("/drawn") for name in scene.nodes)
    stage.show(fields)
    assert not any(name.startswith("/drawn") for name in scene.nodes)


@pytest.mark.parametrize(
    "arena",
    [
        None,
        "x",
        {},
        {"low": [0, 0, 0]},
        {"low": [1, 1, 1], "high": [0, 0, 0]},
        {"low": [0, 0, 0], "high": [1, 1, 1], "shapes": [{"kind": "prism"}]},
        {"low": ["a", 0, 0], "high": [1, 1, 1]},
    ],
)
def test_a_scene_from_elsewhere_is_shown_as_far_as_it_is_one(arena):
    scene = Scene()
    Stage(scene).show({"arena": arena, "track": [1, {"cubes": 5}], "nominal": {}})
    assert "/floor" in scene.nodes


def test_a_replay_shows_what_a_controller_has_drawn_at_the_time():
    from crazyarena.runner.viewer.replay import Replay

    def drawing(name, x):
        points = [{"x": x, "y": 0, "z": 0}, {"x": x, "y": 0, "z": 1}]
        colour = {"r": 1, "g": 0, "b": 0, "a": 1}
        return [{"id": name, "lines": [{"points": points, "color": colour}]}]

    nowhere = np.zeros((2, 3))
    flight = Flight(
        "a", None, True, np.array([0.0, 3.0]), nowhere, np.zeros((2, 4)), nowhere, nowhere,
        {"track": drawing("gate 0", 5.0)},
        [(1.0, drawing("drawings", 1.0)), (2.0, drawing("drawings", 2.0))],
    )  # fmt: skip
    replay = Replay.__new__(Replay)
    replay._flights, replay._update, replay._entities = [flight], -1, {}
    scene = Scene()
    replay._stage = Stage(scene)
    replay._stage.show(flight.scene)
    for time, x in ((0.5, None), (1.5, 1.0), (2.5, 2.0), (1.2, 1.0), (0.1, None)):
        replay.time = time
        replay._show_update()
        drawn = [shape[0] for name, shape in scene.nodes.items() if name.startswith("/drawn")]
        assert [float(segments[0, 0, 0]) for segments in drawn] == ([] if x is None else [x]), time
        assert sum(name.startswith("/track") for name in scene.nodes) == 1


@pytest.mark.parametrize(
    ("width", "height"), [(1000, 537), (1920, 1080), (390, 780), (360, 500), (600, 900), (0, 0)]
)
def test_the_whole_room_is_seen_where_no_panel_lies(width, height):
    from crazyarena.runner.viewer.server import framed

    low, high, fov = np.array([-3.0, -3.0, 0.0]), np.array([3.0, 3.0, 2.0]), 1.3
    place, target = framed(low, high, width, height, fov)
    back = (place - target) / np.linalg.norm(place - target)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    turn = np.stack([right, np.cross(back, right), back])
    corners = np.array([(x, y, z) for x in (-3, 3) for y in (-3, 3) for z in (0, 2)], float)
    x, y, z = turn @ (corners - place).T
    assert (z < 0.0).all()
    if width:
        pixels = 0.5 * height / np.tan(0.5 * fov) / -z
        across, down = 0.5 * width + x * pixels, 0.5 * height - y * pixels
        phone = width < 576
        assert across.min() > -0.02 * width
        assert across.max() < (1.02 * width if phone else max(width - 395, 0.42 * width))
        assert down.min() > -0.02 * height
        assert down.max() < (0.45 if phone else 1.02) * height
