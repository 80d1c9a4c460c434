"""Signed distances against dense sampling and known values; bad shapes are refused."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crazyarena.errors import InputError
from crazyarena.safety.shapes import Box, Cylinder, Polytope, Prism, Shape, Union

L_SHAPE = [(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)]
CUBE = [(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
SHAPES: dict[str, Shape] = {
    "box": Box((-1, -2, 0), (1, 2, 3)),
    "cylinder": Cylinder(0.5, -0.5, 1.0, 0.0, 2.0),
    "prism": Prism(L_SHAPE, 0.0, 1.5),
    "polytope": Polytope([(0, 0, 0), (2, 0, 0), (0, 2, 0), (0, 0, 2), (2, 2, 2)]),
    "union": Union([Box((-1, -1, 0), (1, 1, 1)), Cylinder(1.0, 0.0, 1.0, 0.0, 2.0)]),
}
coordinate = st.floats(-4.0, 4.0)
point = st.tuples(coordinate, coordinate, coordinate)


@pytest.mark.parametrize("name", SHAPES)
@settings(max_examples=150, deadline=None)
@given(a=point, b=point)
def test_distance_never_changes_faster_than_the_point_moves(name, a, b):
    shape = SHAPES[name]
    assert abs(shape.clearance(*a) - shape.clearance(*b)) <= math.dist(a, b) + 1e-9


@pytest.mark.parametrize("name", SHAPES)
@settings(max_examples=100, deadline=None)
@given(p=point)
def test_sign_changes_exactly_at_the_distance(name, p):
    """No point nearer than the distance lies on the other side."""
    shape = SHAPES[name]
    distance = shape.clearance(*p)
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(60, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    for d in directions * (0.999 * abs(distance)):
        near = shape.clearance(*(np.array(p) + d).tolist())
        assert near * distance >= -1e-12


@pytest.mark.parametrize("name", ["box", "cylinder", "prism", "polytope"])
def test_outside_distance_is_attained(name):
    """Some surface point is as near as claimed: the bound is the distance itself."""
    shape = SHAPES[name]
    rng = np.random.default_rng(1)
    (lx, ly, lz), (hx, hy, hz) = shape.bounds
    inside = [
        p
        for p in rng.uniform((lx, ly, lz), (hx, hy, hz), (6000, 3)).tolist()
        if shape.clearance(*p) >= 0.0
    ]
    cloud = np.array(inside)
    for p in rng.uniform(-4.0, 4.0, (60, 3)):
        distance = shape.clearance(*p.tolist())
        if distance < 0.0:
            nearest = float(np.linalg.norm(cloud - p, axis=1).min())
            assert -distance <= nearest + 1e-9
            assert nearest <= -distance + 0.35


def test_known_distances():
    box = SHAPES["box"]
    assert box.clearance(0.0, 0.0, 1.0) == 1.0
    assert box.clearance(1.5, 0.0, 1.0) == -0.5
    assert box.clearance(4.0, 6.0, 1.0) == -5.0
    prism = SHAPES["prism"]
    assert prism.clearance(0.5, 0.5, 0.75) == 0.5
    assert prism.clearance(1.5, 1.5, 0.75) == -0.5  # in the notch
    assert prism.clearance(0.5, 0.5, 2.5) == -1.0
    cube = Polytope(CUBE)
    assert cube.clearance(0.0, 0.0, 0.0) == pytest.approx(1.0)
    assert cube.clearance(2.0, 2.0, 0.0) == pytest.approx(-math.sqrt(2))
    assert cube.clearance(4.0, 5.0, 13.0) == pytest.approx(-math.hypot(3, 4, 12))
    assert len(cube.planes) == 6
    assert SHAPES["union"].clearance(1.8, 0.0, 0.5) == pytest.approx(0.2)


def test_winding_does_not_matter():
    other = Prism(L_SHAPE[::-1], 0.0, 1.5)
    for x, y in np.random.default_rng(2).uniform(-1, 3, (50, 2)).tolist():
        assert other.clearance(x, y, 0.7) == SHAPES["prism"].clearance(x, y, 0.7)


@pytest.mark.parametrize(
    "make",
    [
        lambda: Box((0, 0, 0), (1, 0, 1)),
        lambda: Box((0, 0, 0), (1, math.nan, 1)),
        lambda: Box((0, 0), (1, 1)),
        lambda: Cylinder(0, 0, 0, 0, 1),
        lambda: Cylinder(0, 0, 1, 1, 1),
        lambda: Prism([(0, 0), (1, 0)], 0, 1),
        lambda: Prism([(0, 0), (1, 0), (1, 1)], 1, 0),
        lambda: Prism([(0, 0), (1, 1), (1, 0), (0, 1)], 0, 1),
        lambda: Prism([(0, 0), (1, 0), (2, 0)], 0, 1),
        lambda: Prism([(0, 0), (0, 0), (1, 1)], 0, 1),
        lambda: Polytope([(0, 0, 0), (1, 0, 0), (0, 1, 0)]),
        lambda: Polytope([(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0)]),
        lambda: Union([]),
    ],
)
def test_bad_shapes_are_refused(make):
    with pytest.raises(InputError):
        make()
