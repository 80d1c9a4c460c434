"""Meshes and lines of a scene."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyarena.levels import load_level
from crazyarena.levels.draw import LevelRandom
from crazyarena.runner.records.shown_scene import level_scene
from crazyarena.runner.viewer.fleet import quadrotor, wxyz
from crazyarena.runner.viewer.solids import (
    ball,
    bodies,
    box,
    box_edges,
    cylinder,
    shape_edges,
)


def volume(mesh) -> float:
    """Of a closed mesh whose faces all look outwards, m³."""
    vertices, faces = mesh
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum()) / 6.0


def test_solids_are_closed_and_face_outwards():
    assert volume(box((1.0, 2.0, 3.0))) == pytest.approx(6.0)
    sides = 20
    share = sides / (2 * math.pi) * math.sin(2 * math.pi / sides)
    assert volume(cylinder(0.5, 2.0)) == pytest.approx(share * math.pi * 0.25 * 2.0)
    assert volume(ball((2.0, 2.0, 2.0))) == pytest.approx(4 / 3 * math.pi, rel=0.05)
    assert volume(quadrotor()) > 0


def test_a_gate_stands_where_the_scene_says():
    level = load_level("level0")
    draw = LevelRandom(level, 0).reset()
    scene = level_scene(level, draw.gates, draw.obstacles)
    meshes, lines = bodies([e for e in scene["track"] if e["id"] == "gate 0"])
    assert not lines
    assert len(meshes) == 1
    vertices = meshes[0].vertices
    x, y, z = level.track.gates[0].centre
    assert vertices[:, 2].max() == pytest.approx(z + 0.25, abs=0.01)
    assert vertices[:, 2].min() == pytest.approx(0.0, abs=0.01)
    np.testing.assert_allclose(vertices[:, :2].mean(axis=0), [x, y], atol=0.02)


def lengths(edges) -> np.ndarray:
    return np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1)


def test_edges_of_a_box():
    edges = box_edges([0, 0, 0], [1, 2, 3])
    assert sorted(lengths(edges).tolist()) == [1] * 4 + [2] * 4 + [3] * 4


def test_a_margin_lies_inside_by_as_much():
    prism = {"kind": "prism", "points": [[0, 0], [4, 0], [4, 3], [0, 3]], "bottom": 0, "top": 2}
    for points in (prism["points"], prism["points"][::-1]):
        edges = shape_edges({**prism, "points": points}, 0.5)
        np.testing.assert_allclose(edges.reshape(-1, 3).min(axis=0), [0.5, 0.5, 0.5])
        np.testing.assert_allclose(edges.reshape(-1, 3).max(axis=0), [3.5, 2.5, 1.5])
    tube = {"kind": "cylinder", "x": 1, "y": 2, "radius": 1.5, "bottom": 0, "top": 2}
    edges = shape_edges(tube, 0.5).reshape(-1, 3)
    np.testing.assert_allclose(np.linalg.norm(edges[:, :2] - [1, 2], axis=1), 1.0)


def test_a_hull_shows_its_edges_alone():
    cube = [[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]
    edges = shape_edges({"kind": "polytope", "vertices": cube})
    assert len(edges) == 12
    np.testing.assert_allclose(lengths(edges), 1.0)


junk = st.recursive(
    st.none() | st.floats() | st.text(max_size=3) | st.integers(),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.sampled_from(["x", "y", "z", "w", "pose", "size", "color"]), inner)
    ),
    max_leaves=8,
)


@given(st.lists(st.dictionaries(st.sampled_from(["cubes", "lines", "spheres", "id"]), junk)) | junk)
def test_what_is_no_body_is_left_out(entities):
    meshes, lines = bodies(entities)
    for mesh in meshes:
        assert np.isfinite(mesh.vertices).all()
    for line in lines:
        assert np.isfinite(line.segments).all()


def test_bodies_far_away_or_without_a_turn_are_left_out():
    zero = {"x": 0, "y": 0, "z": 0}
    good = {
        "pose": {"position": zero, "orientation": {**zero, "w": 1}},
        "size": {"x": 1, "y": 1, "z": 1},
    }
    good["color"] = {"r": 1, "g": 0, "b": 0, "a": 1}
    assert len(bodies([{"cubes": [good]}])[0]) == 1
    for change in (
        {"size": {"x": math.inf, "y": 1, "z": 1}},
        {"pose": {"position": {**zero, "x": 1e30}, "orientation": {**zero, "w": 1}}},
        {"pose": {"position": zero, "orientation": {**zero, "w": 0}}},
    ):
        assert bodies([{"cubes": [{**good, **change}]}]) == ([], [])


def test_attitudes_change_their_order_at_the_border():
    turned = wxyz(np.array([[0.1, 0.2, 0.3, 0.9], [np.nan] * 4, [0.0] * 4]))
    np.testing.assert_array_equal(turned, [[0.9, 0.1, 0.2, 0.3], [1, 0, 0, 0], [1, 0, 0, 0]])
