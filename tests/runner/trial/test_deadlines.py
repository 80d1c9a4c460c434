"""Deadlines of the contestant on virtual time: what is charged, missed, sent late or given up."""

import numpy as np
import pytest

from crazyarena.crazyswarm_compat import commands as cs
from crazyarena.errors import InputError
from crazyarena.levels import load_level
from crazyarena.runner.contestant.compute import Compute, parse_compute
from crazyarena.runner.contestant.in_process import InProcess
from crazyarena.runner.contestant.interrupt import Interrupt
from crazyarena.runner.contestant.sandbox.process import Sandboxed
from crazyarena.runner.contestant.submission import Submission
from crazyarena.runner.judging.referee import Referee
from crazyarena.runner.trial.contract import Contract2022
from crazyarena.runner.trial.control_loop import ControlLoop, Deadlines, LatePolicy
from crazyarena.runner.trial.trial import Trial
from crazyarena.sim_backend.competition import CompetitionWorld
from tests.runner.fakes import PathWorld, controller

GOAL = (-0.5, 2.9, 0.75)
EMPTY = ["track.gates=[]", "track.obstacles=[]"]
COUNTING = """\
n = len(self.calls) - 1
        return Command.FULLSTATE, [[time, 0, 1], [1, 0, 0], [2, 0, 0], 0.0, [0, 0, 0]]"""


def fly(tmp_path, source, compute="free", policy=LatePolicy.HOLD, max_misses=15, keep_alive=True):
    """Fly on a prescribed path that completes level0's goal after 61 ticks."""
    file = tmp_path / "pilot.py"
    file.write_text(source)
    world = PathWorld(lambda t: GOAL)
    level = load_level("level0", EMPTY)
    with Submission(file, tmp_path / "work") as submission:
        contestant = InProcess(submission)
        contestant.make([0.0] * 12, level, np.zeros(12))
        referee = Referee(level)
        world.reset(None)
        referee.begin(np.zeros((0, 7)), np.zeros((0, 6)))
        loop = ControlLoop(
            0,
            contestant,
            world,
            referee,
            30.0,
            Deadlines(policy, max_misses, parse_compute(compute)),
            Interrupt(),
            Contract2022(level),
            keep_alive=keep_alive,
        )
        result, _ = loop.fly([0.0] * 12)
        calls = contestant._pilot._controller.calls
    return result, calls, world


def test_free_compute_is_applied_at_its_own_tick(tmp_path):
    result, calls, world = fly(tmp_path, controller(COUNTING))
    assert result.termination == "TASK COMPLETION"
    assert (result.missed_ticks, result.late_commands) == (0, 0)
    for k, (time, command) in enumerate(world.sent):
        assert time == pytest.approx(k / 30.0)
        assert command.position[0] == pytest.approx(k / 30.0)
    assert len(calls) == len(world.sent) == 61


def test_an_answer_within_its_period_is_sent_when_it_is_there(tmp_path):
    result, _, world = fly(tmp_path, controller(COUNTING), "fixed=10")
    assert result.missed_ticks == 0
    times = [time for time, _ in world.sent]
    np.testing.assert_allclose(times, np.arange(61) / 30.0 + 0.01, atol=1e-9)


def test_80_ms_miss_two_ticks_of_three(tmp_path):
    result, calls, world = fly(tmp_path, controller(COUNTING), "fixed=80")
    # Asked at 0, 3, 6, ...; ready 80 ms later, which is tick 3, 6, 9, ...
    assert [round(call[0] * 30) for call in calls] == list(range(0, 61, 3))
    assert result.missed_ticks == 41
    assert result.late_commands == 20
    assert result.termination == "TASK COMPLETION"
    late = [(round(t * 30), round(c.position[0] * 30)) for t, c in world.sent if t * 30 % 3 < 0.1]
    assert late[:3] == [(3, 0), (6, 3), (9, 6)]


def test_a_factor_makes_the_flight_machine_slower(tmp_path):
    assert Compute("measured", factor=4.0).cost(0.01) == pytest.approx(0.04)
    assert parse_compute("fixed=20", 2.0).cost(123.0) == pytest.approx(0.04)
    assert parse_compute("free", 2.0).cost(123.0) == 0.0


@pytest.mark.parametrize("text", ["fast", "fixed", "fixed=-1", "fixed=x", "fixed=1e9", ""])
def test_unknown_compute_modes_are_bad_input(text):
    with pytest.raises(InputError, match="measured, free or fixed"):
        parse_compute(text)


def test_too_many_misses_in_a_row_end_the_run(tmp_path):
    result, _, world = fly(tmp_path, controller(COUNTING), "fixed=2000", max_misses=7)
    assert result.termination == "CONTROLLER TIMEOUT"
    assert result.missed_ticks == 7
    assert "no command for 7 ticks" in result.error
    assert world.clock.now() == pytest.approx(7 / 30.0)


def slow_from(step):
    """Answers at once, but from ``step`` on takes 80 ms; needs measured compute."""
    return controller(f"import time as t\n        t.sleep(0.08 if len(self.calls) > {step} else 0)"
                      "\n        " + COUNTING)  # fmt: skip


def test_measured_time_is_charged(tmp_path):
    result, calls, _ = fly(tmp_path, slow_from(0), "measured")
    assert result.over_period == len(calls) - 1
    # Every answer takes 80 ms and more: two ticks are missed for every one that is used.
    assert result.missed_ticks >= 2 * result.late_commands
    assert result.steps == 61


@pytest.mark.parametrize(
    ("policy", "x"),
    [("hold", [0.1, 0.1]), ("extrapolate", [0.134444, 0.1711]), ("hover", [-0.5, -0.5])],
)
def test_what_a_vehicle_on_a_stream_hears_meanwhile(tmp_path, policy, x):
    _, _, world = fly(tmp_path, controller(COUNTING), "fixed=80", LatePolicy(policy))
    # The command asked for at tick 3 (x = 0.1) arrives at tick 6; 7 and 8 are filled in.
    sent = {round(t * 30): c for t, c in world.sent}
    assert sent[6].position[0] == pytest.approx(0.1)
    assert [sent[k].position[0] for k in (7, 8)] == pytest.approx(x, abs=1e-3)


def test_nothing_is_filled_in_for_high_level_commands(tmp_path):
    step = "return (Command.TAKEOFF, [1.0, 2.0]) if time == 0 else (Command.NONE, [])"
    _, _, world = fly(tmp_path, controller(step), "fixed=80")
    assert [type(c) for _, c in world.sent] == [cs.Takeoff]


def test_none_keeps_a_stream_alive(tmp_path):
    step = (
        "return (Command.FULLSTATE, [[1, 2, 3], [0]*3, [0]*3, 0, [0]*3]) if time == 0 else "
        "(Command.NONE, [])"
    )
    _, _, world = fly(tmp_path, controller(step))
    assert len(world.sent) == 61
    _, _, world = fly(tmp_path, controller(step), keep_alive=False)
    assert len(world.sent) == 1


def test_learning_is_charged_with_the_next_command(tmp_path):
    learn = (
        "\n    def interStepLearn(self, action, obs, reward, done, info):\n"
        "        import time as t\n        t.sleep(0.05)\n"
    )
    result, _, _ = fly(tmp_path, controller(COUNTING, extra=learn), "measured")
    assert result.interstep_learning_time > 0.05 * 10
    assert result.missed_ticks > 0


def trial(tmp_path, make, compute, out):
    level = load_level("level1")
    world = CompetitionWorld(level.control_frequency)
    out.mkdir()
    rows = []
    contestant = make()
    try:
        result = Trial(
            level,
            contestant,
            world,
            deadlines=Deadlines(compute=parse_compute(compute)),
            episodes=1,
            out=out,
            on_episode=lambda result, recorder, track: rows.append(np.array(recorder.states)),
        ).run()
    finally:
        contestant.close()
        world.close()
    return result.episodes[0], rows[0], (out / "episode_000.mcap").read_bytes()


STRAIGHT = """\
z = min(0.03 + 0.5 * time, 1.0)
        return Command.FULLSTATE, [[-0.9, -2.9 + 0.1 * time, z], [0, 0.1, 0], [0]*3, 0.0, [0]*3]"""


@pytest.mark.parametrize("compute", ["free", "fixed=50"])
def test_a_sandboxed_flight_repeats_to_the_bit(tmp_path, compute):
    file = tmp_path / "pilot.py"
    file.write_text(controller(STRAIGHT))
    runs = [
        trial(tmp_path, lambda: Sandboxed(file), compute, tmp_path / f"out{i}") for i in range(2)
    ]
    assert runs[0][2] == runs[1][2]


def test_with_free_compute_the_process_makes_no_difference(tmp_path):
    file = tmp_path / "pilot.py"
    file.write_text(controller(STRAIGHT))
    sandboxed, rows, _ = trial(tmp_path, lambda: Sandboxed(file), "free", tmp_path / "a")
    level = load_level("level1")
    plain = []
    with Submission(file, tmp_path / "work") as submission:
        result = Trial(
            level,
            InProcess(submission),
            CompetitionWorld(level.control_frequency),
            episodes=1,
            keep_states=True,
            on_episode=lambda result, recorder, draw: plain.append(np.array(recorder.states)),
        ).run()
    np.testing.assert_array_equal(rows, plain[0])
    a, b = sandboxed, result.episodes[0]
    for name in ("termination", "flight_time", "steps", "reward", "collisions", "violations"):
        assert getattr(a, name) == getattr(b, name), name
