"""Several drones in lsy_drone_racing's simulation: each flies as alone, and touches the others."""

import numpy as np
import pytest

from crazyarena.levels.lsy import load_lsy_level
from crazyarena.levels.lsy.draw import LsyRandom
from crazyarena.sim_backend.physics.successor_scene import DRONE_HALF, NO_CONTACT
from crazyarena.sim_backend.successor import SuccessorWorld, nominal
from crazyarena.sim_backend.successor_race import SuccessorRace
from crazyarena.sim_backend.trace import TR_CONTACT

LEVEL = load_lsy_level("lsy/multi_level2", race=True)
FIRST = 8  # code of drone 0, behind four gates and four obstacles
HOVER = np.array([0.0, 0.0, 0.0, 0.43])


def draws(seed=3):
    return LsyRandom(LEVEL, nominal(LEVEL), seed).race()


def placed(*places):
    """A race whose drones hang at places, m, upright."""
    race, drawn = SuccessorRace(LEVEL), draws()
    for draw, place in zip(drawn, places, strict=True):
        draw.start[:] = [*place, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0]
    race.reset(drawn)
    return race


def test_each_flies_as_it_would_alone():
    race, alone = SuccessorRace(LEVEL), [SuccessorWorld(LEVEL) for _ in range(2)]
    race.reset(draws())
    for world, draw in zip(alone, draws(), strict=True):
        world.reset(draw)
    commands = [np.array([0.02, 0.0, 0.1, 0.6]), np.array([0.0, 0.03, 0.0, 0.5])]
    for _ in range(30):
        rows = race.step(commands)
        for row, world, command in zip(rows, alone, commands, strict=True):
            np.testing.assert_array_equal(row, world.step(command))
    for state, world in zip(race.states, alone, strict=True):
        np.testing.assert_array_equal(state, world.state)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_boxes_that_overlap_touch_and_others_do_not(axis):
    middle = np.array([2.0, 1.0, 1.5])
    reach = np.zeros(3)
    reach[axis] = 2 * DRONE_HALF[axis]
    for share, touches in ((0.9, True), (1.2, False)):
        race = placed(middle, middle + share * reach)
        one, two = race.step([HOVER, HOVER])
        assert (one[0, TR_CONTACT], two[0, TR_CONTACT]) == (
            (FIRST + 1, FIRST) if touches else (NO_CONTACT, NO_CONTACT)
        )


def test_a_turned_box_reaches_farther():
    """By its corner: as wide as a side and a half."""
    middle, off = np.array([2.0, 1.0, 1.5]), np.array([0.16, 0.0, 0.0])
    race = placed(middle, middle + off)
    assert race.step([HOVER, HOVER])[0][0, TR_CONTACT] == NO_CONTACT
    race, drawn = SuccessorRace(LEVEL), draws()
    half = np.sin(np.pi / 8), np.cos(np.pi / 8)
    drawn[0].start[:] = [*middle, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0]
    drawn[1].start[:] = [*(middle + off), 0, 0, 0, 0, 0, *half, 0, 0, 0]
    race.reset(drawn)
    assert race.step([HOVER, HOVER])[0][0, TR_CONTACT] == FIRST + 1


def test_one_that_is_out_is_not_there():
    race = placed([2.0, 1.0, 1.5], [2.05, 1.0, 1.5])
    one, two = race.step([HOVER, None])
    assert two is None
    assert (one[:, TR_CONTACT] == NO_CONTACT).all()


def test_a_gate_that_is_touched_is_told_before_a_drone():
    race, drawn = SuccessorRace(LEVEL), draws()
    bar = drawn[0].gates[2, :3] + [0.0, 0.0, 0.28]
    for draw in drawn:
        draw.start[:] = [*bar, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0]
    race.reset(drawn)
    one, two = race.step([HOVER, HOVER])
    assert one[0, TR_CONTACT] == two[0, TR_CONTACT] == 2
