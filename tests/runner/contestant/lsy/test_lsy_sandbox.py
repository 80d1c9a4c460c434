"""Controllers of lsy_drone_racing in a process of their own."""

import json
import shutil
import subprocess

import numpy as np
import pytest

from crazyarena.errors import InputError
from crazyarena.runner.contestant.contract_lsy.dialogue import Drawing, LsyAnswer
from crazyarena.runner.contestant.sandbox import lsy, wire
from crazyarena.runner.contestant.sandbox.confine import acados_folder
from crazyarena.runner.lsy_run import LsyRun
from tests.runner.lsy_controllers import HEAD, LOG, STATE, controller


def fly(tmp_path, source, out="out", **options):
    file = tmp_path / "code" / "mine.py"
    file.parent.mkdir(exist_ok=True)
    file.write_text(source)
    options = {"sandbox": True, "seed": 1, "record": False} | options
    return LsyRun(file, "lsy/level0", out=tmp_path / out, **options).run()


def test_flies_the_same_bytes_as_in_the_process(tmp_path):
    for out, sandbox in (("one", True), ("two", False)):
        result = fly(tmp_path, STATE, out, sandbox=sandbox, record=True)
        assert result.episodes[0].time == pytest.approx(13.86, abs=0.1)
    one, two = ((tmp_path / o / "episode_000.mcap").read_bytes() for o in ("one", "two"))
    assert one == two


def test_the_seed_is_not_in_its_config(tmp_path):
    body = "raise RuntimeError(f'seed {self.seed}')"
    keep = "\n    def __init__(self, obs, info, config):\n        self.seed = config.env.seed\n"
    source = controller(body).replace("class C(Controller):\n", f"class C(Controller):{keep}")
    assert "seed -1" in fly(tmp_path, source).error


def test_a_new_object_an_episode(tmp_path):
    result = fly(tmp_path, LOG, episodes=2)
    assert [e.termination for e in result.episodes] == ["CONTROLLER FINISHED"] * 2


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ("raise ValueError('no way')", "ValueError: no way"),
        ("import os; os._exit(3)", "exit code 3"),
        ("import time; time.sleep(100)", "no answer within 1 s"),
        ("return [1.0]", "expected 13"),
    ],
)
def test_whatever_it_does_ends_its_own_trial(tmp_path, monkeypatch, body, words):
    monkeypatch.setattr(lsy, "_PATIENCE", 1.0)
    result = fly(tmp_path, controller(body), episodes=2)
    assert [e.termination for e in result.episodes] == ["CONTROLLER ERROR"]
    assert words in result.error


def test_a_load_that_fails_is_bad_input(tmp_path):
    with pytest.raises(InputError, match=r"code/mine\.py.*ZeroDivisionError"):
        fly(tmp_path, STATE + "1 / 0\n")


@pytest.mark.skipif(shutil.which("gcc") is None, reason="no compiler")
def test_finds_the_libraries_of_acados(tmp_path, monkeypatch):
    """Where the one who flies it has built them."""
    acados = tmp_path / "acados"
    (acados / "interfaces" / "acados_template").mkdir(parents=True)
    (acados / "lib").mkdir()
    (tmp_path / "a.c").write_text("double acados_twice(double x) { return 2 * x; }")
    library = acados / "lib" / "libacados.so"
    command = ["gcc", "-shared", "-fPIC", "-o", str(library), str(tmp_path / "a.c")]
    subprocess.run(command, check=True)
    body = """
import ctypes, os
f = ctypes.CDLL("libacados.so").acados_twice
f.restype, f.argtypes = ctypes.c_double, [ctypes.c_double]
raise RuntimeError(f"twice two is {f(2.0)}, in {os.environ['ACADOS_SOURCE_DIR']}")
"""
    assert "cannot open shared object" in fly(tmp_path, controller(body), "without").error
    monkeypatch.setenv("ACADOS_SOURCE_DIR", str(acados))
    assert f"twice two is 4.0, in {acados}" in fly(tmp_path, controller(body)).error


@pytest.mark.parametrize("folder", ["/", "no", "there"])
def test_other_folders_are_not_opened_for_acados(tmp_path, monkeypatch, folder):
    (tmp_path / "there" / "lib").mkdir(parents=True)
    monkeypatch.setenv("ACADOS_SOURCE_DIR", folder if folder == "/" else str(tmp_path / folder))
    assert acados_folder() is None


@pytest.mark.skipif(shutil.which("gcc") is None, reason="no compiler")
def test_code_compiled_at_run_time_and_files_beside_it(tmp_path):
    """What code generators of optimal control do."""
    (tmp_path / "code").mkdir()
    (tmp_path / "code" / "model.json").write_text(json.dumps({"k": 3}))
    body = """
import ctypes, json, subprocess
from pathlib import Path
k = json.loads((Path(__file__).parent / "model.json").read_text())["k"]
folder = Path("c_generated_code"); folder.mkdir(exist_ok=True)
(folder / "f.c").write_text(f"double f(double x) {{ return {k} * x; }}")
subprocess.run(["gcc", "-shared", "-fPIC", "-o", "f.so", "f.c"], cwd=folder, check=True)
f = ctypes.CDLL(str((folder / "f.so").resolve())).f
f.restype, f.argtypes = ctypes.c_double, [ctypes.c_double]
assert f(2.0) == 6.0
return np.zeros(13)
"""
    assert fly(tmp_path, controller(body)).error is None


OPTIMISER = """
import casadi as ca

class C(Controller):
    def __init__(self, obs, info, config):
        opti = ca.Opti()
        x = opti.variable(3)
        opti.minimize(ca.sumsqr(x - 1) + x[0] ** 4)
        opti.subject_to(x[1] >= 2)
        opti.solver("ipopt", {"print_time": False}, {"print_level": 0, "sb": "yes"})
        self.place = opti.solve().value(x)
        s = ca.SX.sym("s", 3)
        options = {"jit": True, "compiler": "shell", "jit_options": {"flags": ["-O1"]}}
        self.square = ca.Function("square", [s], [s**2], options)

    def compute_control(self, obs, info=None):
        assert abs(self.place[1] - 2) < 1e-4, self.place
        assert float(self.square([3, 0, 0])[0]) == 9.0
        return np.zeros(13)
"""
NETWORK = """
import torch
from pathlib import Path

class C(Controller):
    def __init__(self, obs, info, config):
        self.net = torch.nn.Sequential(torch.nn.Linear(13, 8), torch.nn.Tanh(),
                                       torch.nn.Linear(8, 13))
        weights = torch.load(Path(__file__).parent / "actor.ckpt", map_location="cpu")
        self.net.load_state_dict(weights)

    def compute_control(self, obs, info=None):
        seen = [obs[k] for k in ("pos", "quat", "vel", "ang_vel")]
        with torch.no_grad():
            return self.net(torch.tensor(np.concatenate(seen))).numpy()
"""
COMPILED = """
import torch

class C(Controller):
    def __init__(self, obs, info, config):
        double = torch.compile(lambda x: torch.sin(x) * 2)
        assert double(torch.zeros(3)).tolist() == [0, 0, 0]

    def compute_control(self, obs, info=None):
        return np.zeros(13)
"""
POLICY = """
from pathlib import Path
from stable_baselines3 import PPO

class C(Controller):
    def __init__(self, obs, info, config):
        self.policy = PPO.load(Path(__file__).parent / "ppo.zip", device="cpu")

    def compute_control(self, obs, info=None):
        seen = [obs[k] for k in ("pos", "quat", "vel", "ang_vel")]
        action, _ = self.policy.predict(np.concatenate(seen), deterministic=True)
        return np.concatenate([action, np.zeros(9)])
"""


@pytest.mark.skipif(shutil.which("gcc") is None, reason="no compiler")
def test_casadi_with_its_solvers_and_its_compiler(tmp_path):
    pytest.importorskip("casadi")
    assert fly(tmp_path, HEAD + OPTIMISER).error is None


def test_a_checkpoint_of_torch(tmp_path):
    torch = pytest.importorskip("torch")
    net = torch.nn.Sequential(torch.nn.Linear(13, 8), torch.nn.Tanh(), torch.nn.Linear(8, 13))
    (tmp_path / "code").mkdir()
    torch.save(net.state_dict(), tmp_path / "code" / "actor.ckpt")
    assert fly(tmp_path, HEAD + NETWORK).error is None


@pytest.mark.skipif(shutil.which("g++") is None, reason="no compiler")
def test_what_torch_compiles(tmp_path):
    pytest.importorskip("torch")
    assert fly(tmp_path, HEAD + COMPILED).error is None


def test_a_policy_of_stable_baselines3(tmp_path):
    sb3, spaces = pytest.importorskip("stable_baselines3"), pytest.importorskip("gymnasium.spaces")
    gymnasium = pytest.importorskip("gymnasium")

    class World(gymnasium.Env):
        observation_space = spaces.Box(-np.inf, np.inf, (13,), np.float32)
        action_space = spaces.Box(-1.0, 1.0, (4,), np.float32)

        def reset(self, *, seed=None, options=None):
            return np.zeros(13, np.float32), {}

    (tmp_path / "code").mkdir()
    sb3.PPO("MlpPolicy", World(), device="cpu").save(tmp_path / "code" / "ppo.zip")
    assert fly(tmp_path, HEAD + POLICY).error is None


def test_answers_and_drawings_survive_the_channel():
    points = np.arange(12.0).reshape(4, 3)
    answer = LsyAnswer(5, np.arange(4.0), drawings=[Drawing("line", points, (1, 0, 0.5, 1), 2.0)])
    back = wire.decode(wire.encode_lsy(answer))
    assert isinstance(back, LsyAnswer)
    np.testing.assert_array_equal(back.command, answer.command)
    np.testing.assert_array_equal(back.drawings[0].points, points)
    assert back.drawings[0].rgba == (1, 0, 0.5, 1)
    big = [Drawing("points", np.zeros((1000, 3)), (1, 1, 1, 1), 1.0)] * 3
    packet = wire.encode_lsy(LsyAnswer(5, np.arange(4.0), drawings=big))
    assert len(packet) <= wire.MAX_PACKET
    assert len(wire.decode(packet).drawings) == 2


@pytest.mark.parametrize("cut", [1, 30, 60])
def test_torn_packets_are_refused(cut):
    drawn = [Drawing("line", np.zeros((2, 3)), (1, 1, 1, 1), 1.0)]
    packet = wire.encode_lsy(LsyAnswer(5, np.arange(4.0), drawings=drawn))
    with pytest.raises(wire.ChannelError):
        wire.decode(packet[:-cut])
