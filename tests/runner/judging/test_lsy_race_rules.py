"""Races of lsy_drone_racing: what each drone is judged to be, and what everybody sees."""

import numpy as np
import pytest

from crazyarena.levels.lsy import load_lsy_level
from crazyarena.levels.lsy.draw import LsyRandom
from crazyarena.runner.judging.lsy_race_rules import RaceReferee
from crazyarena.runner.judging.lsy_rules import COLLISION, GATES_PASSED, OUT_OF_BOUNDS, LsyReferee
from crazyarena.sim_backend.successor import nominal
from crazyarena.sim_backend.trace import TR_CONTACT, TR_POS, TR_QUAT, TR_TIME, TRACE_SIZE

LEVEL = load_lsy_level("lsy/multi_level0", race=True)
START = np.array([[-1.5, 0.55, 0.01], [-1.5, 0.95, 0.01]])


class Race:
    """A race whose drones are put where one likes, step by step."""

    def __init__(self):
        self.draws = LsyRandom(LEVEL, nominal(LEVEL), 0).race()
        self.referee = RaceReferee(LEVEL)
        self.steps = 0
        self.obs = self.referee.begin(self.draws, [draw.start for draw in self.draws])

    def step(self, *places, contacts=(-1.0, -1.0)):
        self.steps += 1
        rows = []
        for place, contact in zip(places, contacts, strict=True):
            if place is None:
                rows.append(None)
                continue
            row = np.zeros((1, TRACE_SIZE))
            row[0, TR_TIME] = self.steps / LEVEL.env.freq
            row[0, TR_POS : TR_POS + 3], row[0, TR_QUAT + 3] = place, 1.0
            row[0, TR_CONTACT] = contact
            rows.append(row)
        return self.referee.judge(rows)


def through(gate):
    """Places before and behind a gate of the draw, along its x axis."""
    x, y, z, w = gate[3:]
    ahead = np.array([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)])
    return gate[:3] - 0.1 * ahead, gate[:3] + 0.1 * ahead


SHAPES = {
    "pos": ((2, 3), "float32"),
    "quat": ((2, 4), "float32"),
    "vel": ((2, 3), "float32"),
    "ang_vel": ((2, 3), "float32"),
    "target_gate": ((2,), "int32"),
    "gates_pos": ((2, 4, 3), "float32"),
    "gates_quat": ((2, 4, 4), "float32"),
    "gates_visited": ((2, 4), "bool"),
    "obstacles_pos": ((2, 4, 3), "float32"),
    "obstacles_visited": ((2, 4), "bool"),
    "n_gates_passed": ((2,), "int32"),
    "gate_sequence": ((2, 4), "int32"),
    "gate_sequence_direction": ((2, 4), "int32"),
    "race_progress": ((2,), "int32"),
    "target_gate_reverse": ((2,), "bool"),
}


def test_every_key_has_a_leading_axis_for_the_drones():
    race = Race()
    for obs in (race.obs, race.step(*START).obs):
        assert {k: (v.shape, str(v.dtype)) for k, v in obs.items()} == SHAPES
        np.testing.assert_allclose(obs["pos"], START, atol=1e-6)


def test_each_row_is_what_the_drone_alone_would_see():
    race, alone = Race(), LsyReferee(LEVEL)
    alone.begin(race.draws[1], race.draws[1].start)
    place = race.draws[0].gates[0, :3] + [0.3, 0.0, 0.0]
    row = np.zeros((1, TRACE_SIZE))
    row[0, TR_POS : TR_POS + 3], row[0, TR_QUAT + 3], row[0, TR_CONTACT] = place, 1.0, -1.0
    seen = race.step(START[0], place).obs
    for name, value in alone.judge(row).obs.items():
        np.testing.assert_array_equal(seen[name][1], value)
    assert seen["gates_visited"].tolist() == [[False] * 4, [True, True, False, False]]


def test_two_that_touch_are_both_out_and_the_race_is_over():
    race = Race()
    said = race.step([0.0, 0.0, 1.0], [0.05, 0.0, 1.0], contacts=(9.0, 8.0))
    assert [said.each[drone].reason for drone in range(2)] == [COLLISION, COLLISION]
    assert (said.terminated, said.truncated) == (True, False)
    assert race.referee.racing == [False, False]
    events = [[(e.name, e.detail) for e in said.each[drone].events] for drone in range(2)]
    assert ("contact", "drone 1") in events[0]
    assert ("contact", "drone 0") in events[1]
    np.testing.assert_array_equal(said.obs["pos"], np.full((2, 3), -1.0))


def test_one_that_is_out_is_taken_away_and_the_other_goes_on():
    race = Race()
    said = race.step([0.0, 3.5, 1.0], START[1])
    assert said.each[0].reason == OUT_OF_BOUNDS
    assert said.each[0].terminated
    assert not said.terminated
    for _ in range(3):
        said = race.step(None, START[1] + [0.0, 0.0, 0.3])
        assert list(said.each) == [1]
        np.testing.assert_allclose(said.obs["pos"][0], [-1.0, -1.0, -1.0])
        np.testing.assert_allclose(said.obs["pos"][1], START[1] + [0.0, 0.0, 0.3], atol=1e-6)
    assert [referee.steps for referee in race.referee.drones] == [1, 4]


def test_one_whose_controller_is_gone_is_taken_away():
    race = Race()
    race.referee.withdraw(1)
    said = race.step(START[0], START[1])
    assert list(said.each) == [0]
    np.testing.assert_allclose(said.obs["pos"][1], [-1.0, -1.0, -1.0])
    race.referee.begin(race.draws, [draw.start for draw in race.draws])
    assert race.referee.racing == [True, True]


def test_each_has_gates_and_rewards_of_its_own():
    race = Race()
    for gate in race.draws[0].gates:
        for place in through(gate):
            said = race.step(place, START[1])
    assert said.obs["n_gates_passed"].tolist() == [4, 0]
    assert said.obs["target_gate"].tolist() == [-1, 0]
    assert said.obs["race_progress"].tolist() == [-1, 0]
    assert [said.each[drone].reward for drone in range(2)] == [-1.0, 0.0]
    said = race.step(place, START[1])
    assert said.each[0].reason == GATES_PASSED
    assert not said.terminated
    assert race.referee.racing == [False, True]


@pytest.mark.parametrize("steps", [1499, 1500])
def test_the_race_is_cut_after_1500_steps(steps):
    race = Race()
    for _ in range(steps):
        said = race.step(*START)
    assert said.truncated == (steps == 1500)
    assert (said.each[0].reason == "TIME LIMIT") == (steps == 1500)
