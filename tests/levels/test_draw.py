"""Golden values are the published ones of seed 1337, levels 2 and 3, first episode."""

from __future__ import annotations

import numpy as np
import pytest

from crazyarena.errors import InputError
from crazyarena.levels import Level, load_level
from crazyarena.levels.draw import Draw, LevelRandom, make_generator
from crazyarena.levels.schema import RngKind

# Six decimals where the table has six: the last one may be rounded either way.
CLOSE = {"rtol": 0.0, "atol": 1e-6}

GOLDEN = {
    "gym021": {
        "obstacles": [
            [1.577614, -2.642243, -0.052567],
            [0.435693, -0.896912, -0.110387],
            [1.458469, -0.055026, -0.145687],
            [-0.874372, 0.070023, -0.082543],
        ],
        "gates": [
            [0.614349, -2.634076, -1.678376],
            [1.935633, -1.501775, 0.102184],
            [-0.116797, 0.069824, 1.594068],
            [-0.358465, 1.513894, 0.025997],
        ],
        "mass": 0.04185914,
        "inertia": [1.479428e-5, 1.357230e-5, 2.137144e-5],
        "position": [-0.966099, -2.906546, 0.049606],
        "attitude": [0.028402, -0.057447, 0.073737],
        "action": [3.12474e-4, -2.54264e-4, 5.37125e-4, 0.64408e-4],
        "force": [-0.071558, -0.059123, 0.076666],
    },
    "pcg64": {
        "obstacles": [
            [1.613431, -2.594342, 0.126270],
            [0.633970, -0.887648, -0.115277],
            [1.408119, -0.047479, -0.001263],
            [-0.880489, -0.148062, -0.081777],
        ],
        "gates": [
            [0.588096, -2.525714, -1.694856],
            [1.967629, -1.548129, -0.143309],
            [0.117131, 0.057161, 1.670746],
            [-0.512120, 1.362130, 0.093897],
        ],
        "mass": 0.04006707,
        "inertia": [1.443426e-5, 1.313083e-5, 2.195758e-5],
        "position": [-0.802764, -2.845737, 0.034282],
        "attitude": [-0.082825, 0.094726, 0.048098],
        "action": [-18.5562e-4, 4.32562e-4, 0.72445e-4, -19.4375e-4],
        "force": [-0.055618, 0.025180, 0.040131],
    },
}
RNGS = sorted(GOLDEN)


def same(a: Draw, b: Draw) -> bool:
    return a.mass == b.mass and all(
        np.array_equal(getattr(a, name), getattr(b, name))
        for name in ("start", "inertia", "gates", "nominal_gates", "obstacles")
    )


@pytest.mark.parametrize("name", ["level2", "level3"])
@pytest.mark.parametrize("rng", RNGS)
def test_golden_world(rng, name):
    draw = LevelRandom(load_level(name, [f"rng={rng}"])).reset()
    golden = GOLDEN[rng]
    np.testing.assert_allclose(draw.obstacles[:, [0, 1, 5]], golden["obstacles"], **CLOSE)
    np.testing.assert_allclose(draw.gates[:, [0, 1, 5]], golden["gates"], **CLOSE)
    np.testing.assert_allclose(draw.mass, golden["mass"], rtol=0, atol=1e-8)
    np.testing.assert_allclose(draw.inertia, golden["inertia"], rtol=0, atol=1e-11)
    np.testing.assert_allclose(draw.start[[0, 2, 4]], golden["position"], **CLOSE)
    np.testing.assert_allclose(draw.start[6:9], golden["attitude"], **CLOSE)
    assert not draw.start[[1, 3, 5, 9, 10, 11]].any()
    noise = draw.tick_noise(1)[0]
    np.testing.assert_allclose(noise[:4], golden["action"], rtol=0, atol=1e-8)
    np.testing.assert_allclose(noise[4:], golden["force"], **CLOSE)


def test_unrandomised_columns():
    draw = LevelRandom(load_level("level2")).reset()
    assert draw.gates[:, 2].tolist() == [1.0, 0.525, 0.525, 1.0]
    assert draw.gates[:, 6].tolist() == [0.0, 1.0, 1.0, 0.0]
    assert draw.nominal_gates[:, 2].tolist() == [0.0] * 4
    assert not draw.gates[:, 3:5].any()
    assert not draw.obstacles[:, 2:5].any()


def test_level0_draws_nothing():
    level = load_level("level0")
    draw = LevelRandom(level).reset()
    assert draw.start.tolist() == [-0.9, 0, -2.9, 0, 0.03, 0, 0, 0, 0, 0, 0, 0]
    assert draw.mass == 0.03454
    assert draw.inertia.tolist() == [1.4e-5, 1.4e-5, 2.17e-5]
    assert draw.nominal_gates.tolist() == [gate.row for gate in level.track.gates]
    assert np.array_equal(
        np.delete(draw.gates, 2, axis=1), np.delete(draw.nominal_gates, 2, axis=1)
    )
    assert not draw.tick_noise(20).any()


def test_no_track():
    level = load_level("level2", ["track.gates=[]", "track.obstacles=[]"])
    draw = LevelRandom(level).reset()
    assert draw.gates.shape == (0, 7)
    assert draw.obstacles.shape == (0, 6)
    # Nothing was drawn for the track, so the mass got the first number of the stream.
    assert draw.mass == 0.03454 + np.random.default_rng(1337).uniform(-0.01, 0.01)


def test_start_draws_follow_the_state_order():
    ranges = "{r: [1, 2], psi: [1, 2], vx: [1, 2], z: [0.1, 0.2], y: [0.1, 0.2]}"
    level = load_level("level0", [f"randomization.start={ranges}"])
    draw = LevelRandom(level).reset()
    rng = np.random.default_rng(1337)
    expected = np.array(level.start.state)
    for index, low, high in ((1, 1, 2), (2, 0.1, 0.2), (4, 0.1, 0.2), (8, 1, 2), (11, 1, 2)):
        expected[index] += rng.uniform(low, high)
    assert draw.start.tolist() == expected.tolist()


def by_hand(level: Level, episodes: list[int]) -> list[np.ndarray]:
    """The documented order, spelled out: 24 + 4 + 6 uniforms per reset, 4 + 3 draws per tick."""
    rng = make_generator(level.rng, level.seed)
    noise = []
    for ticks in episodes:
        if level.reseed_on_reset:
            rng = make_generator(level.rng, level.seed)
        for _ in range(24 + 4 + 6):
            rng.uniform(0.0, 1.0)
        rows = [
            np.concatenate([rng.normal(0.0, 0.001, 4), rng.uniform(-0.1, 0.1, 3)])
            for _ in range(ticks)
        ]
        noise.append(np.array(rows).reshape(-1, 7))
    return noise


@pytest.mark.parametrize("reseed", ["true", "false"])
@pytest.mark.parametrize("rng", RNGS)
def test_noise_is_the_stream_of_numpy_across_episodes(rng, reseed):
    level = load_level("level3", [f"rng={rng}", f"reseed_on_reset={reseed}"])
    # Chunks that end inside, at and beyond the blocks drawn ahead; an episode without a tick.
    chunks = [[17, 17, 16, 1], [256], [255, 1, 256, 3], [], [700], [5]]
    random = LevelRandom(level)
    for given, expected in zip(chunks, by_hand(level, [sum(c) for c in chunks]), strict=True):
        draw = random.reset()
        parts = [draw.tick_noise(n) for n in given]
        assert np.array_equal(np.concatenate([np.zeros((0, 7)), *parts]), expected)


@pytest.mark.parametrize("rng", RNGS)
def test_absent_disturbances_draw_nothing(rng):
    only_action = load_level("level0", [f"rng={rng}", "disturbances.action.std=0.001"])
    noise = LevelRandom(only_action).reset().tick_noise(10)
    normals = make_generator(RngKind(rng), 1337).normal(0.0, 0.001, (10, 4))
    assert np.array_equal(noise[:, :4], normals)
    assert not noise[:, 4:].any()

    force = "disturbances.dynamics={low: -0.1, high: [0.1, 0.2, 0.3]}"
    only_force = load_level("level0", [f"rng={rng}", force])
    noise = LevelRandom(only_force).reset().tick_noise(10)
    uniforms = make_generator(RngKind(rng), 1337).uniform(-0.1, [0.1, 0.2, 0.3], (10, 3))
    assert not noise[:, :4].any()
    assert np.array_equal(noise[:, 4:], uniforms)


@pytest.mark.parametrize("rng", RNGS)
def test_reseed_rule(rng):
    again = LevelRandom(load_level("level2", [f"rng={rng}"]))
    onward = LevelRandom(load_level("level3", [f"rng={rng}"]))
    first, other = again.reset(), onward.reset()
    assert same(first, other)
    noise = first.tick_noise(40)
    assert np.array_equal(noise, other.tick_noise(40))
    second, moved = again.reset(), onward.reset()
    assert same(second, first)
    assert np.array_equal(second.tick_noise(40), noise)
    assert not same(moved, first)
    assert not np.array_equal(moved.tick_noise(40), noise)


def test_seed_replaces_the_levels_own():
    level = load_level("level2")
    assert same(LevelRandom(level, seed=1337).reset(), LevelRandom(level).reset())
    other = LevelRandom(level, seed=99)
    draw = other.reset()
    assert not same(draw, LevelRandom(level).reset())
    assert same(other.reset(), draw)
    assert same(draw, LevelRandom(load_level("level2", ["seed=99"])).reset())


def test_negative_seed_is_refused():
    with pytest.raises(InputError, match="seed: expected a whole number >= 0, found -1"):
        LevelRandom(load_level("level0"), seed=-1)


def test_noise_of_a_finished_episode_is_refused():
    random = LevelRandom(load_level("level3"))
    draw = random.reset()
    random.reset()
    with pytest.raises(RuntimeError, match="episode is over"):
        draw.tick_noise(1)


def test_arrays_are_read_only():
    draw = LevelRandom(load_level("level3")).reset()
    for name in ("start", "inertia", "gates", "nominal_gates", "obstacles"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(draw, name)[0] = 0.0
    draw.tick_noise(2)[0] = 1.0
    assert abs(draw.tick_noise(2)).max() < 1.0


def test_noise_has_the_asked_spread():
    noise = LevelRandom(load_level("level1")).reset().tick_noise(20_000)
    np.testing.assert_allclose(noise[:, :4].std(axis=0), 0.001, rtol=0.05)
    assert abs(noise[:, 4:]).max() <= 0.1
    np.testing.assert_allclose(noise[:, 4:].std(axis=0), 0.2 / 12**0.5, rtol=0.05)
