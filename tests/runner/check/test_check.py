"""``crazyarena new`` and ``crazyarena check``: a start that flies, and mistakes that are named."""

import subprocess
import sys

import pytest
from typer.testing import CliRunner

from crazyarena.errors import InputError
from crazyarena.runner.check.source import findings
from crazyarena.runner.check.submission import check
from crazyarena.runner.cli import make_app
from crazyarena.runner.contestant.shipped import make
from tests.runner.fakes import controller
from tests.runner.lsy_controllers import ATTITUDE, HEAD

HOVER = "if time == 0: return Command.TAKEOFF, [0.75, 1.0]\n        return Command.NONE, []"


def lines(found):
    return {line.name: line for line in found}


@pytest.mark.parametrize("contract", ["2022", "lsy"])
def test_what_new_makes_passes_its_own_check(tmp_path, monkeypatch, contract):
    monkeypatch.chdir(tmp_path)
    app = make_app()
    made = CliRunner().invoke(app, ["new", "my_controller", "--contract", contract])
    assert made.exit_code == 0, made.output
    assert (tmp_path / "my_controller" / "README.md").is_file()
    checked = CliRunner().invoke(app, ["check", "my_controller"])
    assert checked.exit_code == 0, checked.output
    assert "3 of 3 completed" in checked.output
    assert "wrong" not in checked.output
    for name in ("contract", "repeatable", "in time", "behind walls"):
        assert name in checked.output


@pytest.mark.slow
@pytest.mark.parametrize("contract", ["2022", "lsy"])
def test_the_test_that_new_makes_passes(tmp_path, contract):
    make(tmp_path / "mine", contract)
    run = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:randomly"],
        cwd=tmp_path / "mine", capture_output=True, text=True, timeout=240, check=False,
    )  # fmt: skip
    assert run.returncode == 0, run.stdout + run.stderr


def test_level_2_is_not_completed_without_looking(tmp_path):
    make(tmp_path / "mine", "2022")
    line = lines(check(tmp_path / "mine", "level2"))["level2"]
    assert line.works is False
    assert "COLLISION with gate" in line.found
    assert "--level level2 --seed 7" in line.remedy


@pytest.mark.parametrize(
    ("name", "message"),
    [("my-controller", "letters, digits"), ("class", "letters, digits"), ("there", "is there")],
)
def test_new_refuses_what_cannot_be(tmp_path, name, message):
    (tmp_path / "there").mkdir()
    with pytest.raises(InputError, match=message):
        make(tmp_path / name, "2022")


def test_need_names_the_levels_of_the_contract(tmp_path):
    make(tmp_path / "mine", "lsy")
    with pytest.raises(InputError, match=r"expected one of lsy/level0, .*lsy/level3"):
        check(tmp_path / "mine", "level0")


def test_a_controller_that_answers_with_attitudes_and_inherits_how(tmp_path):
    (tmp_path / "base.py").write_text(ATTITUDE)
    mine = tmp_path / "mine.py"
    mine.write_text("from base import Hover\n\nclass Mine(Hover):\n    pass\n")
    wrong = lines(check(mine))
    assert "--set env.control_mode=attitude" in wrong["lsy/level0"].found
    found = lines(check(mine, overrides=["env.control_mode=attitude"]))
    assert "class Mine" in found["contract"].found
    assert "CONTROLLER FINISHED" in found["lsy/level0"].found
    assert found["lsy/level0"].remedy.endswith("--episodes 3 --set env.control_mode=attitude")


def entry(tmp_path, source):
    file = tmp_path / "edit_this.py"
    file.write_text(source)
    return tmp_path


@pytest.mark.parametrize(
    ("source", "name", "told"),
    [
        ("class Controller:\n    def __init__(self, o, i, u, verbose): pass", "contract",
         "no method cmdFirmware"),
        ("class Controller:\n    def __init__(self, o, i, use_firmware): pass\n"
         "    def cmdFirmware(self, time, obs, reward, done, info): pass",
         "contract", "line 2: __init__ does not take verbose="),
        ("class Controller:\n    def __init__(self, o, i, u, verbose): pass\n"
         "    def cmdFirmware(self, time, obs): pass",
         "contract", "line 3: cmdFirmware takes 2 arguments, 5 are given"),
        ("class Controller:\n    def __init__(self, o, i, u, verbose): pass\n"
         "    def cmdFirmware(self, time, obs, reward, done, info, more): pass",
         "contract", "needs 6 arguments, 5 are given"),
        ("import time as t\nclass Controller:\n    def __init__(self, o, i, u, verbose): pass\n"
         "    def cmdFirmware(self, time, obs, reward, done, info): t.sleep(1)",
         "clock", "edit_this.py:4: t.sleep() in cmdFirmware"),
        ("from time import perf_counter\nclass Controller:\n"
         "    def __init__(self, o, i, u, verbose): pass\n"
         "    def cmdFirmware(self, time, obs, reward, done, info): perf_counter()",
         "clock", "edit_this.py:4: perf_counter() in cmdFirmware"),
        ("PATH = '/home/me/gains.npz'\nclass Controller:\n"
         "    def __init__(self, o, i, u, verbose): pass\n"
         "    def cmdFirmware(self, time, obs, reward, done, info): pass",
         "paths", "edit_this.py:1: /home/me/gains.npz"),
    ],
)  # fmt: skip
def test_mistakes_that_can_be_read(tmp_path, source, name, told):
    line = lines(findings(entry(tmp_path, source), "2022"))[name]
    assert line.works is not True
    assert told in line.found
    assert line.remedy


@pytest.mark.parametrize(
    "head",
    [
        "def __init__(self, initial_obs, initial_info, use_firmware=False, buffer_size=100, "
        "verbose=False): pass",
        "def __init__(self, *arguments, **options): pass",
        "def __init__(self, o, i, use_firmware, *, verbose): pass",
    ],
)
def test_all_forms_of_the_contract_are_good(tmp_path, head):
    source = (
        f"import time\nclass Controller:\n    {head}\n"
        "    def cmdFirmware(self, time, obs, reward=None, done=None, info=None): pass\n"
        "    def plan(self): return time.perf_counter()"
    )
    assert [f.works for f in findings(entry(tmp_path, source), "2022")] == [True]


def test_no_controller_and_no_python(tmp_path):
    with pytest.raises(InputError, match="no class Controller"):
        list(findings(entry(tmp_path, "x = 1"), "2022"))
    with pytest.raises(InputError, match="not valid Python"):
        list(findings(entry(tmp_path, "x = ("), "2022"))


def test_mistakes_that_show_in_flight(tmp_path):
    step = (
        "print('x' * 100000)\n"
        "        import os\n"
        "        self.n = getattr(self, 'n', 0) + 1\n"
        "        rise = min(0.03 + 0.5 * time, 0.8) + 1e-3 * os.urandom(1)[0] / 255\n"
        "        if self.n == 20: return Command.LAND, [0.0, 2.0]\n"
        "        start = [-0.9, -2.9, rise]\n"
        "        return Command.FULLSTATE, [start, [0]*3, [0]*3, 0.0, [0]*3]"
    )
    found = lines(check(entry(tmp_path, controller(step))))
    assert found["repeatable"].works is None
    assert "default_rng" in found["repeatable"].remedy
    assert found["prints"].works is None
    assert "right after FULLSTATE" in found["hand-over"].found
    assert found["level0"].works is False


def test_what_depends_on_its_surroundings_fails_behind_walls(tmp_path):
    secret = tmp_path / "gains.txt"
    secret.write_text("1.0")
    folder = tmp_path / "mine"
    make(folder, "2022")
    text = (folder / "edit_this.py").read_text()
    read = f"        open({str(secret)!r}).read()\n        self.start ="
    (folder / "edit_this.py").write_text(text.replace("        self.start =", read, 1))
    line = lines(check(folder))["behind walls"]
    assert line.works is False
    assert "own folder" in line.remedy


def test_a_controller_that_fails_is_told(tmp_path):
    found = lines(check(entry(tmp_path, controller("raise ValueError('lost')"))))
    assert found["level0"].works is False
    assert "ValueError: lost" in found["level0"].found
    assert "repeatable" not in found


def test_check_says_once_why_it_failed_in_lsy_drone_racings_simulation(tmp_path):
    source = HEAD + "class A(Controller):\n    def compute_control(self, obs, info=None):\n"
    source += "        return {}\n    def step_callback(self, *told):\n        return False\n"
    file = tmp_path / "mine.py"
    file.write_text(source.format("np.zeros(13)"))
    line = lines(check(file))["lsy/level0"]
    assert line.works is False
    assert "FLOOR: came down away from its start at" in line.found
    file.write_text(source.format("np.zeros(4)"))
    line = lines(check(file))["lsy/level0"]
    assert line.found.count("returned numbers of shape [4]") == 1
