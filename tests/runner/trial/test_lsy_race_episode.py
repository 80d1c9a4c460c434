"""The loop of a race: who is asked when, what ends whose race, and what is recorded."""

import numpy as np
import pytest

from crazyarena.clock import VirtualClock
from crazyarena.errors import InputError
from crazyarena.levels.lsy import load_lsy_level
from crazyarena.levels.lsy.draw import LsyRandom
from crazyarena.live import POSITION, Live, Watched
from crazyarena.runner.contestant.contract_lsy.dialogue import Drawing, LsyAnswer
from crazyarena.runner.judging.lsy_race_rules import RaceReferee
from crazyarena.runner.trial.lsy_race_episode import RaceEpisode
from crazyarena.runner.trial.lsy_race_showing import RaceShowing
from crazyarena.sim_backend.successor import nominal
from crazyarena.sim_backend.successor_race import SuccessorRace

REST = [0.0, 0.0, 0.0, 0.1]
UP = [0.0, 0.0, 0.0, 0.8]
LEVEL = load_lsy_level("lsy/multi_level0", race=True)


class Scripted:
    """A contestant by two functions of the number of its questions."""

    digest, description = "0", {}

    def __init__(self, command=REST, finished=lambda asked: False, fails=None, made=None):
        self._command, self._finished, self._fails, self._made = command, finished, fails, made
        self.asked, self.told, self.hooks, self.killed = [], [], [], False
        self._question = None

    def make(self, obs, config, info=None):
        self.obs, self.config, self.info = obs, config, info
        if self._made is not None:
            raise self._made

    def put(self, question):
        assert self._question is None
        self._question = question

    def take(self, timeout):
        question, self._question = self._question, None
        if question.told is not None:
            self.told.append((question.step, question.told))
            drawn = [Drawing("line", np.zeros((2, 3)), (1.0, 0.0, 0.0, 1.0), 2.0)]
            finished = self._finished(len(self.asked))
            return LsyAnswer(question.step, finished=finished, drawings=drawn * question.draw)
        self.asked.append((question.step, question.obs))
        if self._fails is not None and len(self.asked) == self._fails[0]:
            return self._fails[1] and LsyAnswer(question.step, error=self._fails[1])
        return LsyAnswer(question.step, command=np.array(self._command))

    def hook(self, name):
        self.hooks.append(name)
        return 0.0, None

    def kill(self):
        self.killed = True

    def close(self):
        pass


def race(*racers, level=LEVEL, index=0, show=None):
    world, referee = SuccessorRace(level), RaceReferee(level)
    names, wall = ["one", "two"], VirtualClock()
    episode = RaceEpisode(index, level, racers, names, world, referee, wall=wall, show=show)
    return episode.fly(LsyRandom(level, nominal(level), 0).race())


def at(count):
    return lambda asked: asked >= count


def test_each_is_asked_at_its_own_rate_and_told_its_rank():
    slow, fast = Scripted(finished=at(5)), Scripted(finished=at(10))
    results = race(slow, fast)
    assert [step for step, _ in slow.asked] == [0, 2, 4, 6, 8]
    assert [step for step, _ in fast.asked] == list(range(10))
    assert [step for step, _ in slow.told] == [0, 2, 4, 6, 8]
    assert [racer.info for racer in (slow, fast)] == [{"rank": 0}, {"rank": 1}]
    assert [racer.config["env"]["freq"] for racer in (slow, fast)] == [50, 100]
    assert slow.obs["pos"].shape == (2, 3)
    assert [r.termination for r in results] == ["CONTROLLER FINISHED"] * 2
    assert [r.drone for r in results] == [0, 1]
    assert [r.controller for r in results] == ["one", "two"]
    assert [len(r.hooks) for r in (slow, fast)] == [2, 2]


def test_the_last_command_holds_between_two_questions():
    climbs, stays = Scripted(UP, finished=at(20)), Scripted(finished=at(40))
    race(climbs, stays)
    heights = np.array([obs["pos"][:, 2] for _, obs in stays.asked])
    assert heights[-1, 0] > 0.2
    assert heights[-1, 1] < 0.02
    # Half way between two questions it still climbs as before.
    assert (np.diff(heights[10:, 0]) > 0.0).all()


def test_one_that_has_finished_flies_on_until_all_have():
    early, late = Scripted(UP, finished=at(1)), Scripted(finished=at(30))
    results = race(early, late)
    assert len(early.asked) == 15
    assert [r.steps for r in results] == [30, 30]
    changes_its_mind = Scripted(finished=lambda asked: asked < 3)
    race(changes_its_mind, Scripted(finished=lambda asked: asked >= 20))
    assert len(changes_its_mind.asked) == 750


@pytest.mark.parametrize("failure", ["step 3: compute_control raised", None])
def test_one_that_fails_is_out_and_the_other_goes_on(failure):
    bad, good = Scripted(fails=(4, failure)), Scripted(finished=at(50))
    results = race(bad, good)
    assert len(bad.asked) == 4
    assert bad.killed == (failure is None)
    assert results[0].termination == "CONTROLLER ERROR"
    assert (failure or "no answer within 30 s") in results[0].error
    assert (results[1].termination, results[1].steps) == ("CONTROLLER FINISHED", 50)
    assert results[1].error is None
    assert (bad.hooks, len(good.hooks)) == ([], 2)
    np.testing.assert_allclose(good.asked[-1][1]["pos"][0], [-1.0, -1.0, -1.0])


def test_all_that_fail_end_the_race():
    results = race(Scripted(fails=(1, "a")), Scripted(fails=(1, "b")))
    assert [r.termination for r in results] == ["CONTROLLER ERROR"] * 2
    assert [r.steps for r in results] == [0, 0]


def test_one_that_cannot_be_made_is_out_and_all_of_them_are_bad_input():
    broken = InputError("its constructor raised")
    good = Scripted(finished=at(10))
    results = race(Scripted(made=broken), good)
    assert results[0].error == "its constructor raised"
    assert results[1].steps == 10
    with pytest.raises(InputError, match="its constructor"):
        race(Scripted(made=broken), Scripted(made=broken))
    later = race(Scripted(made=broken), Scripted(made=broken), index=1)
    assert [r.termination for r in later] == ["CONTROLLER ERROR"] * 2


def test_a_race_that_nobody_ends_is_cut():
    results = race(Scripted(), Scripted())
    assert [r.termination for r in results] == ["TIME LIMIT"] * 2
    assert [r.steps for r in results] == [1500] * 2
    assert [r.place for r in results] == [None, None]


def test_ctrl_c_ends_it_for_those_that_still_fly():
    class Stopped(Scripted):
        def take(self, timeout):
            if len(self.asked) == 20:
                raise KeyboardInterrupt
            return super().take(timeout)

    results = race(Scripted(fails=(2, "raised")), Stopped())
    assert [r.termination for r in results] == ["CONTROLLER ERROR", "INTERRUPTED"]


def test_viewers_see_all_drones_and_those_no_more_that_are_out(tmp_path):
    class Looks(RaceShowing):
        def step_race(self, *said):
            self._published = -1e9  # every step has its picture
            super().step_race(*said)
            rows = watched.state().rows
            places.append(rows[:, POSITION : POSITION + 3].copy())
            lines.append(sum(len(e["lines"]) for e in watched.scene()["drawn"]))

    live, places, lines = Live(2, tmp_path), [], []
    watched = Watched(live.file)
    show = Looks(live, LEVEL, 1, pace=0.0, wall=VirtualClock())
    race(Scripted(UP, fails=(11, "raised")), Scripted(finished=at(30)), show=show)
    assert len(places) == 30
    assert np.isfinite(places[19]).all()
    assert np.isnan(places[20][0]).all()
    np.testing.assert_allclose(places[-1][1, :2], [-1.5, 0.95], atol=0.01)
    assert set(lines) == {2}
    facts = watched.state().facts
    assert facts["why"] == "drone 0: CONTROLLER ERROR, drone 1: CONTROLLER FINISHED"
    assert watched.scene()["vehicles"] == ["drone 0", "drone 1"]
    live.close()
