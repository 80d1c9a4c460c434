"""A level of lsy_drone_racing as an arena is put together from it."""

from __future__ import annotations

import numpy as np
import pytest

from crazyarena.errors import InputError
from crazyarena.levels import dump_level
from crazyarena.levels.draw import Draw
from crazyarena.levels.load import load_level
from crazyarena.levels.lsy import load_lsy_level
from crazyarena.levels.lsy.arena import (
    MODELS,
    ArenaDraws,
    arena_level,
    quaternions_of,
    rows_of,
)
from crazyarena.levels.lsy.draw import LsyRandom, Nominal
from crazyarena.levels.lsy.schema import MODELS as THEIRS
from crazyarena.levels.schema import Profile

MASS, INERTIA = 0.0434, (2.5e-5, 2.8e-5, 4.9e-5)


def test_the_arena_has_the_safety_limits_and_rates_of_the_level(tmp_path):
    lsy = load_lsy_level("lsy/level2")
    level = arena_level(lsy, 5)
    assert level.profile is Profile.ARENA
    assert level.arena.low[:2] == (-2.5, -1.5)
    assert level.arena.high == (2.5, 1.5, 2.0)
    assert (level.control_frequency, level.episode_length, level.seed) == (50, 30.0, 5)
    assert level.vehicle.model == "cf21b"
    centres = [gate.centre for gate in level.track.gates]
    np.testing.assert_allclose(centres, [gate.pos for gate in lsy.env.track.gates])
    # It goes to other processes as text.
    (tmp_path / "level.yaml").write_text(dump_level(level))
    assert load_level(tmp_path / "level.yaml") == level


def test_every_vehicle_of_theirs_has_a_model():
    assert set(MODELS) == set(THEIRS)


def test_draws_are_those_of_the_simulation():
    lsy = load_lsy_level("lsy/level2")
    draws = ArenaDraws(lsy, MASS, INERTIA, 7)
    theirs = LsyRandom(lsy, Nominal(MASS, np.diag(INERTIA)), 7)
    for _ in range(2):
        ours, drawn = draws.reset(), theirs.reset()
        assert isinstance(ours, Draw)
        assert ours.mass == drawn.mass
        np.testing.assert_allclose(ours.inertia, np.diag(drawn.inertia))
        np.testing.assert_allclose(ours.start[0:6:2], drawn.start[:3])
        np.testing.assert_allclose(ours.obstacles[:, :3], drawn.obstacles)
        np.testing.assert_allclose(quaternions_of(ours.gates)[:, :3], drawn.gates[:, :3])
        turned = np.abs((quaternions_of(ours.gates)[:, 3:] * drawn.gates[:, 3:]).sum(axis=1))
        np.testing.assert_allclose(turned, 1.0)
        np.testing.assert_allclose(rows_of(drawn.nominal_gates), ours.nominal_gates)
        assert not ours.disturbed


@pytest.mark.parametrize(
    ("override", "word"),
    [
        ("env.track.safety_limits.pos_limit_high=[2.5,1.5,1.0]", "safety_limits"),
        ("env.freq=250", "100 Hz"),
    ],
)
def test_what_no_arena_takes_is_told(override, word):
    with pytest.raises(InputError, match=word):
        arena_level(load_lsy_level("lsy/level0", [override]), 0)
