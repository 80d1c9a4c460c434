"""Loading submissions: every import style, no trace left, errors that say what to do."""

import importlib.util
import os
import sys
from pathlib import Path

import numpy as np
import pytest

from crazyarena.errors import InputError
from crazyarena.runner.contestant.submission import Submission, submission_hash
from tests.runner.fakes import controller

SIMPLE = controller()


def write(folder: Path, **files: str) -> Path:
    for name, text in files.items():
        file = folder / (name.replace("__", "/") + ".py")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    return folder


@pytest.fixture
def load(tmp_path):
    opened = []

    def open_(path: Path) -> Submission:
        submission = Submission(path, tmp_path / "work")
        opened.append(submission)
        return submission

    yield open_
    for submission in opened:
        submission.close()


def flag(submission: Submission):
    return submission.make([0.0] * 12, {}).value


def with_value(imports: str, expression: str) -> str:
    return f"{imports}\n" + controller(init=f"self.value = {expression}")


class TestImports:
    def test_siblings_both_ways(self, tmp_path, load):
        folder = write(
            tmp_path / "entry",
            edit_this=with_value(
                "import helper\nfrom competition.helper import N as M\n"
                "from competition.sub.deep import D\nfrom sub.deep import D as D2",
                "(helper.N, M, D, D2)",
            ),
            helper="N = 5",
            sub__deep="D = 7",
        )
        assert flag(load(folder)) == (5, 5, 7, 7)

    def test_our_utilities_under_every_name(self, tmp_path, load):
        source = with_value(
            "from competition_utils import Command as A, PIDController, timing_step, timing_ep, "
            "plot_trajectory, draw_trajectory, thrusts\n"
            "from competition.competition_utils import Command as B",
            "(A.TAKEOFF.value, B.TAKEOFF.value)",
        )
        assert flag(load(write(tmp_path / "entry", edit_this=source))) == (2, 2)

    def test_the_submissions_own_utilities_come_first(self, tmp_path, load):
        folder = write(
            tmp_path / "entry",
            edit_this=with_value("from competition_utils import MINE", "MINE"),
            competition_utils="MINE = 'mine'",
        )
        assert flag(load(folder)) == "mine"

    def test_relative_import_with_fallback(self, tmp_path, load):
        source = with_value(
            "try:\n    from competition_utils import Command as C\n"
            "except ImportError:\n    from .competition_utils import Command as C",
            "C.LAND.value",
        )
        assert flag(load(write(tmp_path / "entry", edit_this=source))) == 3

    def test_relative_import_without_fallback(self, tmp_path, load):
        folder = write(
            tmp_path / "entry", edit_this=with_value("from .helper import N", "N"), helper="N = 5"
        )
        assert flag(load(folder)) == 5

    def test_folder_name_is_a_package(self, tmp_path, load):
        folder = write(
            tmp_path / "slalom",
            edit_this=with_value("from slalom.helper import N", "N"),
            helper="N = 5",
        )
        assert flag(load(folder)) == 5

    def test_single_file_with_data_beside_it(self, tmp_path, load):
        (tmp_path / "data.txt").write_text("42")
        source = with_value(
            "from pathlib import Path", "Path(__file__).with_name('data.txt').read_text()"
        )
        file = tmp_path / "my-racer.py"
        file.write_text(source)
        assert flag(load(file)) == "42"

    def test_a_file_named_like_a_standard_module(self, tmp_path, load):
        file = tmp_path / "random.py"
        file.write_text(SIMPLE)
        load(file)
        import random

        assert hasattr(random, "gauss")


class TestHygiene:
    def test_nothing_is_left(self, tmp_path):
        modules, path = set(sys.modules), list(sys.path)
        cwd, finders = os.getcwd(), list(sys.meta_path)
        folder = write(
            tmp_path / "entry",
            edit_this="import helper, competition.helper, sub.deep\n" + SIMPLE,
            helper="",
            sub__deep="",
        )
        with Submission(folder, tmp_path / "work"):
            assert os.getcwd() == str(tmp_path / "work")
            assert np.inf == np.inf
        assert set(sys.modules) == modules
        assert sys.path == path
        assert os.getcwd() == cwd
        assert sys.meta_path == finders
        assert not hasattr(np, "Inf")
        assert sorted(p.name for p in folder.rglob("*")) == [
            "deep.py",
            "edit_this.py",
            "helper.py",
            "sub",
        ]

    def test_names_of_two_submissions_do_not_mix(self, tmp_path, load):
        for value in (1, 2):
            folder = write(
                tmp_path / f"entry{value}",
                edit_this=with_value("import planning", "planning.N"),
                planning=f"N = {value}",
            )
            submission = load(folder)
            assert flag(submission) == value
            submission.close()

    def test_modules_of_the_same_name_come_back(self, tmp_path, load):
        import types

        mine = types.ModuleType("planning")
        sys.modules["planning"] = mine
        try:
            folder = write(
                tmp_path / "entry",
                edit_this=with_value("import planning", "planning.N"),
                planning="N = 3",
            )
            submission = load(folder)
            assert flag(submission) == 3
            submission.close()
            assert sys.modules["planning"] is mine
        finally:
            del sys.modules["planning"]

    def test_a_failed_import_cleans_up_too(self, tmp_path, load):
        modules, path = set(sys.modules), list(sys.path)
        with pytest.raises(InputError, match="ZeroDivisionError"):
            load(write(tmp_path / "entry", edit_this="import helper\n1 / 0", helper=""))
        assert set(sys.modules) == modules
        assert sys.path == path

    def test_hash_is_of_content(self, tmp_path):
        folder = write(tmp_path / "entry", edit_this=SIMPLE, helper="N = 1")
        first = submission_hash(folder)
        (folder / "__pycache__").mkdir()
        (folder / "__pycache__" / "x.pyc").write_bytes(b"1")
        assert submission_hash(folder) == first
        (folder / "helper.py").write_text("N = 2")
        assert submission_hash(folder) != first


class TestShims:
    def test_numpy_names_of_2022(self, tmp_path, load):
        source = with_value("import numpy as np", "(np.Inf, np.round_(1.26, 1), np.float_(2))")
        assert flag(load(write(tmp_path / "e", edit_this=source))) == (np.inf, 1.3, 2.0)

    def test_casadi_functions_with_one_name_twice(self, tmp_path, load):
        pytest.importorskip("casadi")
        source = with_value(
            "import casadi as ca\nx = ca.SX.sym('x')\n"
            "f = ca.Function('f', [x], [x + 1], ['X'], ['X'])\n"
            "g = ca.Function('g', [x], [x + 2], ['X'], ['X'], {'verbose': False})",
            "(float(f(1)), float(f.expand()(1)), float(g.expand('h')(1)))",
        )
        submission = load(write(tmp_path / "e", edit_this=source))
        assert flag(submission) == (2, 2, 3)
        submission.close()
        import casadi

        x = casadi.SX.sym("x")
        with pytest.raises(RuntimeError, match="Duplicate IO name"):
            casadi.Function("f", [x], [x], ["X"], ["X"])

    def test_other_casadi_errors_stay(self, tmp_path, load):
        pytest.importorskip("casadi")
        source = "import casadi as ca\nca.Function('f', [1], [2], 3, 4, 5, 6)\n" + SIMPLE
        with pytest.raises(InputError, match="importing the submission failed"):
            load(write(tmp_path / "e", edit_this=source))

    def test_rotation_matrix(self, tmp_path, load):
        pytest.importorskip("casadi")
        source = with_value(
            "from safe_control_gym.math_and_models.transformations import csRotXYZ\n"
            "import numpy as np, casadi",
            "np.array(casadi.DM(csRotXYZ(0.1, 0.2, 0.3)))",
        )
        from scipy.spatial.transform import Rotation

        expected = Rotation.from_euler("xyz", [0.1, 0.2, 0.3]).as_matrix()
        np.testing.assert_allclose(flag(load(write(tmp_path / "e", edit_this=source))), expected)

    def test_pybullet_stand_in(self, tmp_path, load, monkeypatch):
        import importlib.machinery

        find = importlib.machinery.PathFinder.find_spec
        monkeypatch.setattr(
            importlib.machinery.PathFinder,
            "find_spec",
            lambda name, *args: None if name == "pybullet" else find(name, *args),
        )
        monkeypatch.delitem(sys.modules, "pybullet", raising=False)
        source = with_value(
            "import pybullet as p\n"
            "p.loadURDF('sphere.urdf', [0, 0, 0], physicsClientId=3)\n"
            "p.addUserDebugLine([0, 0, 0], [1, 1, 1], physicsClientId=3)",
            "(p.getEulerFromQuaternion(p.getQuaternionFromEuler([0.1, -0.2, 0.3])),"
            " p.getMatrixFromQuaternion([0, 0, 0, 1]))",
        )
        angles, matrix = flag(load(write(tmp_path / "e", edit_this=source)))
        np.testing.assert_allclose(angles, [0.1, -0.2, 0.3])
        np.testing.assert_array_equal(matrix, np.eye(3).ravel())

    def test_no_window_opens(self, tmp_path, load):
        source = with_value(
            "import matplotlib, matplotlib.pyplot as plt", "matplotlib.get_backend().lower()"
        )
        assert flag(load(write(tmp_path / "e", edit_this=source))) == "agg"


class TestBadInput:
    @pytest.mark.parametrize(
        ("files", "message"),
        [
            ({}, "no edit_this.py"),
            ({"other": ""}, "it holds other.py"),
            ({"other": "class Controller"}, r"other\.py, line 1 is not valid Python: expected ':'"),
            ({"other": ""}, "derives from lsy_drone_racing.control.Controller$"),
            ({"edit_this": "x = 1"}, "no class Controller"),
            ({"edit_this": "class Pilot: pass"}, "classes found: Pilot"),
            ({"edit_this": "class Controller: pass"}, "no method cmdFirmware"),
            ({"edit_this": "def f(:"}, "not valid Python"),
            ({"edit_this": "import nowhere_to_be_found"}, "nowhere_to_be_found"),
            ({"edit_this": "raise SystemExit(0)"}, "SystemExit"),
        ],
    )
    def test_says_what_is_wrong(self, tmp_path, load, files, message):
        folder = tmp_path / "entry"
        folder.mkdir()
        with pytest.raises(InputError, match=message):
            load(write(folder, **files))

    @pytest.mark.parametrize(
        "files",
        [
            {"edit_this": "import nowhere_a"},
            {
                "edit_this": "try:\n import plan\nexcept ImportError:\n from . import plan",
                "plan": "import nowhere_a.deep",
            },
            {
                "edit_this": "try:\n import plan\nexcept ImportError:\n import other_plan as plan",
                "plan": "from sub import work",
                "sub__work": "from nowhere_a import b",
                "other_plan": "from . import plan",
            },
        ],
    )
    def test_names_the_missing_package_and_its_remedy(self, tmp_path, load, files):
        folder = tmp_path / "entry"
        with pytest.raises(InputError) as caught:
            load(write(folder, **files))
        first, _, rest = str(caught.value).partition("\n")
        assert "not installed: the package 'nowhere_a'. Install it" in first
        assert "No module named 'nowhere_a" in rest

    @pytest.mark.parametrize(
        ("imported", "words"),
        [
            ("acados_template", "set ACADOS_SOURCE_DIR"),
            ("stable_baselines3", "the package 'stable-baselines3'"),
        ],
    )
    def test_says_what_pip_calls_it_or_that_it_is_not_there(self, tmp_path, load, imported, words):
        if importlib.util.find_spec(imported) is not None:
            pytest.skip(f"{imported} is installed")
        with pytest.raises(InputError) as caught:
            load(write(tmp_path / "entry", edit_this=f"import {imported}"))
        assert words in str(caught.value).partition("\n")[0]

    def test_names_nothing_to_install_for_what_is_there(self, tmp_path, load):
        source = "try:\n import helper\nexcept ImportError:\n from numpy import nothing_like_it"
        with pytest.raises(InputError, match="nothing_like_it") as caught:
            load(write(tmp_path / "entry", edit_this=source, helper="import helper.part"))
        assert "not installed" not in str(caught.value)

    def test_missing_in_the_constructor(self, tmp_path, load):
        source = controller(init="import nowhere_a")
        submission = load(write(tmp_path / "entry", edit_this=source))
        with pytest.raises(InputError, match="not installed: the package 'nowhere_a'"):
            submission.make([0.0] * 12, {})

    def test_missing_and_not_python(self, tmp_path, load):
        with pytest.raises(InputError, match="no such file"):
            load(tmp_path / "nothing")
        file = tmp_path / "notes.txt"
        file.write_text("")
        with pytest.raises(InputError, match="not a Python file"):
            load(file)

    def test_raise_in_constructor_shows_the_line(self, tmp_path, load):
        source = controller(init="raise ValueError('no plan')")
        submission = load(write(tmp_path / "entry", edit_this=source))
        with pytest.raises(InputError, match=r"no plan") as caught:
            submission.make([0.0] * 12, {})
        assert "edit_this.py" in str(caught.value)
        assert "contestant.py" not in str(caught.value)


@pytest.mark.parametrize(
    ("files", "told"),
    [
        (
            {"edit_this.py": "import helper", "helper.py": "from edit_this import Controller"},
            "'edit_this' is a module of the submission, and was still being imported",
        ),
        (
            {"edit_this.py": "from helper import nothing", "helper.py": "x = 1"},
            "'helper' is a module of the submission, which has no such name",
        ),
        (
            {"edit_this.py": "import a", "a.py": "import b", "b.py": "from a import c"},
            "'a' is a module of the submission, and was still being imported",
        ),
    ],
)
def test_own_modules_that_fail_are_not_taken_for_packages(tmp_path, files, told):
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    with pytest.raises(InputError) as caught:
        Submission(tmp_path, tmp_path / "work")
    assert told in str(caught.value)
    assert "not installed" not in str(caught.value)
