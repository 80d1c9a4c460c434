"""Where a track of lsy_drone_racing may stand: axis by axis, as its level says."""

from __future__ import annotations

import math

import pytest
from scipy.spatial.transform import Rotation

from crazyarena.levels.lsy import load_lsy_level
from crazyarena.mocap.survey import misplaced
from crazyarena.safety.lsy_placement import lsy_allowed, lsy_nominal, start_problem
from crazyarena.types import Pose


def judged(level, name, off=(0.0, 0.0, 0.0), turned=(0.0, 0.0, 0.0)):
    nominal = lsy_nominal(level)[name]
    angles = Rotation.from_quat(nominal.quaternion).as_euler("xyz") + turned
    pose = Pose(nominal.position + off, Rotation.from_euler("xyz", angles).as_quat())
    return misplaced(pose, nominal, lsy_allowed(level)[name], full_turn=True)


@pytest.mark.parametrize(
    ("off", "turned", "word"),
    [
        ((0.15, -0.15, 0.1), (0.05, -0.1, 0.2), None),
        ((0.17, 0.0, 0.0), (0.0, 0.0, 0.0), " x"),
        ((0.0, 0.0, -0.12), (0.0, 0.0, 0.0), " z"),
        ((0.0, 0.0, 0.0), (0.1, 0.0, 0.0), "rolled"),
        ((0.0, 0.0, 0.0), (0.0, -0.14, 0.0), "pitched"),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.3), "turned"),
        ((0.0, 0.0, 0.0), (0.0, 0.0, math.pi), "turned"),
    ],
)
def test_each_axis_of_a_gate_has_its_own_range(off, turned, word):
    for name in ("gate1", "gate3"):
        found = judged(load_lsy_level("lsy/level2"), name, off, turned)
        assert found is None if word is None else word in found


def test_what_is_not_drawn_is_placed_by_hand():
    level = load_lsy_level("lsy/level0")
    assert judged(level, "gate1", (0.04, 0.0, 0.0)) is None
    assert judged(level, "gate1", (0.08, 0.0, 0.0)) is not None
    assert judged(level, "obstacle2", (0.0, 0.0, 0.0), (0.0, 0.0, 2.0)) is None


def test_a_drawn_layout_may_stand_anywhere_inside_the_limits():
    level = load_lsy_level("lsy/level3")
    assert judged(level, "gate2", (2.0, -1.2, 0.0), (0.0, 0.0, 2.5)) is None
    assert "in y" in judged(level, "gate2", (2.0, -1.7, 0.0))
    assert "in z" in judged(level, "gate2", (2.0, 0.0, 0.3))


def test_the_start_has_ranges_of_its_own():
    level = load_lsy_level("lsy/level1")
    x, y, _ = level.env.track.drones[0].pos
    assert start_problem(level, x + 0.1, y - 0.1) is None
    assert "in x" in start_problem(level, x + 0.12, y)
    assert "in y" in start_problem(load_lsy_level("lsy/level0"), x, y + 0.06)
