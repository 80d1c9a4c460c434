from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crazyarena.errors import InputError
from crazyarena.sim_backend.physics import scene as s
from tests.sim_backend.physics.bullet_world import LEVEL_GATES, LEVEL_OBSTACLES

angle = st.floats(-3.2, 3.2)
place = st.floats(-3.0, 3.0)


def test_rows_and_codes_follow_the_contact_order():
    scene = s.build_scene(LEVEL_GATES, LEVEL_OBSTACLES)
    headers = scene[scene[:, s.S_KIND] == s.GROUP]
    assert headers[:, s.S_CODE].tolist() == list(range(8))
    assert s.ground_code(scene) == 8
    for gate in range(4):
        rows = scene[s.gate_rows(gate)]
        assert rows[0, s.S_KIND] == s.GROUP
        assert (rows[:, s.S_CODE] == gate).all()


@pytest.mark.parametrize(("kind", "centre"), [(0, 1.0), (1, 0.525)])
def test_gate_height_comes_from_the_type(kind, centre):
    scene = s.build_scene([[1.0, 2.0, 77.0, 0, 0, 0.3, kind]], [])
    beams = scene[1:5, s.S_CENTRE : s.S_CENTRE + 3]
    np.testing.assert_allclose(beams.mean(axis=0), [1.0, 2.0, centre], atol=1e-12)
    # Clear opening: the nominal inner faces of opposite beams are 0.4 m apart.
    top, bottom = scene[1], scene[2]
    inner = (top[s.S_CENTRE + 2] - bottom[s.S_CENTRE + 2]) - (
        top[s.S_HALF + 2] + bottom[s.S_HALF + 2] + 2 * s.MARGIN
    )
    assert inner == pytest.approx(0.4)


@given(
    gate=st.tuples(place, place, st.just(0.0), angle, angle, angle, st.sampled_from([0, 1])),
    obstacle=st.tuples(place, place, st.just(0.0), angle, angle, angle),
)
@settings(max_examples=60, deadline=None)
def test_bounding_spheres_hold_every_corner(gate, obstacle):
    scene = s.build_scene([gate], [obstacle])
    header = None
    for row in scene:
        if row[s.S_KIND] == s.GROUP:
            header = row
            continue
        rotation = row[s.S_ROTATION : s.S_ROTATION + 9].reshape(3, 3)
        grown = row[s.S_HALF : s.S_HALF + 3] + s.MARGIN
        if row[s.S_KIND] == s.CYLINDER:
            turn = np.linspace(0, 2 * np.pi, 24)[:, None]
            rim = np.c_[grown[0] * np.cos(turn), grown[0] * np.sin(turn), 0 * turn + grown[2]]
            corners = np.r_[rim, rim * [1, 1, -1]]
        else:
            corners = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T * grown
        world = row[s.S_CENTRE : s.S_CENTRE + 3] + corners @ rotation.T
        for sphere in (row, header):
            reach = np.linalg.norm(world - sphere[s.S_CENTRE : s.S_CENTRE + 3], axis=1)
            assert reach.max() <= sphere[s.S_RADIUS] + 0.0008  # corners are rounded by the margin


@pytest.mark.parametrize(
    ("gates", "obstacles", "words"),
    [
        ([[0, 0, 0, 0, 0, 0, 2]], [], "gates[0][6]"),
        ([[0, 0, 0, 0, 0, 0]], [], "gates"),
        ([], [[0, 0, 0, 0, 0, float("nan")]], "obstacles"),
        ([], [["a", 0, 0, 0, 0, 0]], "obstacles"),
    ],
)
def test_bad_rows_are_refused_by_name(gates, obstacles, words):
    with pytest.raises(InputError, match=words.replace("[", r"\[").replace("]", r"\]")):
        s.build_scene(gates, obstacles)
