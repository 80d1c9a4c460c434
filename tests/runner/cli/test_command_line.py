"""The command line as a user meets it: exit codes, messages, files, repeatability."""

import json
import subprocess
import sys

import pytest
from typer.testing import CliRunner

from crazyarena.runner.cli import make_app
from tests.runner.fakes import controller

HOVER = controller(
    "if time == 0: return Command.TAKEOFF, [0.75, 1.0]\n        return Command.NONE, []"
)
# The goal lies above the start: reaching it needs nothing but a take-off.
EASY = [
    "--set", "track.gates=[]", "--set", "track.obstacles=[]",
    "--set", "goal.position=[-0.9, -2.9, 0.75]", "--set", "goal.hold=0.2",
    # The first tick's missing rotor force is a violation only of that tick.
]  # fmt: skip


@pytest.fixture
def cli(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def run(*arguments):
        return CliRunner().invoke(make_app(), [str(a) for a in arguments])

    return run


@pytest.fixture
def pilot(tmp_path):
    file = tmp_path / "pilot.py"
    file.write_text(HOVER)
    return file


def test_help_lists_the_commands(cli):
    shown = cli("--help")
    assert shown.exit_code == 0
    for command in ("dry-run", "export", "levels"):
        assert command in shown.output


def test_help_does_not_import_what_is_slow():
    code = (
        "import sys\n"
        "from crazyarena.runner.cli import make_app\n"
        "make_app()\n"
        "print(sorted({'numba', 'numpy', 'matplotlib', 'pydantic', 'mcap', 'casadi', 'pybullet'}"
        " & set(sys.modules)))"
    )
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert shown.stdout.strip() == "[]"


def test_clean_flight_exits_0_and_writes_its_results(cli, pilot, tmp_path):
    shown = cli("dry-run", pilot, *EASY, "--episodes", 2, "--out", "res")
    assert shown.exit_code == 0, shown.output
    out = tmp_path / "res"
    assert sorted(p.name for p in out.iterdir()) == [
        "episode_000.mcap",
        "episode_000.png",
        "episode_001.mcap",
        "episode_001.png",
        "report.html",
        "result.json",
    ]
    assert "report.html" in shown.output
    assert "2 of 2 episodes clean" in (out / "report.html").read_text()
    assert (out / "episode_000.png").read_bytes()[:4] == b"\x89PNG"
    result = json.loads((out / "result.json").read_text())
    assert [e["termination"] for e in result["episodes"]] == ["TASK COMPLETION"] * 2
    assert result["episodes"][0]["files"] == {
        "recording": "episode_000.mcap",
        "figure": "episode_000.png",
    }
    assert result["score"]["qualified"] is True
    assert result["provenance"]["seed"] == 1337
    assert len(result["provenance"]["submission_sha256"]) == 64
    # Once more by the same seed: the same bytes.
    assert cli("dry-run", pilot, *EASY, "--episodes", 2, "--out", "again").exit_code == 0
    for name in ("episode_000.mcap", "episode_001.mcap"):
        assert (out / name).read_bytes() == (tmp_path / "again" / name).read_bytes()


def test_seed_decides_the_disturbances(cli, pilot, tmp_path):
    flights = []
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        arguments = [*EASY, "--episodes", 1, "--seed", seed, "--out", name, "--no-figure"]
        cli("dry-run", pilot, "--level", "level1", *arguments)
        flights.append((tmp_path / name / "episode_000.mcap").read_bytes())
    assert flights[0] == flights[1]
    assert flights[0] != flights[2]


def test_failed_flight_exits_1(cli, pilot, tmp_path):
    shown = cli(
        "dry-run", pilot, "--episodes", 1, "--out", "r", "--no-record", "--no-figure",
        "--set", "episode_length=2.0",
    )  # fmt: skip
    assert shown.exit_code == 1
    assert "MAX EPISODE DURATION" in shown.output
    names = sorted(p.name for p in (tmp_path / "r").iterdir())
    assert names == ["report.html", "result.json"]


def test_doing_nothing_is_a_collision_with_the_ground(cli, tmp_path):
    (tmp_path / "idle.py").write_text(controller())
    shown = cli("dry-run", "idle.py", "--out", "r", "--no-figure")
    assert shown.exit_code == 1
    episodes = json.loads((tmp_path / "r" / "result.json").read_text())["episodes"]
    assert len(episodes) == 5  # each is judged, the next one flies all the same
    for episode in episodes:
        assert episode["termination"] == "COLLISION"
        assert episode["steps"] == 3
        # The first tick has no rotor force; its penalty comes a tick later, unseen.
        assert episode["events"][0]["event"] == "constraint violated"
        assert episode["violations"] == 0
        assert episode["reward"] == -1000


def test_figure_without_recording(cli, pilot, tmp_path):
    assert cli("dry-run", pilot, *EASY, "--episodes", 1, "--out", "r", "--no-record").exit_code == 0
    names = sorted(p.name for p in (tmp_path / "r").iterdir())
    assert names == ["episode_000.png", "report.html", "result.json"]


@pytest.mark.parametrize(
    ("step", "message"),
    [
        ("raise ValueError('lost')", "ValueError: lost"),
        ("return 'UP', []", "expected a member of competition_utils.Command"),
        ("return Command.TAKEOFF, [float('nan'), 1]", "argument 'height' is nan"),
    ],
)
def test_controller_error_exits_1_and_says_why(cli, tmp_path, step, message):
    (tmp_path / "edit_this.py").write_text(controller(step))
    shown = cli("dry-run", tmp_path, "--episodes", 1, "--out", tmp_path / "r", "--no-figure")
    assert shown.exit_code == 1
    assert message in shown.output
    result = json.loads((tmp_path / "r" / "result.json").read_text())
    assert result["episodes"][0]["termination"] == "CONTROLLER ERROR"
    assert message in result["episodes"][0]["error"]
    assert (tmp_path / "r" / "episode_000.mcap").is_file()


LEVEL = """\
start: {position: [0, 0, 0.03]}
goal: {position: [0, 0, 1]}
track:
  gates: [{x: GATE_X, y: 0, type: tall}]
"""


@pytest.mark.parametrize(
    ("files", "arguments", "message"),
    [
        ({}, ["nowhere"], "nowhere: no such file"),
        ({}, ["pilot.py", "--level", "level9"], "level9: no such level file"),
        ({"a.yaml": "a: [1"}, ["pilot.py", "--level", "a.yaml"], "a.yaml"),
        ({"a.yaml": LEVEL + "speed: 3"}, ["pilot.py", "--level", "a.yaml"], "unknown field"),
        ({"a.yaml": LEVEL.replace("GATE_X", "9")}, ["pilot.py", "--level", "a.yaml"], "gates[0]"),
        ({"a.yaml": LEVEL.replace("GATE_X", ".nan")}, ["pilot.py", "--level", "a.yaml"], "x"),
        ({}, ["pilot.py", "--set", "goal.hold=long"], "goal.hold"),
        ({}, ["pilot.py", "--set", "nonsense"], "expected field=value"),
        ({"bad.py": "x = 1"}, ["bad.py"], "no class Controller"),
        ({"bad.py": controller(init="raise OSError('gone')")}, ["bad.py"], "OSError: gone"),
        ({"bad.py": "import nothing_like_it"}, ["bad.py"], "nothing_like_it"),
        ({"res": "a file"}, ["pilot.py", "--out", "res"], "--out res"),
    ],
)
def test_bad_input_exits_2_with_one_message(cli, pilot, tmp_path, files, arguments, message):
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    before = {p.name for p in tmp_path.iterdir()}
    shown = cli("dry-run", *arguments)
    assert shown.exit_code == 2, shown.output
    assert "error: " in shown.output
    assert message in shown.output
    left = {p.name for p in tmp_path.iterdir()} - before
    assert left <= {"runs"}
    assert not any(p.is_file() for p in (tmp_path / "runs").rglob("*"))


@pytest.mark.parametrize(
    "words",
    [
        ["arena-check", "--height", "nan"],
        ["virtual-cf", "--port", "0", "--mocap-rate", "inf"],
        ["dry-run", "--compute-factor", "nan"],
        ["bench", "--mocap-rate", "nan"],
    ],
)
def test_numbers_that_are_not_finite_are_refused_by_name(cli, words):
    shown = cli(*words)
    assert shown.exit_code == 2
    assert words[-2] in shown.output


def test_a_controller_that_prints_without_end_is_cut_off_and_told_of_once(cli, tmp_path):
    (tmp_path / "edit_this.py").write_text(
        controller("print('\\x1b[2J' + 'x' * 200_000)\n        return Command.NONE, []")
    )
    options = ["--set", "done_on_collision=false", "--set", "episode_length=2.0"]
    shown = cli("dry-run", tmp_path, "--episodes", 2, "--out", "r", "--no-figure", *options)
    assert shown.output.count("no more of it is shown") == 1
    assert 2**20 < len(shown.output) < 2**20 + 5000
    assert "\x1b[2J" not in shown.output
    assert "Results in" in shown.output


def test_wrong_option_exits_2(cli, pilot):
    assert cli("dry-run", pilot, "--episodes", 0).exit_code == 2


def test_export(cli, pilot, tmp_path):
    cli("dry-run", pilot, *EASY, "--episodes", 1, "--out", "r", "--no-figure")
    shown = cli("export", "r", "--csv", "--npz", "--out", "tables")
    assert shown.exit_code == 0
    names = {p.name for p in (tmp_path / "tables").iterdir()}
    assert {"episode_000_state.csv", "episode_000.npz"} <= names
    assert cli("export", "r").exit_code == 2
    assert cli("export", "nowhere", "--csv").exit_code == 2


def test_levels(cli):
    shown = cli("levels")
    assert shown.exit_code == 0
    assert "level0" in shown.output
    one = cli("levels", "level0", "--set", "seed=5")
    assert "seed: 5" in one.output
    assert cli("levels", "level9").exit_code == 2
