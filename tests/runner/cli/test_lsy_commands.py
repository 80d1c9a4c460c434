"""``dry-run`` and ``evaluate`` of lsy_drone_racing's controllers from the command line."""

import json

import pytest
from typer.testing import CliRunner

from crazyarena.runner.cli import make_app
from tests.runner.lsy_controllers import HEAD, STATE, controller

runner = CliRunner()


@pytest.fixture
def call(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def run(source, *arguments):
        (tmp_path / "mine.py").write_text(source)
        return runner.invoke(make_app(), [*arguments])

    return run


def test_a_dry_run_needs_no_flag(call, tmp_path):
    result = call(STATE, "dry-run", "mine.py", "--seed", "1", "--out", "out")
    assert result.exit_code == 0, result.output
    document = json.loads((tmp_path / "out" / "result.json").read_text())
    assert document["contract"] == "lsy_drone_racing"
    assert document["success_rate"] == 1.0
    assert document["provenance"]["seed"] == 1
    assert document["provenance"]["level"] == "lsy-level0"
    assert document["episodes"][0]["files"] == {
        "recording": "episode_000.mcap",
        "figure": "episode_000.png",
    }
    assert (tmp_path / "out" / "episode_000.mcap").is_file()


def test_the_same_seed_gives_the_same_recording(call, tmp_path):
    for out in ("one", "two"):
        call(STATE, "dry-run", "mine.py", "--seed", "4", "--out", out, "--level", "lsy/level2")
    one, two = (tmp_path / out / "episode_000.mcap" for out in ("one", "two"))
    assert one.read_bytes() == two.read_bytes()


def test_a_level_file_of_theirs_and_its_warnings(call, tmp_path):
    from crazyarena.levels.lsy import load

    text = (load._FOLDER / "level0.toml").read_text()
    (tmp_path / "mine.toml").write_text(text.replace("camera =", "kamera ="))
    result = call(STATE, "dry-run", "mine.py", "--level", "mine.toml", "--no-record")
    assert result.exit_code == 0, result.output
    assert "sim.kamera: not known here, ignored" in result.output


def test_bad_input_exits_with_2(call):
    wrong = [
        (STATE, ("dry-run", "mine.py", "--level", "level0"), "none of its levels"),
        (STATE, ("dry-run", "--level", "lsy/level0"), "pass the file"),
        (STATE, ("dry-run", "mine.py", "--level", "lsy/level9"), "lsy/level0"),
        (STATE, ("dry-run", "mine.py", "--compute", "measured"), "costs no time"),
        (STATE, ("evaluate", "mine.py", "--set", "env.freq=7"), "divisor"),
        (HEAD + "x = 1\n", ("evaluate", "mine.py"), "derives from"),
        (STATE, ("evaluate", "other.py"), "no such file"),
        (STATE, ("bench", "mine.py", "--level", "sim2real"), "none of its levels"),
        (STATE, ("fly", "mine.py"), "needs --uri and --mocap"),
        (STATE, ("evaluate", "mine.py", "--set", "profile=arena"), "dry-run"),
        (STATE, ("dry-run", "mine.py", "--secret", "--seed", "1"), "exclude each other"),
        (STATE, ("evaluate", "mine.py", "--secret", "--set", "rng=threefry"), "pcg64"),
        (STATE, ("dry-run", "mine.py", "--secret", "--no-sandbox"), "exclude each other"),
        (STATE, ("arena-check", "none.toml"), "no such level file"),
        (HEAD + "x = 1\n", ("evaluate", "mine.py", "--level", "lsy/level1"), "level lsy/level1"),
    ]
    for source, arguments, words in wrong:
        result = call(source, *arguments)
        assert result.exit_code == 2, (arguments, result.output)
        assert words in result.output


def test_evaluation_counts_and_exits_by_half(call):
    arguments = ("evaluate", "mine.py", "--runs", "2", "--seed", "1")
    good = call(STATE, *arguments, "--level", "lsy/level0")
    assert good.exit_code == 0, good.output
    mean, rate = good.output.strip().splitlines()[-1].split(",")
    assert float(mean) == pytest.approx(13.86, abs=0.1)
    assert rate == "1.00"
    talks = controller("print('{told}'); return np.zeros(13)")
    bad = call(talks, *arguments, "--json")
    assert bad.exit_code == 1
    assert "{told}" in bad.stderr
    document = json.loads(bad.stdout)
    assert document["passed"] is False
    assert document["mean_time"] is None
    assert [r["termination"] for r in document["runs"]] == ["CONTROLLER FINISHED"] * 2


def test_a_dry_run_leaves_pictures_and_a_report_with_events(call, tmp_path):
    line = ("dry-run", "mine.py", "--level", "lsy/level0", "--seed", "1", "--episodes")
    assert call(STATE, *line, "1", "--out", "good").exit_code == 0
    (episode,) = json.loads((tmp_path / "good" / "result.json").read_text())["episodes"]
    assert episode["files"]["figure"] == "episode_000.png"
    page = (tmp_path / "good" / "report.html").read_text()
    for words in ("gate seen", "gate passed", "obstacle seen", "gate 3"):
        assert words in page
    # Down into the floor; of many the first failures, and all on one sheet.
    bad = controller("return np.concatenate(([1.0, 0.0, 0.5], np.zeros(10)))")
    told = call(bad, *line, "12", "--out", "bad")
    assert told.exit_code == 1
    drawn = sorted(file.name for file in (tmp_path / "bad").glob("*.png"))
    assert drawn[0] == "episode_000.png"
    assert drawn[-1] == "episodes.png"
    assert len(drawn) < 12
    assert "episodes are on episodes.png alone" in told.output
    none = call(STATE, *line, "1", "--out", "none", "--no-figure", "--no-report", "--no-record")
    assert none.exit_code == 0
    assert [file.name for file in (tmp_path / "none").iterdir()] == ["result.json"]


def test_secret_draws_are_told_in_the_result_alone(call, tmp_path):
    result = call(controller("return np.zeros(13)"), "dry-run", "mine.py", "--secret", "--out", "o")
    document = json.loads((tmp_path / "o" / "result.json").read_text())
    seed = document["provenance"]["seed"]
    assert seed > 2**64
    assert str(seed) not in result.output
    assert document["provenance"]["contestant"]["process"] == "its own"


def test_the_arena_profile_is_chosen_as_for_other_levels(call, tmp_path):
    result = call(
        controller("return np.zeros(13)"), "dry-run", "mine.py", "--set", "profile=arena",
        "--no-sandbox", "--out", "o", "--no-figure",
    )  # fmt: skip
    document = json.loads((tmp_path / "o" / "result.json").read_text())
    assert document["provenance"]["profile"] == "arena"
    assert document["episodes"][0]["termination"] == "FINISHED", result.output


def test_an_arena_is_checked_and_a_survey_is_by_the_level(call, tmp_path):
    checked = call(STATE, "arena-check", "lsy/level2", "--out", "arena.png")
    assert checked.exit_code == 0, checked.output
    assert "[-2.5, -1.5, -0.1] .. [2.5, 1.5, 2.0]" in checked.output
    assert (tmp_path / "arena.png").is_file()
    survey = call(STATE, "mocap-survey", "--level", "lsy/level9", "--mocap", "vicon")
    assert survey.exit_code == 2
    assert "lsy/level0" in survey.output or "No such" in survey.output


def test_levels_are_listed_and_shown(call):
    listed = call(STATE, "levels")
    assert "lsy/level3" in listed.output
    shown = call(STATE, "levels", "lsy/level3")
    assert "randomize = true" in shown.output
    assert call(STATE, "levels", "none.toml").exit_code == 2


def test_the_report_of_a_controller_that_never_flew_says_so(call, tmp_path):
    source = controller("return None")
    told = call(source, "dry-run", "mine.py", "--seed", "1", "--out", "out").output
    assert "not written" not in told
    assert "Nothing was flown" in (tmp_path / "out" / "report.html").read_text()
