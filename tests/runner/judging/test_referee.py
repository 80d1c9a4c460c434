"""Rules and quirks of the competition, one by one, on prescribed poses."""

import numpy as np
import pytest

from crazyarena.levels import load_level
from crazyarena.levels.draw import LevelRandom
from crazyarena.runner.judging.referee import FORCE_HIGH, FORCE_LOW, Referee
from crazyarena.sim_backend.trace import TR_ACTION, TR_CONTACT, TR_TUMBLED, UNKNOWN_CONTACT
from tests.runner.fakes import rows

AWAY = (-0.9, -2.9, 0.6)
GOAL = (-0.5, 2.9, 0.75)
# Centres of the gates of level 0.
GATES = [(0.5, -2.5, 1.0), (2.0, -1.5, 0.525), (0.0, 0.2, 0.525), (-0.5, 1.5, 1.0)]


def begun(*overrides: str, level: str = "level0") -> Referee:
    loaded = load_level(level, overrides)
    draw = LevelRandom(loaded).reset()
    referee = Referee(loaded)
    referee.begin(draw.gates, draw.obstacles)
    return referee


def no_gates(*overrides: str) -> Referee:
    return begun("track.gates=[]", "track.obstacles=[]", *overrides)


def pass_all(referee: Referee, tick: int = 300) -> int:
    """Fly through every gate; returns the next free tick."""
    for centre in GATES:
        referee.judge(rows([centre], tick))
        tick += 1
    assert referee.gates_passed == 4
    return tick


class TestGates:
    def test_not_looked_at_before_tick_252(self):
        referee = begun()
        assert referee.judge(rows([GATES[0]] * 251)).gate == 0
        assert referee.judge(rows([GATES[0]], 252)).gate == 1

    def test_info_of_the_passing_tick_tells_the_next_gate(self):
        info = begun().judge(rows([GATES[0]], 300)).info
        assert info["current_target_gate_id"] == 1
        assert info["current_target_gate_type"] == 1

    @pytest.mark.parametrize("direction", [1, -1])
    def test_either_direction_counts(self, direction):
        referee = begun()
        x, y, z = GATES[0]
        path = [(x + direction * s, y, z) for s in np.linspace(-0.3, 0.3, 61)]
        verdict = referee.judge(rows(path, 300))
        assert verdict.gate == 1
        assert [e.name for e in verdict.events] == ["gate passed"]
        # The gate is entered 0.061 m before its plane.
        assert verdict.events[0].tick == 300 + 24

    @pytest.mark.parametrize(
        ("offset", "hit"),
        [
            ((0.0, 0.205, 0.0), True),
            ((0.0, 0.22, 0.0), False),
            ((0.055, 0.0, 0.0), True),
            ((0.07, 0.0, 0.0), False),
            ((0.0, 0.0, 0.195), True),
            ((0.0, 0.0, 0.21), False),
            ((0.0, 0.0, -0.170), True),
            ((0.0, 0.0, -0.180), False),
        ],
    )
    def test_size_of_the_opening(self, offset, hit):
        # Gate 0 has yaw -1.57: its normal is x, it spans y.
        position = np.array(GATES[0]) + offset
        assert (begun().judge(rows([position], 300)).gate == 1) is hit

    def test_only_the_next_gate_counts_and_one_per_tick(self):
        referee = begun()
        assert referee.judge(rows([GATES[1]] * 5, 300)).gate == 0
        assert referee.judge(rows([GATES[0], GATES[1]], 310)).gate == 2

    def test_list_and_reward_after_the_last_gate(self):
        referee = begun()
        tick = pass_all(referee)
        verdict = referee.judge(rows([AWAY], tick))
        assert verdict.info["current_target_gate_id"] == -1
        assert verdict.info["current_target_gate_type"] == -1
        assert verdict.info["current_target_gate_pos"] == []
        # The bonus sticks: no gate test clears it any more.
        assert verdict.reward == 100
        assert referee.judge(rows([GOAL], tick + 1)).reward == 200

    def test_bonus_of_earlier_gates_lasts_one_tick(self):
        referee = begun()
        assert referee.judge(rows([GATES[0]], 300)).reward == 100
        assert referee.judge(rows([AWAY], 301)).reward == 0
        # Within one control step only the last tick is seen.
        assert referee.judge(rows([GATES[1], AWAY], 302)).reward == 0

    def test_a_fallen_pillar_in_the_opening_passes_the_gate(self):
        level = load_level("level0")
        draw = LevelRandom(level).reset()
        obstacles = draw.obstacles.copy()
        obstacles[0] = [*draw.gates[1, :2], 0.0, np.pi / 2, 0.0, 0.0]  # lies across
        referee = Referee(level)
        referee.begin(draw.gates, obstacles)
        assert referee.judge(rows([GATES[0]], 300)).gate == 1
        assert referee.judge(rows([AWAY], 301)).gate == 2


class TestVisibility:
    def test_pose_is_nominal_with_z_0_until_near(self):
        info = begun().judge(rows([AWAY])).info
        assert info["current_target_gate_in_range"] is False
        assert info["current_target_gate_pos"] == [0.5, -2.5, 0, 0, 0, -1.57]

    def test_surface_distance_and_not_sticky(self):
        referee = begun()
        x, y, z = GATES[0]
        # On the axis the beams are 0.46 .. 0.52 m away: see the geometry's own tests.
        near = referee.judge(rows([(x - 0.45, y, z)])).info
        assert near["current_target_gate_in_range"] is True
        assert near["current_target_gate_pos"] == [0.5, -2.5, 1.0, 0, 0, -1.57]
        far = referee.judge(rows([(x - 0.60, y, z)], 2)).info
        assert far["current_target_gate_in_range"] is False
        assert far["current_target_gate_pos"][2] == 0

    def test_randomised_gate_is_revealed(self):
        level = load_level("level2")
        draw = LevelRandom(level).reset()
        referee = Referee(level)
        referee.begin(draw.gates, draw.obstacles)
        info = referee.judge(rows([draw.gates[0, :3]])).info
        assert info["current_target_gate_pos"] == draw.gates[0, :6].tolist()
        assert all(type(v) is np.float64 for v in info["current_target_gate_pos"])
        far = referee.judge(rows([AWAY], 2)).info
        assert far["current_target_gate_pos"] == level.track.gates[0].row[:6]
        # A list of the contestant's own: writing to it must not change the next one.
        far["current_target_gate_pos"][0] = 99.0
        assert referee.judge(rows([AWAY], 3)).info["current_target_gate_pos"][0] == 0.5


class TestGoal:
    def test_only_after_all_gates(self):
        assert begun().judge(rows([GOAL], 300)).info["at_goal_position"] is False

    def test_completed_at_the_1001st_tick(self):
        referee = no_gates()
        verdict = referee.judge(rows([GOAL] * 1000))
        assert (verdict.info["task_completed"], verdict.done) == (False, False)
        verdict = referee.judge(rows([GOAL], 1001))
        assert (verdict.info["task_completed"], verdict.done) == (True, True)
        assert referee.reason(verdict) == "TASK COMPLETION"

    def test_leaving_starts_anew_and_completion_sticks(self):
        referee = no_gates("done_on_completion=false")
        referee.judge(rows([GOAL] * 1000))
        referee.judge(rows([AWAY], 1001))
        assert not referee.judge(rows([GOAL] * 1000, 1002)).completed
        assert referee.judge(rows([GOAL], 2002)).completed
        verdict = referee.judge(rows([AWAY], 2003))
        assert verdict.completed
        assert verdict.info["at_goal_position"] is False
        assert not verdict.done

    def test_radius_is_strict(self):
        goal = np.array(GOAL)
        east = np.array([1, 0, 0])
        inside, outside = goal + 0.1499999 * east, goal + 0.1500001 * east
        assert no_gates().judge(rows([inside])).info["at_goal_position"] is True
        assert no_gates().judge(rows([outside])).info["at_goal_position"] is False

    def test_slow_pose_source_counts_by_time(self):
        referee = no_gates()
        slow = rows([GOAL] * 201, 1, rate=100.0)
        assert not referee.judge(slow[:200]).completed
        assert referee.judge(slow[200:]).completed

    def test_mse_is_the_squared_distance(self):
        position = np.add(GOAL, [0.1, -0.2, 0.3])
        assert no_gates().judge(rows([position])).info["mse"] == pytest.approx(0.14)


class TestCollision:
    def test_codes_become_body_ids(self):
        for code, body in [(0, 6), (3, 9), (4, 2), (7, 5), (8, 0)]:
            verdict = begun().judge(rows([AWAY], contact=code))
            assert verdict.info["collision"] == (body, True)
            assert verdict.info["collision"][1] is True
            assert verdict.reward == -1000
            assert verdict.done

    def test_none(self):
        assert begun().judge(rows([AWAY])).info["collision"] == (None, False)

    def test_only_the_last_tick_ends_the_episode(self):
        step = rows([AWAY] * 3)
        step[1, TR_CONTACT] = 0
        verdict = begun().judge(step)
        assert not verdict.done
        assert not verdict.collided
        assert [e.name for e in verdict.events] == ["contact", "contact ended"]
        assert verdict.events[0].detail == "gate 0"

    def test_computed_where_the_source_knows_none(self):
        unknown = UNKNOWN_CONTACT
        assert begun().judge(rows([(0.5, -2.5, 0.3)], contact=unknown)).info["collision"] == (
            6,
            True,
        )
        assert begun().judge(rows([(1.5, 0.0, 0.5)], contact=unknown)).info["collision"] == (
            4,
            True,
        )
        # On the floor: bottom at 0.0175 is free, 1 mm is contact.
        assert not begun().judge(rows([(-0.9, -2.9, 0.03)], contact=unknown)).collided
        assert begun().judge(rows([(-0.9, -2.9, 0.0135)], contact=unknown)).info["collision"] == (
            0,
            True,
        )

    def test_does_not_end_where_the_level_says_so(self):
        assert not begun("done_on_collision=false").judge(rows([AWAY], contact=0)).done


class TestConstraints:
    def test_order_and_rounding(self):
        values = begun().judge(rows([(1.0, 2.0, 0.5)], action=0.05)).info["constraint_values"]
        low, high = FORCE_LOW - 0.05, 0.05 - FORCE_HIGH
        expected = [low] * 4 + [high] * 4 + [-4, -5, -0.6, -2, -1, -1.5]
        np.testing.assert_array_equal(values, np.round(expected, 8))

    @pytest.mark.parametrize("position", [(3.01, 0, 1), (0, -3.01, 1), (0, 0, 2.01), (0, 0, -0.11)])
    def test_leaving_the_arena(self, position):
        referee = begun()
        verdict = referee.judge(rows([position]))
        assert verdict.info["constraint_violation"] == 1
        assert verdict.done
        assert referee.reason(verdict) == "CONSTRAINT VIOLATION"

    def test_saturated_forces_do_not_violate(self):
        for force in (FORCE_LOW - 4e-9, FORCE_HIGH + 4e-9):
            assert not begun().judge(rows([AWAY], action=force)).violated
        for force in (FORCE_LOW - 6e-9, FORCE_HIGH + 6e-9):
            assert begun().judge(rows([AWAY], action=force)).violated

    def test_first_tick_without_force_costs_one_tick_later(self):
        # The first tick's action is 0: violated, done overwritten by the later ticks.
        step = rows([AWAY] * 17)
        step[0, TR_ACTION : TR_ACTION + 4] = 0.0
        referee = begun()
        first = referee.judge(step[:1])
        assert first.done
        assert first.reward == 0
        second = referee.judge(step[1:2])
        assert (second.done, second.reward) == (False, -100)
        assert referee.judge(step[2:]).reward == 0

    def test_unknown_forces_violate_nothing(self):
        verdict = begun().judge(rows([AWAY], action=np.nan))
        assert not verdict.violated
        assert np.isnan(verdict.info["constraint_values"][:8]).all()

    def test_absent_where_the_level_has_none(self):
        state_only = begun("constraints.input=false").judge(rows([AWAY], action=0.0))
        assert len(state_only.info["constraint_values"]) == 6
        assert not state_only.violated
        none = begun("constraints.input=false", "constraints.state=false").judge(rows([(9, 9, 9)]))
        assert "constraint_values" not in none.info
        assert not none.violated


class TestEnd:
    def test_time_limit(self):
        referee = begun()
        verdict = referee.judge(rows([AWAY], 16499))
        assert not verdict.done
        assert "TimeLimit.truncated" not in verdict.info
        verdict = referee.judge(rows([AWAY], 16500))
        assert verdict.done
        assert verdict.info["TimeLimit.truncated"] is True
        assert referee.reason(verdict) == "MAX EPISODE DURATION"

    def test_tumble(self):
        step = rows([AWAY])
        step[0, TR_TUMBLED] = 1.0
        referee = begun()
        verdict = referee.judge(step)
        assert verdict.done
        assert referee.reason(verdict) == "TUMBLED"

    def test_collision_is_named_before_the_rest(self):
        referee = begun()
        verdict = referee.judge(rows([(3.5, 0, 1)], 16500, contact=0))
        assert referee.reason(verdict) == "COLLISION"

    def test_a_new_episode_forgets_the_old(self):
        level = load_level("level0")
        draw = LevelRandom(level).reset()
        referee = Referee(level)
        referee.begin(draw.gates, draw.obstacles)
        pass_all(referee)
        referee.judge(rows([(9, 9, 9)], 400))
        referee.begin(draw.gates, draw.obstacles)
        verdict = referee.judge(rows([AWAY]))
        assert (verdict.gate, verdict.reward, verdict.completed) == (0, 0, False)


class TestObservation:
    def test_zeros_where_the_contract_has_them(self):
        verdict = begun().judge(rows([(1, 2, 0.5)]))
        assert isinstance(verdict.obs, list)
        assert verdict.obs == [1, 0, 2, 0, 0.5, 0, 0, 0, 0, 0, 0, 0]

    def test_learning_gets_the_true_state(self):
        step = rows([(1, 2, 0.5)])
        step[0, 11:14] = [4, 5, 6]
        step[0, 14:17] = [7, 8, 9]
        step[0, 8:11] = [0.1, 0.2, 0.3]
        state = begun().judge(step).state()
        np.testing.assert_array_equal(state, [1, 4, 2, 5, 0.5, 6, 0.1, 0.2, 0.3, 7, 8, 9])

    def test_a_step_without_poses_keeps_the_verdict(self):
        referee = begun()
        with pytest.raises(ValueError, match="at least one pose"):
            referee.judge(rows(np.empty((0, 3))))
        before = referee.judge(rows([GATES[0]], 300))
        after = referee.judge(rows(np.empty((0, 3))))
        assert after.info == before.info
        assert not after.events
