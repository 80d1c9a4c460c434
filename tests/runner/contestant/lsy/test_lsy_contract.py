"""The contract of lsy_drone_racing: found by the file, called in order, gone afterwards."""

import importlib.util
import json
import sys
from pathlib import Path

import numpy as np
import pytest

from crazyarena.errors import CommandError, InputError
from crazyarena.runner.contestant.contract_lsy.attribute_dict import attribute_dict, level_config
from crazyarena.runner.contestant.contract_lsy.command_check import checked_command
from crazyarena.runner.contestant.contract_lsy.submission import (
    LsySubmission,
    bundle_root,
    controller_class,
    find_controller,
)
from crazyarena.runner.lsy_run import LsyRun
from crazyarena.runner.trial.lsy_episode import hints
from tests.runner.lsy_controllers import ATTITUDE, HEAD, LOG, STATE, controller


@pytest.fixture(autouse=True)
def _leaves_no_trace(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    before = set(sys.modules), list(sys.path), list(sys.meta_path), Path.cwd()
    yield
    names = {"controller", "lsy_drone_racing", "crazyflow", "helper"}
    # What is really installed stays, as any other library does.
    names |= {n for n in ("drone_models", "gymnasium") if importlib.util.find_spec(n) is None}
    assert not {n.partition(".")[0] for n in set(sys.modules) - before[0]} & names
    assert (list(sys.path), list(sys.meta_path), Path.cwd()) == before[1:]


def fly(tmp_path, source, *overrides, level="lsy/level0", name="mine.py", **options):
    file = tmp_path / name
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(source)
    options = {"seed": 1, "out": tmp_path / "out", "record": False} | options
    return LsyRun(file, level, overrides, **options).run()


def test_the_published_example_takes_its_published_time(tmp_path):
    result = fly(tmp_path, STATE)
    episode = result.episodes[0]
    assert episode.termination == "GATES PASSED"
    assert episode.success
    assert (episode.gates_passed, episode.gates) == (4, 4)
    assert episode.time == pytest.approx(13.86, abs=0.1)
    # The run ends one step after the last gate, and its own last step is not counted.
    assert episode.time == pytest.approx(episode.gate_times[-1])


def test_order_of_calls_observation_and_config(tmp_path):
    result = fly(tmp_path, LOG, episodes=2)
    assert [e.termination for e in result.episodes] == ["CONTROLLER FINISHED"] * 2
    lines = [json.loads(x) for x in (tmp_path / "out/work/log.jsonl").read_text().splitlines()]
    steps = ["compute", "step"] * 3
    assert [x[0] for x in lines] == [
        [f"made {i}", *steps, "episode_callback", "episode_reset"] for i in (1, 2)
    ]
    f32, shapes = "float32", lines[0][1]
    assert shapes == {
        "pos": [[3], f32], "vel": [[3], f32], "quat": [[4], f32], "ang_vel": [[3], f32],
        "target_gate": [[], "int32"], "n_gates_passed": [[], "int32"],
        "gate_sequence": [[4], "int32"], "gate_sequence_direction": [[4], "int32"],
        "race_progress": [[], "int32"], "target_gate_reverse": [[], "bool"],
        "gates_pos": [[4, 3], f32], "gates_quat": [[4, 4], f32], "gates_visited": [[4], "bool"],
        "obstacles_pos": [[4, 3], f32], "obstacles_visited": [[4], "bool"],
    }  # fmt: skip
    both = "first_principles"
    assert lines[0][2] == [50, [0.5, 0.25, 0.7], None, both, both, "state_controller.py"]
    assert lines[0][3] == {}


def test_attitude_mode_flies_from_the_floor(tmp_path, capsys):
    result = fly(tmp_path, ATTITUDE, "env.control_mode=attitude")
    assert result.episodes[0].termination == "CONTROLLER FINISHED"
    place = [float(x) for x in capsys.readouterr().out.split("at ")[1].split()]
    assert place == pytest.approx([-1.5, 0.75, 1.01], abs=0.1)


def test_who_forgets_step_callback_is_told(tmp_path):
    episode = fly(tmp_path, controller("return np.zeros(13)")).episodes[0]
    assert (episode.termination, episode.steps, episode.time) == ("CONTROLLER FINISHED", 1, 0.0)
    assert any("step_callback answers True" in note for note in episode.notes)
    assert not any("slow" in note for note in episode.notes)


def test_who_thinks_longer_than_a_step_is_told():
    told = hints("GATES PASSED", 40, [0.025] * 40, 50)
    assert told == [
        "slow: a step takes 25 ms, and has 20; in an arena its commands would come late"
    ]
    assert hints("GATES PASSED", 40, [*[0.001] * 39, 3.0], 50) == []
    assert hints("CONTROLLER ERROR", 0, [], 50) == []


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ("raise RuntimeError('lost')", "RuntimeError: lost"),
        ("return np.zeros(4)", r"shape \[4\]; expected 13"),
        ("return np.full(13, np.nan)", "not finite"),
        ("return np.zeros(4)", "--set env.control_mode=attitude"),
        ("return 'up'", "returned str"),
        ("import sys; sys.exit(3)", "SystemExit"),
    ],
)
def test_failures_end_the_trial_with_their_reason(tmp_path, body, words):
    result = fly(tmp_path, controller(body), episodes=3)
    assert [e.termination for e in result.episodes] == ["CONTROLLER ERROR"]
    assert not result.clean
    with pytest.raises(AssertionError, match=words):
        raise AssertionError(result.error)


def test_neighbours_import_as_themselves_and_as_part_of_the_package(tmp_path):
    folder = tmp_path / "repo" / "lsy_drone_racing" / "control"
    folder.mkdir(parents=True)
    (folder / "helper.py").write_text("VALUE = 5")
    (folder.parent / "planning.py").write_text("def plan(): return 7")
    (folder / "__init__.py").write_text("raise ImportError('the real one wants a simulator')")
    (folder / "gains.txt").write_text("0.25")
    source = controller(
        "assert float((Path(__file__).parent / 'gains.txt').read_text()) == 0.25\n"
        "assert (helper.VALUE, VALUE, plan()) == (5, 5, 7)\nreturn np.zeros(13)",
        imports="from pathlib import Path\nimport helper\n"
        "from lsy_drone_racing.control.helper import VALUE\n"
        "from lsy_drone_racing.planning import plan\n",
    )
    result = fly(tmp_path, source, name="repo/lsy_drone_racing/control/mine.py")
    assert result.error is None
    assert bundle_root(folder / "mine.py") == folder.parent


def test_all_names_of_the_contract_resolve(tmp_path):
    imports = """
import gymnasium
from gymnasium import spaces
from crazyflow import Sim
from crazyflow.constants import GRAVITY, MASS
from drone_models.core import load_params
from drone_models.so_rpy import symbolic_dynamics_euler
from drone_models.utils import rotation
from lsy_drone_racing.utils import draw_line, load_config, load_controller
from lsy_drone_racing.control.controller import Controller as Base
"""
    body = """
assert Base is Controller and MASS == load_params("first_principles", "cf2x_T350")["mass"]
q = np.array([0.1, 0.2, 0.3, 0.9]); q /= np.linalg.norm(q)
w = np.array([0.4, -0.5, 0.6])
assert np.allclose(rotation.rpy_rates2ang_vel(q, rotation.ang_vel2rpy_rates(q, w)), w)
box = spaces.Box(-1.0, 1.0, shape=(3,))
assert box.shape == (3,) and box.contains(box.sample()) and spaces.Discrete(4).sample() < 4
return np.zeros(13)
"""
    result = fly(tmp_path, controller(body, imports=imports), "sim.drone_model=cf2x_T350")
    assert result.error is None


def test_symbolic_model_agrees_with_its_equations(tmp_path):
    pytest.importorskip("casadi")
    body = """
import casadi as cs
from drone_models.core import load_params
from drone_models.so_rpy import symbolic_dynamics_euler
p = load_params("so_rpy", "cf21B_500")
names = "mass gravity_vec J J_inv acc_coef cmd_f_coef rpy_coef rpy_rates_coef cmd_rpy_coef"
change, x, u, y = symbolic_dynamics_euler(**{k: p[k] for k in names.split()})
f = cs.Function("f", [x, u], [change])
hover = p["mass"] * 9.81 / p["cmd_f_coef"]
rest = np.array(f(np.zeros(12), [0, 0, 0, hover])).ravel()
assert np.abs(rest).max() < 1e-12
tilted = np.zeros(12); tilted[4] = 0.1
assert float(f(tilted, [0, 0, 0, hover])[6]) > 0.9
return np.zeros(13)
"""
    assert fly(tmp_path, controller(body)).error is None


def test_found_by_the_file(tmp_path):
    ours = tmp_path / "edit_this.py"
    ours.write_text("class Controller:\n    def cmdFirmware(self): pass\n")
    theirs = tmp_path / "theirs.py"
    theirs.write_text(STATE)
    assert find_controller(ours) is None
    assert find_controller(theirs) == theirs
    assert find_controller(tmp_path) is None  # a folder with edit_this.py is of 2022
    ours.unlink()
    assert find_controller(tmp_path) == theirs
    (tmp_path / "more.py").write_text(STATE)
    with pytest.raises(InputError, match=r"more\.py, theirs\.py"):
        find_controller(tmp_path)
    assert find_controller(tmp_path / "none.py") is None


@pytest.mark.parametrize(
    ("source", "words"),
    [
        (STATE + "\nclass Second(Follower):\n    pass\n", "Follower, Second"),
        (HEAD + "\nclass A(Controller):\n    pass\n", "abstract"),
        (HEAD + "\nimport not_there\nclass A(Controller):\n    pass\n", "not_there"),
        ("x = 1\n", "derives from"),
        (
            STATE + "\nclass Second(Follower)\n",
            r"mine\.py, line \d+ is not valid Python: expected ':'",
        ),
    ],
)
def test_what_cannot_be_loaded_is_refused_with_the_reason(tmp_path, source, words):
    with pytest.raises(InputError, match=words):
        fly(tmp_path, source)


def test_an_imported_helper_class_does_not_count(tmp_path):
    (tmp_path / "base.py").write_text(HEAD + "\nclass Base(Controller):\n    pass\n")
    source = (
        HEAD
        + "from base import Base\n\nclass Mine(Base, Controller):\n"
        + "    def compute_control(self, obs, info=None):\n        return np.zeros(13)\n"
    )
    assert fly(tmp_path, source).error is None


_BASE = (
    HEAD
    + """
class Base(Controller):
    def compute_control(self, obs, info=None):
        return self.command()
"""
)
_OWN = """
class Mine({}):
    def command(self):
        return [0.0] * 13
"""


@pytest.mark.parametrize(
    ("files", "imports", "base"),
    [
        ({"base": _BASE}, "from base import Base", "Base"),
        ({"base": _BASE}, "from lsy_drone_racing.control.base import Base as Kind", "Kind"),
        ({"base": _BASE}, "import base", "base.Base"),
        ({"base": _BASE}, "from lsy_drone_racing.control import base", "base.Base"),
        ({"base": _BASE}, "from base import *", "Base"),
        ({"base": _BASE, "more": "from base import Base\nclass Upper(Base):\n    pass\n"},
         "from more import Upper", "Upper"),
        ({"base": "import mine\n" + _BASE}, "from base import Base", "Base"),
        ({}, "from lsy_drone_racing import control", "control.Controller"),
    ],
)  # fmt: skip
def test_a_controller_whose_base_stands_beside_it_is_found(tmp_path, files, imports, base):
    folder = tmp_path / "submission"
    folder.mkdir()
    for name, text in files.items():
        (folder / f"{name}.py").write_text(text)
    mine = folder / "mine.py"
    mine.write_text(imports + "\n" + _OWN.format(base))
    assert find_controller(mine) == mine
    assert find_controller(folder) == mine
    assert controller_class(mine) == "Mine"
    if files and "import mine" not in files["base"]:
        assert LsyRun(folder, "lsy/level0", seed=1).run().error is None


def test_who_only_uses_another_controller_is_none_of_its_kind(tmp_path):
    one, two = tmp_path / "one.py", tmp_path / "two.py"
    one.write_text(STATE)
    two.write_text("import one\n" + HEAD + "\nclass Mine(Controller):\n    pass\n")
    with pytest.raises(InputError, match=r"one\.py, two\.py"):
        find_controller(tmp_path)
    two.write_text("import one\n\nclass Helper:\n    pass\n")
    assert find_controller(tmp_path) == one


def test_a_file_may_be_written_in_another_encoding(tmp_path):
    file = tmp_path / "mine.py"
    source = "# coding: latin-1\n# Z\u00fcrich\nfrom lsy_drone_racing import control\n"
    file.write_bytes((source + "class A(control.Controller):\n    pass\n").encode("latin-1"))
    assert find_controller(file) == file


def test_names_are_gone_after_a_failed_load(tmp_path):
    file = tmp_path / "bad.py"
    file.write_text(HEAD + "1 / 0\n")
    with pytest.raises(InputError, match="ZeroDivisionError"):
        LsySubmission(file, tmp_path, "cf21B_500")


def test_drawings_are_recorded_and_their_failures_only_told(tmp_path):
    from mcap.reader import make_reader

    def scenes(folder, episode=0):
        with open(folder / f"episode_00{episode}.mcap", "rb") as stream:
            return [json.loads(m.data) for _, _, m in make_reader(stream).iter_messages(["/scene"])]

    assert fly(tmp_path, STATE, record=True).clean
    drawn = scenes(tmp_path / "out")
    assert len(drawn[0]["entities"]) == 8
    line = drawn[1]["entities"][0]["lines"][0]
    assert len(line["points"]) == 50
    assert line["color"] == {"r": 0.0, "g": 1.0, "b": 0.0, "a": 1.0}
    assert drawn[1]["entities"][0]["spheres"][0]["size"]["x"] == 0.04
    broken = STATE.replace("draw_line(sim", "raise ValueError; draw_line(sim")
    assert fly(tmp_path, broken, record=True, out=tmp_path / "second").clean
    assert len(scenes(tmp_path / "second")) == 1
    # What failed in one episode is tried again by the controller of the next.
    once = (
        "global DRAWN; DRAWN += 1\n        if DRAWN == 1: raise ValueError\n        draw_line(sim"
    )
    source = STATE.replace("class F", "DRAWN = 0\n\nclass F").replace("draw_line(sim", once)
    assert fly(tmp_path, source, record=True, out=tmp_path / "third", episodes=2).clean
    assert len(scenes(tmp_path / "third")) == 1
    assert len(scenes(tmp_path / "third", 1)) > 50


def test_config_is_a_dictionary_with_attributes():
    config = attribute_dict({"a": {"b": [{"c": 1}]}, "items": 3})
    assert config.a.b[0].c == 1
    assert config["items"] == 3
    assert {**config.a} == {"b": [{"c": 1}]}
    config.a.d = 5
    assert config.to_dict() == {"a": {"b": [{"c": 1}], "d": 5}, "items": 3}
    with pytest.raises(AttributeError, match="it has a, items"):
        _ = config.nothing
    assert level_config({"sim": {"dynamics": "so_rpy"}}).sim.physics == "so_rpy"
    bare = level_config({"env": {"track": {"gates": [{}, {}]}}})
    assert (bare.sim.drone_model, bare.sim.physics) == ("cf21B_500", "first_principles")
    assert (bare.env.freq, bare.env.sensor_range, bare.env.track.gate_order) == (50, 0.5, [1, 2])


@pytest.mark.parametrize("size", [4, 13])
def test_commands_are_checked(size):
    given = np.arange(size, dtype=np.float32)
    for answer in (given, given.tolist(), given.reshape(1, size)):
        np.testing.assert_array_equal(checked_command(answer, size, 0), given)
    for bad in (given[1:], [None] * size, [[1], [2, 3]], {}, np.full(size, np.inf)):
        with pytest.raises(CommandError, match="step 7"):
            checked_command(bad, size, 7)


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (None, "returned nothing.*end with a return"),
        (np.zeros(13, complex), "complex numbers.*np.real"),
        ([0.0] * 12 + [1j], "complex numbers"),
        ([0.0] * 9 + [float("nan")] + [0.0] * 3, r"entry 9 \(yaw\) is nan"),
        (np.ma.masked_all(13), "not finite"),
        (np.zeros(4), r"state mode; 4 numbers want --set env\.control_mode=attitude"),
    ],
)
def test_a_bad_command_is_told_with_what_to_do(answer, words):
    with pytest.raises(CommandError, match=words):
        checked_command(answer, 13, 0)
