"""Draws of lsy_drone_racing's levels: Threefry, jax's numbers, distributions, order."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from crazyarena.errors import InputError
from crazyarena.levels.lsy import load_lsy_level
from crazyarena.levels.lsy._threefry import threefry
from crazyarena.levels.lsy.draw import LsyRandom, Nominal
from crazyarena.levels.lsy.random_source import Keys, between, choice

JAX = json.loads((Path(__file__).parent / "jax_numbers.json").read_text())
NOMINAL = Nominal(0.04338, np.diag([25e-6, 28e-6, 49e-6]))


def random(level, *overrides, seed=7):
    return LsyRandom(load_lsy_level(level, overrides), NOMINAL, seed)


@pytest.mark.parametrize(
    ("key", "counter", "result"),
    [  # the known answers that come with Random123
        ((0, 0), (0, 0), (0x6B200159, 0x99BA4EFE)),
        ((0xFFFFFFFF,) * 2, (0xFFFFFFFF,) * 2, (0x1CB996FC, 0xBB002BE7)),
        ((0x13198A2E, 0x03707344), (0x243F6A88, 0x85A308D3), (0xC4923A9C, 0x483DF7A0)),
    ],
)
def test_threefry_gives_the_published_words(key, counter, result):
    assert threefry(*key, *counter) == result


def test_jax_splits_bits_uniforms_normals_and_choices():
    """Recorded from jax 0.10.2 with its defaults."""
    keys = Keys()
    key = keys.root(42)
    assert [list(map(int, k)) for k in keys.split(key, 5)] == JAX["split5"]
    low, high = [-0.15, -0.15, -0.1], [0.15, 0.15, 0.1]
    uniform = between(keys, keys.unit(key, (1, 4, 3)), low, high)
    np.testing.assert_allclose(uniform.ravel(), JAX["uniform"], atol=1.5e-8)
    np.testing.assert_allclose(keys.normal(key, (13,)), JAX["normal"], atol=5e-7)
    assert float(between(keys, keys.unit(key, ()), -0.75, 0.75)) == JAX["scalar"][0]
    weights = np.ones(1600)
    weights[:300] = 0.0
    assert [choice(keys, k, weights) for k in keys.split(key, 6)] == JAX["choice"]


def test_threefry_level_splits_its_keys_as_documented():
    """The drone's arrays and the track's, drawn here key by key once more."""
    draw = random("lsy/level2", "rng=threefry", seed=42).reset()
    keys = Keys()
    key, track = keys.split(keys.root(42), 2)
    key, own = keys.split(key, 2)
    inertia = between(keys, keys.unit(own, (1, 1, 3, 3)), -1e-6, 1e-6)[0, 0]
    np.testing.assert_allclose(draw.inertia, NOMINAL.inertia + inertia, atol=1e-13)
    key, own = keys.split(key, 2)
    mass = between(keys, keys.unit(own, (1, 1, 1)), -0.005, 0.005)
    assert draw.mass == pytest.approx(NOMINAL.mass + mass.item(), abs=1e-12)
    first, _, third = keys.split(track, 3)
    place = between(keys, keys.unit(first, (1, 4, 3)), [-0.15, -0.15, -0.1], [0.15, 0.15, 0.1])
    np.testing.assert_allclose(draw.gates[:, :3] - draw.nominal_gates[:, :3], place[0], atol=1e-12)
    tops = between(keys, keys.unit(third, (1, 4, 3)), [-0.15, -0.15, -0.05], [0.15, 0.15, 0.05])
    np.testing.assert_allclose(draw.obstacles - draw.nominal_obstacles, tops[0], atol=1e-12)


@pytest.mark.parametrize("rng", ["pcg64", "threefry"])
def test_offsets_fill_their_ranges_evenly(rng):
    source = random("lsy/level2", f"rng={rng}")
    draws = [source.reset() for _ in range(300)]
    gates = np.array([d.gates[:, :3] - d.nominal_gates[:, :3] for d in draws]).reshape(-1, 3)
    for axis, half in enumerate((0.15, 0.15, 0.1)):
        share = (gates[:, axis] + half) / (2 * half)
        assert share.min() > -1e-6
        assert share.max() < 1 + 1e-6
        counts, _ = np.histogram(share, bins=10, range=(0, 1))
        # Chi-square of 10 bins, 9 degrees of freedom: above 33.7 once in ten thousand.
        assert ((counts - 120.0) ** 2 / 120.0).sum() < 33.7
    tilt = [
        (Rotation.from_quat(d.nominal_gates[0, 3:]).inv() * Rotation.from_quat(d.gates[0, 3:]))
        for d in draws
    ]
    assert max(t.magnitude() for t in tilt) > 0.1
    masses = np.array([d.mass for d in draws]) - NOMINAL.mass
    assert abs(masses).max() <= 0.005
    assert abs(masses.mean()) < 0.001


def test_step_noise_has_its_distributions():
    draw = random("lsy/level0").reset()
    action, force = zip(*(draw.step_noise() for _ in range(400)), strict=True)
    assert np.std(action) == pytest.approx(0.001, rel=0.1)
    forces = np.concatenate(force)
    assert forces.shape == (4000, 3)
    assert np.abs(forces).max() <= 0.1
    assert forces.std(axis=0) == pytest.approx(0.2 / np.sqrt(12), rel=0.1)


def test_seeds_repeat_and_episodes_go_on():
    first, again = random("lsy/level2"), random("lsy/level2")
    a, b = first.reset(), again.reset()
    np.testing.assert_array_equal(a.gates, b.gates)
    np.testing.assert_array_equal(a.step_noise()[1], b.step_noise()[1])
    assert not np.array_equal(first.reset().gates, a.gates)
    assert not np.array_equal(random("lsy/level2", seed=8).reset().gates, a.gates)


def test_what_is_off_draws_nothing():
    draw = random("lsy/level0", "env.disturbances={}").reset()
    np.testing.assert_array_equal(draw.gates, draw.nominal_gates)
    assert draw.mass == NOMINAL.mass
    action, force = draw.step_noise()
    assert not action.any()
    assert not force.any()


@pytest.mark.parametrize("rng", ["pcg64", "threefry"])
def test_random_layouts_keep_their_distances(rng):
    """Gates stand apart; where the grid has room, obstacles stand off gates."""
    source = random("lsy/level3", f"rng={rng}")
    close = 0
    for _ in range(60):
        draw = source.reset()
        place = draw.nominal_gates[:, :2]
        assert np.abs(place[:, 0]).max() <= 2.0 + 0.06
        assert np.abs(place[:, 1]).max() <= 1.0 + 0.04
        np.testing.assert_array_equal(draw.nominal_gates[:, 2], [0.7, 1.2, 0.7, 1.2])
        gaps = [np.linalg.norm(place[i] - place[j]) for i in range(4) for j in range(i)]
        close += min(gaps) < 0.95
    assert close < 12  # a full grid takes any place


def test_ranges_that_leave_no_body_are_refused():
    low = "env.randomizations.drone_mass={fn: uniform, kwargs: {minval: -0.06, maxval: -0.05}}"
    with pytest.raises(InputError, match="drone_mass"):
        random("lsy/level0", low).reset()
    with pytest.raises(InputError, match="seed"):
        random("lsy/level0", seed=-1)


def race(overrides=(), seed=5):
    level = load_lsy_level("lsy/multi_level2", overrides, race=True)
    return LsyRandom(level, NOMINAL, seed).race()


def test_the_drones_of_a_race_have_one_track_and_draws_of_their_own():
    one, two = race()
    np.testing.assert_array_equal(one.gates, two.gates)
    np.testing.assert_array_equal(one.obstacles, two.obstacles)
    offsets = np.array([one.start[:3] - [-1.5, 0.55, 0.01], two.start[:3] - [-1.5, 0.95, 0.01]])
    assert (np.abs(offsets) <= [0.1, 0.1, 0.02]).all()
    assert np.abs(offsets[0] - offsets[1]).min() > 1e-4
    assert one.mass != two.mass
    for a, b in zip(race(), (one, two), strict=True):
        np.testing.assert_array_equal(a.start, b.start)


@pytest.mark.parametrize("rng", ["pcg64", "threefry"])
def test_disturbances_of_a_race_do_not_depend_on_who_is_still_in_it(rng):
    noise = ["env.disturbances.action={fn: normal, scale: 0.001}", f"rng={rng}"]
    one, two = race(noise)
    both = [(one.step_noise(), two.step_noise()) for _ in range(6)]
    assert both[0][0][0].shape == (4,)
    assert both[0][0][1].shape == (5, 3)
    assert np.abs(both[0][0][1] - both[0][1][1]).min() > 0.0
    alone = race(noise)[1]
    for (_, (action, force)), (action_alone, force_alone) in zip(
        both, [alone.step_noise() for _ in range(6)], strict=True
    ):
        np.testing.assert_array_equal(action, action_alone)
        np.testing.assert_array_equal(force, force_alone)


def test_threefry_gives_a_race_the_numbers_of_jax():
    """Made with jax 0.10.2, seed 7: keys split as there, arrays with an axis for the drones."""
    place = [[0.039841365, -0.093650103, 0.0066229533], [-0.015501762, 0.094748519, 0.015105898]]
    mass = [0.0034289681, -0.0014312589]
    rpy = [[-0.094707802, 0.039390016, 0.012972379], [0.012225628, 0.028366281, 0.048311781]]
    action = [
        [0.0012063707, -0.0015352156, 0.00077777856, -0.0011598475],
        [-0.0001279315, 0.000504817, 0.0013184259, -0.00048473632],
    ]
    force = [[0.058494855, -0.058279492, 0.059793402], [-0.072491862, -0.0089050299, 0.048984386]]
    noise = "env.disturbances.action={fn: normal, scale: 0.001}"
    drawn = race([noise, "rng=threefry"], seed=7)
    starts = [[-1.5, 0.55, 0.01], [-1.5, 0.95, 0.01]]
    for k, draw in enumerate(drawn):
        np.testing.assert_allclose(draw.start[:3] - starts[k], place[k], atol=1e-8)
        np.testing.assert_allclose(draw.mass - NOMINAL.mass, mass[k], atol=1e-9)
        turn = Rotation.from_quat(draw.start[6:10]).as_euler("xyz")
        np.testing.assert_allclose(turn, rpy[k], atol=1e-8)
        for found, told in zip(draw.step_noise(), (action[k], force[k]), strict=True):
            np.testing.assert_allclose(np.atleast_2d(found)[0], told, atol=1e-8)
