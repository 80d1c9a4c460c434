"""The fence of a level: shapes, zones, the floor, and the nearest allowed place."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crazyarena.errors import InputError
from crazyarena.levels import dump_level, load_level
from crazyarena.safety.fence import Fence, Zone, track_zones
from crazyarena.safety.shapes import Box, Prism
from tests.safety.scenes import BOX, fence

HALL = """\
arena:
  low: [-3, -3, -0.1]
  high: [3, 3, 2.5]
  soft_margin: 0.1
  shapes:
    - {kind: prism, points: [[-3, -3], [3, -3], [3, 0], [0, 3], [-3, 3]], bottom: -0.1, top: 2.2}
    - {kind: box, low: [0, -3, -0.1], high: [3, 3, 1.0]}
    - {kind: polytope, vertices: [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]}
  keep_out:
    - name: desk
      shape: {kind: cylinder, x: -2, y: -2, radius: 0.4, bottom: 0, top: 1}
      margin: 0.2
    - {name: door, people: true, shape: {kind: box, low: [-3, 2, -0.1], high: [-2, 3, 2]}}
  track_margin: 0.08
start: {position: [0, 0, 0.03]}
goal: {position: [1, 0, 1]}
track:
  gates: [{x: 1, y: 1, type: tall}]
  obstacles: [{x: -1, y: 0}]
"""


def level_of(folder: Path, text: str):
    path = folder / "hall.yaml"
    path.write_text(text)
    return load_level(path)


def test_level_with_every_shape(tmp_path):
    level = level_of(tmp_path, HALL)
    hall = Fence.from_level(level)
    assert hall.clearance(-1.0, 0.0, 1.0) > 0.5
    assert hall.clearance(2.5, 2.5, 0.5) > 0.0  # in the low part
    assert hall.clearance(2.5, 2.5, 1.5) < 0.0  # cut off above it
    assert {zone.name for zone in hall.zones} >= {"desk", "door", "gate 0 left", "obstacle 0"}
    assert [zone.name for zone in hall.people_zones] == ["door"]
    (tmp_path / "again").mkdir()
    assert level_of(tmp_path / "again", dump_level(level)).arena == level.arena


@pytest.mark.parametrize(
    ("old", "new", "names"),
    [
        ("kind: cylinder", "kind: sphere", "kind"),
        ("radius: 0.4, ", "", "radius"),
        ("kind: cylinder, x", "kind: cylinder, low: [0, 0, 0], x", "low"),
        ("bottom: 0, top: 1}", "bottom: 1, top: 0}", "top"),
        ("track_margin: 0.08", "track_margin: -1", "track_margin"),
        ("[0, 0, 0.03]", "[2.9, 2.9, 1.5]", "start.position"),
        ("[1, 0, 1]", "[-2, -2, 0.5]", "desk"),
        (
            "[[-3, -3], [3, -3], [3, 0], [0, 3], [-3, 3]]",
            "[[0, 0], [1, 1], [1, 0], [0, 1]]",
            "cross",
        ),
        ("[0, 0, 1]]}", "[1, 1, 0]]}", "volume"),
    ],
)
def test_contradictions_are_refused_by_name(tmp_path, old, new, names):
    assert old in HALL
    with pytest.raises(InputError, match=names):
        Fence.from_level(level_of(tmp_path, HALL.replace(old, new)))


def test_fences_that_leave_no_room_are_refused():
    with pytest.raises(InputError, match="soft_margin"):
        Fence(BOX, soft_margin=1.2)
    with pytest.raises(InputError, match="shapes"):
        Fence(BOX, [Box((4, 4, 0), (5, 5, 1))])


@pytest.mark.parametrize("name", ["level0", "level1", "level2", "level3", "sim2real"])
def test_shipped_levels_have_a_fence(name):
    shipped = Fence.from_level(load_level(name))
    assert shipped.bounds == BOX
    assert not shipped.zones


def test_standing_on_the_floor_is_inside():
    room = fence(zones=())
    assert room.clearance(0.0, 0.0, 0.03) > 0.0
    assert room.clearance(0.0, 0.0, -0.1) > 0.0
    assert room.clearance(0.0, 0.0, -0.2) < 0.0  # below it is a wrong measurement


@settings(max_examples=200, deadline=None)
@given(st.tuples(st.floats(-6, 6), st.floats(-6, 6), st.floats(-1, 5)), st.floats(0.0, 0.3))
def test_nearest_place_has_the_room_and_is_near(p, margin):
    room = fence()
    place = room.nearest(p, margin, (0.0, 0.0, 1.0))
    assert room.room(*place) >= margin
    if room.room(*p) >= margin:
        assert place == p


def test_nearest_in_a_box_is_a_clamp():
    room = fence(zones=())
    assert room.nearest((5.0, 0.5, 1.0), 0.2) == pytest.approx((2.8, 0.5, 1.0), abs=0.02)
    assert room.nearest((5.0, -7.0, 9.0), 0.2) == pytest.approx((2.8, -2.8, 1.8), abs=0.05)


def test_nearest_without_a_way_says_so():
    zones = (Zone("all of it", Box((-9, -9, -9), (9, 9, 9)), 0.1),)
    with pytest.raises(InputError, match="no place"):
        fence(zones=zones).nearest((0.0, 0.0, 1.0), 0.2)


def test_track_zones_leave_the_openings_free():
    level = load_level("level0")
    zones = track_zones(level, 0.08)
    for gate in level.track.gates:
        x, y, z = gate.centre
        lateral = np.array([math.cos(gate.yaw), math.sin(gate.yaw)])
        assert min(zone.distance(x, y, z) for zone in zones) == pytest.approx(0.12, abs=1e-9)
        bx, by = np.array([x, y]) + 0.225 * lateral
        assert min(zone.distance(bx, by, z) for zone in zones) < -0.08
    pole = level.track.obstacles[0]
    assert min(zone.distance(pole.x, pole.y, 0.9) for zone in zones) < 0.0
    assert min(zone.distance(pole.x, pole.y, 1.1) for zone in zones) > 0.0


def test_concave_room_needs_its_notch_respected():
    room = Fence(BOX, [Prism([(-3, -3), (3, -3), (3, 0), (0, 0), (0, 3), (-3, 3)], -0.1, 2.0)])
    assert room.clearance(1.0, 1.0, 1.0) == pytest.approx(-1.0)
    x, y, z = room.nearest((0.5, 1.5, 1.0), 0.2)
    assert room.clearance(x, y, z) >= 0.2
    assert math.dist((x, y), (0.5, 1.5)) < 0.8
