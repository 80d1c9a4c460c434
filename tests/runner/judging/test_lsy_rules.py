"""Rules of lsy_drone_racing: directed passing, sensing, bounds, contacts, the end."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from crazyarena.levels.lsy import load_lsy_level
from crazyarena.levels.lsy.draw import LsyRandom
from crazyarena.runner.judging.lsy_rules import LsyEvent, LsyReferee, lsy_why
from crazyarena.sim_backend.successor import nominal
from crazyarena.sim_backend.trace import TR_CONTACT, TR_POS, TR_QUAT, TR_TIME, TRACE_SIZE


class Run:
    """A referee and a drone that is put somewhere at every step."""

    def __init__(self, *overrides, level="lsy/level0", start=(-1.5, 0.75, 0.01)):
        self.level = load_lsy_level(level, overrides)
        self.draw = LsyRandom(self.level, nominal(self.level), 1).reset()
        self.referee = LsyReferee(self.level)
        self.draw.start[:3] = start
        self.obs = self.referee.begin(self.draw, self.draw.start)
        self.steps = 0

    def to(self, *place, ticks=1, contact=-1.0, between=None):
        rows = np.zeros((ticks, TRACE_SIZE))
        self.steps += 1
        rows[:, TR_TIME] = self.steps * 0.02
        rows[:, TR_POS : TR_POS + 3] = place
        rows[:, TR_QUAT + 3] = 1.0
        rows[:, TR_CONTACT] = contact
        if between is not None:
            rows[0, TR_CONTACT] = between
        self.verdict = self.referee.judge(rows)
        return self.verdict

    def at_gate(self, number, x, y=0.0, z=0.0):
        """A place in the frame of a gate's opening."""
        gate = self.draw.gates[number]
        return gate[:3] + Rotation.from_quat(gate[3:]).apply([x, y, z])

    def through(self, number, y=0.0, z=0.0, backwards=False):
        sign = -1 if backwards else 1
        # There by way of the air above, so that nothing else is passed.
        here = self.verdict.obs["pos"] if self.steps else self.draw.start[:3]
        self.to(here[0], here[1], 2.4)
        self.to(*self.at_gate(number, -0.1 * sign)[:2], 2.4)
        self.to(*self.at_gate(number, -0.1 * sign, y, z))
        return self.to(*self.at_gate(number, 0.1 * sign, y, z))


def test_gates_in_order_end_the_run_one_step_later():
    run = Run()
    for number in range(4):
        assert int(run.obs["target_gate"]) == 0 or run.verdict.obs["target_gate"] == number
        verdict = run.through(number)
        assert verdict.obs["n_gates_passed"] == number + 1
    assert verdict.obs["target_gate"] == -1
    assert verdict.reward == -1.0
    assert not verdict.terminated
    verdict = run.to(*run.at_gate(3, 0.2))
    assert (verdict.terminated, verdict.truncated, verdict.reason) == (True, False, "GATES PASSED")
    np.testing.assert_array_equal(verdict.obs["pos"], [-1, -1, -1])


def test_a_touch_in_the_step_after_the_last_gate_still_loses_the_name_but_not_the_gates():
    run = Run("env.track.gate_order=[1]")
    run.through(0)
    verdict = run.to(*run.at_gate(0, 0.2), contact=0.0)
    assert verdict.terminated
    assert run.referee.passed == 1


def test_a_touch_in_the_step_of_a_pass_loses_it():
    run = Run()
    run.to(*run.at_gate(0, -0.1))
    verdict = run.to(*run.at_gate(0, 0.1), contact=0.0)
    assert verdict.reason == "COLLISION"
    assert run.referee.passed == 0


@pytest.mark.parametrize(
    ("y", "z", "counts", "noted"),
    [
        (0.0, 0.0, True, False),
        (0.19, -0.19, True, False),
        (0.215, 0.0, True, True),
        (0.0, -0.22, True, True),
        (0.23, 0.0, False, False),
        (0.0, 0.23, False, False),
    ],
)
def test_the_window_is_wider_than_the_opening(y, z, counts, noted):
    run = Run()
    run.through(0, y, z)
    assert run.referee.passed == counts
    assert any("outside of its opening" in note for note in run.referee.notes) == noted


def test_direction_order_and_signs():
    run = Run()
    run.through(0, backwards=True)
    run.through(1)
    assert run.referee.passed == 0
    run.through(0)
    run.through(0, backwards=True)
    assert run.referee.passed == 1
    run = Run("env.track.gate_order=[-2, 1, 1]")
    assert run.obs["target_gate"] == 1
    np.testing.assert_array_equal(run.obs["gate_sequence"], [1, 0, 0])
    np.testing.assert_array_equal(run.obs["gate_sequence_direction"], [-1, 1, 1])
    assert run.obs["target_gate_reverse"]
    assert run.obs["race_progress"] == 0
    run.through(1)
    assert run.referee.passed == 0
    for number, back in ((1, True), (0, False), (0, False)):
        run.through(number, backwards=back)
    assert run.verdict.obs["target_gate"] == -1


def test_tilted_gates_are_passed_in_their_own_plane():
    run = Run("env.track.gates[0].rpy=[0.0, 0.3, 0.0]")
    run.through(0, z=0.2)
    assert run.referee.passed == 1


def test_sensing_is_horizontal_to_the_true_place_and_sticks():
    run = Run(level="lsy/level2", start=(-1.5, 0.75, 0.01))
    true, told = run.draw.gates[0], run.draw.nominal_gates[0]
    side = np.array([0.0, 1.0, 0.0])
    verdict = run.to(*(true[:3] + 0.71 * side))
    np.testing.assert_allclose(verdict.obs["gates_pos"][0], told[:3], atol=1e-6)
    assert not verdict.obs["gates_visited"][0]
    verdict = run.to(*(true[:3] + 0.69 * side + [0, 0, 1.5]))
    np.testing.assert_allclose(verdict.obs["gates_pos"][0], true[:3], atol=1e-6)
    np.testing.assert_allclose(verdict.obs["gates_quat"][0], true[3:], atol=1e-6)
    verdict = run.to(-1.5, 0.75, 0.5)
    assert verdict.obs["gates_visited"][0]
    np.testing.assert_allclose(verdict.obs["gates_pos"][0], true[:3], atol=1e-6)
    pole = run.draw.obstacles[0]
    verdict = run.to(*(pole - [0.5, 0, 1.0]))
    assert verdict.obs["obstacles_visited"][0]
    np.testing.assert_allclose(verdict.obs["obstacles_pos"][0], pole, atol=1e-6)


def test_what_is_near_the_start_is_seen_at_once():
    run = Run(level="lsy/level2", start=(0.4, 0.3, 0.01))
    assert run.obs["gates_visited"][0]


@pytest.mark.parametrize(
    ("place", "reason"),
    [
        ((2.99, 0, 1), None),
        ((3.01, 0, 1), "OUT OF BOUNDS"),
        ((0, -3.01, 1), "OUT OF BOUNDS"),
        ((0, 0, 2.51), "OUT OF BOUNDS"),
        ((0, 0, -0.001), "FLOOR"),
        ((-1.5, 0.75, -0.001), None),
        ((-1.519, 0.75, -0.001), None),
        ((-1.521, 0.75, -0.001), "FLOOR"),
    ],
)
def test_bounds_and_floor(place, reason):
    run = Run()
    verdict = run.to(*place)
    assert verdict.reason == reason
    assert verdict.terminated == (reason is not None)


def test_the_time_limit_truncates():
    run = Run()
    for _ in range(1499):
        assert not run.to(0, 0, 1).truncated
    verdict = run.to(0, 0, 1)
    assert (verdict.truncated, verdict.terminated, verdict.reason) == (True, False, "TIME LIMIT")


def test_what_the_real_race_would_have_ended_is_told_once():
    run = Run()
    run.to(2.6, 0.0, 1.0)
    run.to(2.7, 0.0, 1.0)
    assert [note for note in run.referee.notes if "safety limits" in note] == run.referee.notes
    assert len(run.referee.notes) == 1
    assert run.verdict.reason is None


def test_a_touch_between_two_looks_is_a_note():
    run = Run()
    assert run.to(0, 0, 1, ticks=3, between=5.0).reason is None
    assert any("between two looks" in note for note in run.referee.notes)


def told(run, *names):
    """Names and details of the events of the last step."""
    events = [(e.name, e.detail) for e in run.verdict.events]
    return [e for e in events if not names or e[0] in names]


def test_what_is_seen_is_told_once():
    run = Run()
    first = run.to(-1.5, 0.75, 0.3)
    seen = [e for e in first.events if e.name.endswith("seen")]
    run.to(-1.5, 0.75, 0.3)
    assert told(run) == []
    every = {(e.name, e.detail) for e in seen}
    for number in range(len(run.draw.gates)):
        run.to(*run.at_gate(number, -0.3)[:2], 2.4)
        every |= set(told(run, "gate seen", "obstacle seen"))
    assert {f"gate {k}" for k in range(4)} == {d for name, d in every if name == "gate seen"}
    np.testing.assert_array_equal(run.verdict.obs["gates_visited"], True)


@pytest.mark.parametrize(
    ("y", "z", "part"),
    [
        (0.25, 0.0, "left bar, 0.25 m left of its centre"),
        (-0.27, 0.1, "right bar, 0.27 m right of its centre"),
        (0.1, 0.3, "top bar, 0.30 m above its centre"),
        (0.1, -0.3, "bottom bar, 0.30 m below its centre"),
        (0.0, -0.6, "stand"),
    ],
)
def test_a_contact_names_the_part_that_was_touched(y, z, part):
    run = Run()
    run.to(*run.at_gate(1, 0.0, y, z), contact=1.0)
    assert told(run, "contact") == [("contact", f"gate 1 ({part})")]
    assert run.verdict.reason == "COLLISION"
    why = lsy_why("COLLISION", run.verdict.events, None, 0, 4, 9.0)
    assert why == f"COLLISION with gate 1 ({part}) at 0.02 s"


def test_contacts_begin_and_end_between_looks_too():
    run = Run()
    run.to(-1.5, 0.75, 0.3, ticks=4, between=5.0)
    assert told(run, "contact", "contact ended") == [
        ("contact", "obstacle 1"),
        ("contact ended", "obstacle 1"),
    ]
    assert run.verdict.reason is None


def test_leaving_the_safety_limits_and_coming_back_is_told():
    run = Run()
    run.to(-2.6, 0.75, 1.0)
    assert told(run, "constraint violated") == [("constraint violated", "x below -2.5 m")]
    run.to(-2.7, 0.75, 1.0)
    assert told(run, "constraint violated") == []
    run.to(-2.0, 0.75, 1.0)
    assert told(run, "constraint satisfied again") != []
    run.to(-2.6, 0.75, 2.6)
    assert run.verdict.reason == "OUT OF BOUNDS"
    assert told(run, "out of bounds") == [("out of bounds", "z above 2.5 m")]
    why = lsy_why("OUT OF BOUNDS", run.verdict.events, None, 1, 4, 9.0)
    assert why == "OUT OF BOUNDS: z above 2.5 m at 0.08 s, 1 of 4 gates"


def test_why_tells_when_it_ended_and_not_when_something_happened_last():
    told = [LsyEvent(0.5, "gate passed", "0")]
    assert lsy_why("CONTROLLER FINISHED", told, None, 1, 4, 1.6) == (
        "CONTROLLER FINISHED: 1 of 4 gates at 1.60 s"
    )
    assert lsy_why("TIME LIMIT", [], None, 0, 4, 30.0) == "TIME LIMIT: 0 of 4 gates at 30.00 s"
    assert lsy_why("FLOOR", told, None, 1, 4, 0.42) == (
        "FLOOR: came down away from its start at 0.42 s, 1 of 4 gates"
    )
