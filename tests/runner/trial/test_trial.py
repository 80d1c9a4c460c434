"""The multi-episode loop on a world that follows a prescribed path."""

import json
import sys

import numpy as np
import pytest

from crazyarena.crazyswarm_compat import commands as cs
from crazyarena.errors import DependencyMissing
from crazyarena.levels import load_level
from crazyarena.runner.contestant.in_process import InProcess
from crazyarena.runner.contestant.submission import Submission
from crazyarena.runner.trial.trial import Trial
from tests.runner.fakes import PathWorld, controller

EMPTY = ["track.gates=[]", "track.obstacles=[]"]
GOAL = (-0.5, 2.9, 0.75)


@pytest.fixture
def fly(tmp_path):
    """Fly a submission given as source; returns (result, controller object, world)."""
    made = []
    submissions = []

    def run(source, overrides=(), path=lambda t: GOAL, level="level0", prepare=None, **options):
        file = tmp_path / "pilot.py"
        file.write_text(source)
        submission = Submission(file, tmp_path / "work")
        submissions.append(submission)
        make = submission.make
        submission.make = lambda *args: made.append(make(*args)) or made[-1]
        world = PathWorld(path)
        if prepare is not None:
            prepare(world)
        loaded = load_level(level, [*EMPTY, *overrides])
        result = Trial(loaded, InProcess(submission), world, **options).run()
        return result, made[-1], world

    yield run
    for submission in submissions:
        submission.close()


def test_one_controller_sees_all_episodes(fly):
    result, pilot, world = fly(controller(), episodes=3)
    assert [e.termination for e in result.episodes] == ["TASK COMPLETION"] * 3
    assert result.clean
    assert world.resets == 3
    firsts = [call for call in pilot.calls if call[0] == 0.0]
    assert len(firsts) == 3
    assert [call[2:] for call in firsts] == [(0, False, {})] * 3


def test_first_observation_is_the_start_and_later_ones_are_stale(fly):
    _, pilot, _ = fly(controller(), episodes=2)
    firsts = [call[1] for call in pilot.calls if call[0] == 0.0]
    assert firsts[0] == [-0.9, 0, -2.9, 0, 0.03, 0, 0, 0, 0, 0, 0, 0]
    assert firsts[1] == [*(-0.5, 0, 2.9, 0, 0.75, 0), 0, 0, 0.1, 0, 0, 0]


def test_time_is_the_step_number_times_the_period(fly):
    result, pilot, _ = fly(controller(), ["goal.position=[0, 0, 1]"], episodes=1)
    assert result.episodes[0].termination == "MAX EPISODE DURATION"
    assert result.episodes[0].steps == 990
    times = [call[0] for call in pilot.calls]
    assert times == [k * (1 / 30) for k in range(990)]
    low = [k for k, t in enumerate(times) if int(t * 30) != k]
    assert low[:6] == [31, 62, 111, 123, 124, 207]
    assert len(low) == 47
    assert result.episodes[0].flight_time == 989 * (1 / 30)


def test_success_after_the_dwell(fly):
    result, _, _ = fly(controller(), episodes=1)
    episode = result.episodes[0]
    # Completed at tick 1001, which lies in control step 60; its time is that of its start.
    assert episode.steps == 61
    assert episode.flight_time == 60 * (1 / 30)
    assert [e.name for e in episode.events] == ["goal reached", "task completed"]
    assert result.score() == {
        "qualified": True,
        "A_flight_time": 2.0,
        "B_total_time": pytest.approx(2.0),
    }


def test_commands_go_to_the_world_once_and_in_order(fly):
    source = controller(
        "k = len(self.calls) - 1\n"
        "        if k == 0: return Command.TAKEOFF, [1, 2]\n"
        "        if k == 2: return Command.NOTIFYSETPOINTSTOP, []\n"
        "        return Command.NONE, None"
    )
    _, _, world = fly(source, episodes=1)
    times = [t for t, _ in world.sent]
    assert [c for _, c in world.sent] == [cs.Takeoff(1.0, 2.0), cs.NotifySetpointsStop()]
    assert times == [0.0, pytest.approx(2 / 30)]


def test_finished_ends_the_episode(fly):
    result, _, _ = fly(
        controller("return (Command.FINISHED if time > 1 else Command.NONE), []"), episodes=2
    )
    assert [e.termination for e in result.episodes] == ["FINISHED"] * 2
    assert not result.clean
    assert result.episodes[0].steps == 31


def test_collisions_count_control_steps_and_end(fly):
    def crash(world):
        world.contact_at = {20, 100, 101, 102, 103}

    def prepare_end(world):
        world.contact_at = {50}

    # Ticks 20 and 103 lie within their control steps; 100 is the last of its step.
    result, _, _ = fly(controller(), ["done_on_collision=false"], episodes=1, prepare=crash)
    assert result.episodes[0].collisions == 1
    assert not result.clean
    result, _, _ = fly(controller(), episodes=1, prepare=prepare_end)
    assert result.episodes[0].termination == "COLLISION"
    assert result.episodes[0].steps == 3


def test_violation_and_tumble(fly):
    result, _, _ = fly(controller(), path=lambda t: (0, 0, 1 + t), episodes=1)
    assert result.episodes[0].termination == "CONSTRAINT VIOLATION"
    assert result.episodes[0].violations == 1

    def tumble(world):
        world.tumble_at = 300

    result, _, _ = fly(controller(), episodes=1, prepare=tumble)
    assert result.episodes[0].termination == "TUMBLED"


HOOKS = """
    def interStepLearn(self, action, obs, reward, done, info):
        self.calls.append(("step", action.shape, obs.shape))
    def interEpisodeLearn(self):
        self.calls.append("learn")
    def interEpisodeReset(self):
        self.calls.append("reset")
"""


def test_learning_hooks_in_the_competitions_order(fly):
    result, pilot, _ = fly(controller(extra=HOOKS), episodes=2)
    hooks = [c for c in pilot.calls if isinstance(c, str)]
    assert hooks == ["learn", "reset", "learn"]
    steps = [c for c in pilot.calls if c[0] == "step"]
    assert steps == [("step", (4,), (12,))] * sum(e.steps for e in result.episodes)
    episode = result.episodes[0]
    assert episode.interstep_learning_time > 0
    assert episode.interstep_learning_average == pytest.approx(
        episode.interstep_learning_time / episode.steps
    )


@pytest.mark.parametrize(
    ("step", "expected"),
    [
        ("raise ValueError('lost')", "ValueError: lost"),
        ("return 1 / 0", "ZeroDivisionError"),
        ("raise SystemExit", "SystemExit"),
        ("return 'TAKEOFF', [1, 2]", "expected a member of competition_utils.Command"),
        ("return Command.TAKEOFF, [float('nan'), 2]", "step 1: TAKEOFF argument 'height' is nan"),
    ],
)
def test_controller_errors_end_the_trial(fly, step, expected):
    source = controller(f"if time > 0: {step}\n        return Command.NONE, []")
    result, _, _ = fly(source, episodes=3)
    assert [e.termination for e in result.episodes] == ["CONTROLLER ERROR"]
    assert expected in result.error
    assert "step 1: " in result.error
    assert "episode.py" not in result.error
    assert result.episodes[0].steps == 1
    assert not result.clean


def test_error_in_a_hook_is_the_controllers(fly):
    extra = "\n    def interEpisodeLearn(self): raise KeyError('x')\n"
    result, _, _ = fly(controller(extra=extra), episodes=2)
    assert [e.termination for e in result.episodes] == ["CONTROLLER ERROR"]
    assert "interEpisodeLearn raised" in result.error


@pytest.mark.parametrize("where", ["in the controller", "elsewhere"])
def test_ctrl_c_keeps_what_was_flown(fly, tmp_path, where):
    import signal

    def interrupt():
        signal.raise_signal(signal.SIGINT)

    out = tmp_path / "out"
    out.mkdir()
    if where == "elsewhere":
        result, _, _ = fly(
            controller(),
            episodes=3,
            out=out,
            on_step=lambda episode, t: interrupt() if t == 1.0 else None,
        )
    else:
        source = "import signal" + controller(
            "if time == 1.0: signal.raise_signal(signal.SIGINT)\n        return Command.NONE, []"
        )
        result, _, _ = fly(source, episodes=3, out=out)
    assert [e.termination for e in result.episodes] == ["INTERRUPTED"]
    assert result.episodes[0].steps == (31 if where == "elsewhere" else 30)
    assert (out / "episode_000.mcap").is_file()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_initial_info(fly):
    source = controller(init="self.info = initial_info; self.firmware = use_firmware")
    _, pilot, _ = fly(source, level="level3", episodes=1)
    info = pilot.info
    assert pilot.firmware is True
    assert info["nominal_gates_pos_and_type"] == []
    assert info["ctrl_timestep"] == 1 / 30
    assert info["gates_and_obs_randomization"]["obstacles"].high == 0.15
    assert len(info["constraint_values"]) == 6
    assert set(info) >= {"symbolic_model", "symbolic_constraints", "urdf_dir", "pyb_client"}


def test_symbolic_model_hovers(fly):
    pytest.importorskip("casadi")
    source = controller(
        init="self.m = initial_info['symbolic_model']; "
        "self.c = initial_info.get('symbolic_constraints'); self.u = initial_info['u_reference']"
    )
    _, pilot, _ = fly(source, episodes=1)
    assert pilot.m.dt == 0.002
    np.testing.assert_allclose(np.array(pilot.m.fc_func(np.zeros(12), pilot.u)), 0, atol=1e-9)
    assert float(max(np.array(pilot.c[0](pilot.u)).ravel())) < 0


def test_symbolic_model_without_casadi(fly, monkeypatch):
    _, pilot, _ = fly(controller(init="self.info = initial_info"), episodes=1)
    monkeypatch.setitem(sys.modules, "casadi", None)
    with pytest.raises(DependencyMissing, match="casadi"):
        _ = pilot.info["symbolic_model"].x_dot
    with pytest.raises(DependencyMissing, match="casadi"):
        pilot.info["symbolic_constraints"][0](np.zeros(4))


def test_drawing_has_a_client(fly):
    pytest.importorskip("pybullet")
    source = "from competition_utils import draw_trajectory\n" + controller(
        init="draw_trajectory(initial_info, [[0, 0, 1]], [0.0] * 60, [1.0] * 60, [1.0] * 60)"
    )
    assert fly(source, episodes=1)[0].clean


def test_result_is_plain_data(fly):
    result, _, _ = fly(controller(), episodes=1)
    document = json.loads(json.dumps(result.episodes[0].as_dict()))
    assert document["termination"] == "TASK COMPLETION"
    assert document["clean"] is True
    assert document["events"][0]["event"] == "goal reached"
    assert set(document["compute_ms"]) == {"p50", "p90", "p99", "p99.9", "max", "mean"}
