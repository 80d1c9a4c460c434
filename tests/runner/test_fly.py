"""``crazyarena fly`` and arena dry runs from the command line, in simulation."""

import json

import pytest
from typer.testing import CliRunner

from crazyarena.runner.cli import make_app
from tests.runner.fakes import controller

EMPTY = ["--set", "track.gates=[]", "--set", "track.obstacles=[]"]
NEAR = [*EMPTY, "--set", "goal.position=[-0.9, -2.4, 0.8]", "--set", "goal.hold=0.5"]
TO_GOAL = """\
rise = min(time / 3.0, 1.0)
        x, y = obs[0], obs[2]
        place = [-0.9, -2.9 + 0.5 * rise, max(0.05, 0.8 * rise)]
        return Command.FULLSTATE, [place, [0]*3, [0]*3, 0.0, [0]*3]"""


@pytest.fixture
def run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def call(*arguments, source=None):
        (tmp_path / "pilot.py").write_text(source or controller(TO_GOAL))
        return CliRunner().invoke(make_app(), [str(a) for a in arguments])

    return call


def episode(folder):
    return json.loads((folder / "result.json").read_text())["episodes"][0]


def test_fly_in_simulation_is_the_dry_run(run, tmp_path):
    common = ["pilot.py", "--level", "sim2real", *NEAR, "--compute", "free", "--no-figure"]
    flown = run("fly", *common, "--backend", "sim", "--out", "a")
    assert flown.exit_code == 0, flown.output
    assert "sandbox: " in flown.output
    assert "return-and-land" in flown.output
    dry = run("dry-run", *common, "--out", "b")
    assert dry.exit_code == 0, dry.output
    assert (tmp_path / "a/episode_000.mcap").read_bytes() == (
        tmp_path / "b/episode_000.mcap"
    ).read_bytes()
    document = json.loads((tmp_path / "a/result.json").read_text())
    phases = ["connect", "pre-flight", "survey", "arm", "countdown", "run", "return-and-land",
              "disarm"]  # fmt: skip
    assert list(document["episodes"][0]["phases"]) == phases
    origin = document["provenance"]
    assert origin["contestant"]["sandbox"]
    assert origin["deadlines"]["compute"] == "free"
    assert origin["rig"]["backend"] == "sim"
    assert origin["machine"]["cpus"] >= 1


@pytest.mark.parametrize("deck", ["lighthouse", "flow"])
def test_it_flies_by_its_own_estimate(deck, run, tmp_path):
    common = ["pilot.py", "--level", "sim2real", *NEAR, "--compute", "free", "--no-figure"]
    options = ["--mocap", "onboard", "--mocap-option", f"deck={deck}"]
    flown = run("fly", *common, "--backend", "sim", *options, "--out", "a")
    assert flown.exit_code == 0, flown.output
    document = json.loads((tmp_path / "a/result.json").read_text())
    assert document["provenance"]["rig"]["mocap"] == f"onboard ({deck})"
    (told,) = [e for e in episode(tmp_path / "a")["events"] if e["event"] == "safety: own_estimate"]
    assert "not checked are wrong_body" in told["detail"]
    lines = document["provenance"]["preflight"]["checks"][0]
    assert {line["name"] for line in lines if not line["checked"]} >= {"cf1 heading", "arena clear"}


def test_it_does_not_fly_what_it_cannot_record(run, tmp_path):
    (tmp_path / "a/episode_000.mcap.part").mkdir(parents=True)
    result = run("fly", "pilot.py", *NEAR, "--backend", "sim", "--out", "a", "--no-figure")
    assert result.exit_code == 2
    assert "episode_000.mcap.part: cannot write the recording" in result.output.replace("\n", "")
    assert "countdown" not in result.output


def test_an_entry_that_leaves_the_arena_is_taken_by_the_watchdog(run, tmp_path):
    step = (
        "rise = min(time, 2.0)\n        return Command.FULLSTATE, [[-0.9, -2.9, 0.4 * rise + 0.05],"
        " [0, 0, 0], [0, -6.0 * (time > 3.0), 0], 0.0, [0]*3]"
    )
    # The arena is judged generously, so that it is the fence that ends it.
    options = ["--set", "done_on_violation=false", "--set", "done_on_collision=false", *EMPTY]
    result = run(
        "fly", "pilot.py", *options, "--backend", "sim", "--out", "a", "--no-figure",
        source=controller(step),
    )  # fmt: skip
    assert result.exit_code == 1
    flown = episode(tmp_path / "a")
    assert flown["termination"] == "SAFETY"
    assert "fence" in flown["error"]
    assert any(e["event"].startswith("safety: fence") for e in flown["events"])


def test_an_entry_that_stops_answering_is_landed(run, tmp_path):
    step = "import time as t\n        t.sleep(5.0 if time > 2.0 else 0.0)\n        " + TO_GOAL
    result = run(
        "dry-run", "pilot.py", "--level", "sim2real", *NEAR, "--out", "a", "--no-figure",
        "--max-misses", "9", source=controller(step),
    )  # fmt: skip
    assert result.exit_code == 1
    flown = episode(tmp_path / "a")
    assert flown["termination"] == "CONTROLLER TIMEOUT"
    assert "no command for 9 ticks" in flown["error"]
    assert any("controller_timeout" in e["event"] for e in flown["events"])


def test_what_the_contestant_is_told_is_recorded(run, tmp_path):
    # A gate ahead of the start shows itself as soon as the vehicle is near.
    options = ["--set", "track.gates=[{x: -0.9, y: -2.1, yaw: 0.0, type: low}]"]
    options += ["--set", "track.obstacles=[]", "--set", "randomization.gates_and_obstacles.gates="]
    options[-1] += "[0.1, 0.1]"
    step = TO_GOAL.replace("0.8 * rise", "0.525 * rise")
    run(
        "dry-run", "pilot.py", "--level", "sim2real", *options, "--out", "a", "--no-figure",
        source=controller(step),
    )  # fmt: skip
    reveals = episode(tmp_path / "a")["reveals"]
    assert reveals[0]["gate"] == 0
    assert not reveals[0]["in_range"]
    assert reveals[0]["pose"][:3] == [-0.9, -2.1, 0.0]
    exact = next(r for r in reveals if r["in_range"])
    assert exact["pose"][:2] == pytest.approx([-0.8, -2.0], abs=2e-3)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["fly"], "needs --uri and --mocap"),
        (["fly", "--backend", "sim", "--level", "level0"], "profile=arena"),
        (["fly", "--backend", "sim", "--compute", "fast"], "fixed=MS"),
        (["dry-run", "--no-sandbox", "--require-sandbox"], "exclude each other"),
        (["dry-run", "--compute", "fixed"], "fixed=MS"),
        (["fly", "--backend", "sim", "--survey", "nowhere.json"], "nowhere.json"),
        (["fly", "--backend", "sim", "--waive", "cf2 battery"], "no such line"),
        (["fly", "--uri", "udp://127.0.0.1:1", "--mocap", "onboard"], "--survey FILE"),
        (
            ["fly", "--uri", "udp://127.0.0.1:1", "--mocap", "onboard", "--mocap-host", "x"],
            "has no host",
        ),
        (
            ["fly", "--backend", "sim", "--mocap", "onboard", "--mocap-option", "deck=gps"],
            "choose lighthouse or flow",
        ),
        (
            ["fly", "--backend", "sim", "--mocap", "onboard", "--mocap-option", "rate=5"],
            "unknown option 'rate'",
        ),
        (
            [
                "fly",
                "--backend",
                "sim",
                "--mocap",
                "onboard",
                "--set",
                "track.gates=[{x: 0, y: 0, yaw: 0, type: low, tracked: true}]",
            ],
            "gates that move have to be seen",
        ),
        (
            ["fly", "--uri", "udp://127.0.0.1:1", "--mocap", "zenoh", "--dead-man", "key"],
            "terminal",
        ),
        (
            ["fly", "--uri", "udp://127.0.0.1:1", "--mocap", "zenoh", "--dead-man", "gamepad"],
            "--gamepad auto",
        ),
    ],
)
def test_wrong_calls_are_one_message(run, tmp_path, arguments, words):
    result = run(*arguments, source=None)
    assert result.exit_code == 2
    assert words in result.output
    assert not (tmp_path / "runs").exists()
