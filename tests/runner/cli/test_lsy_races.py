"""Races of lsy_drone_racing from the command line, each controller in a process of its own."""

import json
import os
import textwrap
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from crazyarena.levels.lsy import lsy_text
from crazyarena.runner.cli import make_app
from crazyarena.runner.records.mcap_records import read_records
from crazyarena.runner.viewer.recorded import flights
from tests.runner.lsy_controllers import HEAD

runner = CliRunner()
STATE = ("--set", "env.kwargs.0.control_mode=state", "--set", "env.kwargs.1.freq=50")
ON = "    def step_callback(self, *told):\n        self.k += 1\n        return {ends}\n"


def racer(body, ends="False", wait="0"):
    """A controller in state mode: ``body`` has ``t``, s since it started, and ``me``, its rows."""
    return (
        HEAD
        + "from scipy.interpolate import CubicSpline\nimport time\n"
        + "class Racer(Controller):\n"
        + "    def __init__(self, obs, info, config):\n"
        + "        super().__init__(obs, info, config)\n"
        + f"        self.rank, self.k, self.wait = info['rank'], 0, {wait}\n"
        + "        self.freq, self.start = config.env.freq, np.array(obs['pos'][self.rank])\n"
        + "    def compute_control(self, obs, info):\n"
        + "        assert info == {'rank': self.rank} and obs['pos'].shape == (2, 3)\n"
        + "        t = max(0.0, self.k / self.freq - self.wait)\n"
        + "        me = {k: v[self.rank] for k, v in obs.items()}\n"
        + textwrap.indent(textwrap.dedent(body).strip(), " " * 8)
        + "\n        return np.concatenate([place, np.zeros(10)])\n"
        + ON.format(ends=ends)
    )


ROUTE = """
points = [self.start + [0, 0, 0.05], [-1.0, 0.55, 0.4], [0.3, 0.35, 0.7], [1.3, -0.15, 0.9],
          [0.85, 0.85, 1.2], [-0.5, -0.05, 0.7], [-1.2, -0.2, 0.8], [-1.2, -0.2, 1.2],
          [0.0, -0.7, 1.2], [0.5, -0.75, 1.2]]
path = CubicSpline(np.linspace(0, 15, 10), points)
place = path(min(t, 15.0))
"""
UP = "place = self.start + [0, 0, min(1.0, t)]"
TOGETHER = "place = [self.start[0], 0.75, min(1.0, t)]"


@pytest.fixture
def call(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def run(sources, *arguments, level="lsy/multi_level0", more=STATE):
        for name, source in sources.items():
            (tmp_path / name).write_text(source)
        command = ["dry-run", *sources, "--seed", "1", "--out", "out", *arguments]
        if level:
            command += ["--level", level]
        return runner.invoke(make_app(), [*command, *more])

    return run


def document(folder):
    return json.loads((Path(folder) / "out" / "result.json").read_text())


def ends(result):
    return [row["termination"] for row in result["episodes"]]


def test_two_finish_and_are_placed_recorded_and_reported(call, tmp_path):
    result = call({"one.py": racer(ROUTE), "two.py": racer(ROUTE, wait="1.5 * info['rank']")})
    assert result.exit_code == 0, result.output
    told = document(tmp_path)
    assert ends(told) == ["GATES PASSED"] * 2
    assert [(r["drone"], r["controller"], r["place"]) for r in told["episodes"]] == [
        (0, "one", 1),
        (1, "two", 2),
    ]
    first, second = (row["time"] for row in told["episodes"])
    assert second - first == pytest.approx(1.5, abs=0.1)
    assert (told["race"], told["success_rate"], told["drones"]) == (True, 1.0, 2)
    assert len(told["provenance"]["submissions"]) == len(told["provenance"]["contestants"]) == 2
    names = [row["files"]["recording"] for row in told["episodes"]]
    assert names == ["episode_000_drone_0.mcap", "episode_000_drone_1.mcap"]
    assert [f.name for f in flights([tmp_path / "out"])] == [n[:-5] for n in names]
    metadata = read_records(tmp_path / "out" / names[1]).metadata
    assert (metadata["drone"], metadata["drones"]) == ("1", "2")
    page = (tmp_path / "out" / "report.html").read_text()
    assert "Race 0" in page
    assert "drone 1 (two)" in page


def test_the_same_seed_gives_the_same_recordings(call, tmp_path):
    sources = {"one.py": racer(UP, "self.k > 40"), "two.py": racer(UP, "self.k > 60")}
    taken = []
    for out in ("first", "second"):
        call(sources, "--out", out, level="lsy/multi_level2")
        taken.append([file.read_bytes() for file in sorted((tmp_path / out).glob("*.mcap"))])
    assert len(taken[0]) == 2
    assert taken[0] == taken[1]
    assert taken[0][0] != taken[0][1]


def test_two_that_collide_are_both_out(call, tmp_path):
    result = call({"one.py": racer(TOGETHER)})
    assert result.exit_code == 1, result.output
    told = document(tmp_path)
    assert ends(told) == ["COLLISION"] * 2
    assert told["episodes"][0]["steps"] == told["episodes"][1]["steps"]
    whys = [row["why"] for row in told["episodes"]]
    assert [why.partition(" at ")[0] for why in whys] == [
        "COLLISION with drone 1",
        "COLLISION with drone 0",
    ]


def test_one_crashes_and_the_other_goes_on_and_sees_that_it_is_gone(call, tmp_path):
    sees = UP + "\nif t > 1.9: print('other at', *obs['pos'][1 - self.rank].tolist())"
    result = call(
        {
            "good.py": racer(sees.replace("print", "assert (obs['pos'][1] == -1).all(), "),
                             "self.k > 100"),
            "bad.py": racer(UP + "\nif t > 0.5: raise RuntimeError('lost my way')"),
        }
    )  # fmt: skip
    assert result.exit_code == 1, result.output
    told = document(tmp_path)
    assert ends(told) == ["CONTROLLER FINISHED", "CONTROLLER ERROR"]
    assert "lost my way" in told["episodes"][1]["error"]
    assert told["episodes"][0]["error"] is None
    assert [row["steps"] for row in told["episodes"]] == [101, 26]
    assert "drone 1: step 26: compute_control raised" in result.output


def test_one_that_dies_races_again_in_the_next_race(call, tmp_path):
    dies = UP + "\nimport os\nif t > 0.1: os._exit(3)"
    sources = {"good.py": racer(UP, "self.k > 20"), "dies.py": racer(dies)}
    assert call(sources, "--episodes", "2").exit_code == 1
    told = document(tmp_path)
    assert ends(told) == ["CONTROLLER FINISHED", "CONTROLLER ERROR"] * 2
    assert [row["steps"] for row in told["episodes"]] == [21, 6] * 2
    assert [row["index"] for row in told["episodes"]] == [0, 0, 1, 1]


def test_one_that_is_slow_flies_as_it_would_alone(call, tmp_path):
    slow = "time.sleep(0.04)\n" + UP
    call({"one.py": racer(UP, "self.k > 30"), "two.py": racer(UP, "self.k > 30")}, "--out", "fast")
    call({"one.py": racer(UP, "self.k > 30"), "two.py": racer(slow, "self.k > 30")})
    told = document(tmp_path)
    assert ends(told) == ["CONTROLLER FINISHED"] * 2
    for drone in range(2):
        states = [
            flights([tmp_path / out / f"episode_000_drone_{drone}.mcap"])[0].position
            for out in ("fast", "out")
        ]
        np.testing.assert_array_equal(*states)


@pytest.mark.skipif(os.getuid() != 0, reason="only the super-user gives them users of their own")
def test_one_that_takes_all_processes_it_may_have_takes_none_of_the_others(call, tmp_path):
    greedy = (
        UP
        + """
import os
if t == 0.2:
    try:
        for _ in range(200):
            if os.fork() == 0:
                time.sleep(60)
                os._exit(0)
    except OSError:
        print("no more")
"""
    )
    threads = UP + "\nimport threading\nwork = threading.Thread(target=int)\nwork.start()"
    call({"one.py": racer(greedy, "self.k > 40"), "two.py": racer(threads, "self.k > 40")})
    assert ends(document(tmp_path)) == ["CONTROLLER FINISHED"] * 2


def test_controllers_that_the_level_names_are_found_as_in_a_checkout(call, tmp_path):
    control = tmp_path / "lsy_drone_racing" / "control"
    control.mkdir(parents=True)
    (tmp_path / "config").mkdir()
    level = tmp_path / "config" / "race.toml"
    level.write_text(lsy_text("lsy/multi_level0"))
    result = call({}, level=str(level))
    assert result.exit_code == 2
    assert "race.toml: controller[0].file: no attitude_controller_multi.py in" in result.output
    (control / "attitude_controller_multi.py").write_text(racer(UP, "self.k > 3"))
    result = call({}, level=str(level))
    assert result.exit_code == 2
    assert "controller[1].file: no attitude_mpc_multi.py" in result.output
    (control / "attitude_mpc_multi.py").write_text(racer(UP, "self.k > 3"))
    call({}, level=str(level))
    assert ends(document(tmp_path)) == ["CONTROLLER FINISHED"] * 2


def test_bad_input_exits_with_2_and_leaves_nothing(call, tmp_path):
    good, race = racer(UP), "lsy/multi_level0"
    (tmp_path / "third.py").write_text(good)
    two = {"one.py": good, "two.py": good}
    wrong = [
        (call({"one.py": good}, "none.py", level=race), "none.py: no such file"),
        (call({}, level=race), "pass the file of a controller for each of its 2 drones"),
        (call(two, "third.py", level=race), "3 controllers for 2 drones"),
        (call(two, level="lsy/level0", more=()), "several fly only in a race"),
        (call(two, level=None, more=()), "several fly only in a race"),
        (call(two, "--no-sandbox"), "--no-sandbox: in a race"),
        (call(two, "--compute", "measured"), "costs no time"),
        (call(two, "--step-limit", "0.1"), "a race has none of them"),
        (call(two, "--set", "profile=arena"), "in profile successor only"),
        (call({**two, "two.py": "import nothing_such\n" + good}), "drone 1: "),
        (call({**two, "two.py": "x = 1\n"}), "two.py: no class here derives"),
    ]
    for result, words in wrong:
        assert result.exit_code == 2, result.output
        assert words in result.output
    assert not (tmp_path / "out").exists()


def test_races_are_named_where_single_drones_are_flown(call, tmp_path):
    (tmp_path / "one.py").write_text(racer(UP))
    for command in (["evaluate"], ["bench"], ["fly", "--backend", "sim"]):
        result = runner.invoke(
            make_app(), [*command, "one.py", "--level", "lsy/multi_level0", "--out", "out"]
        )
        assert result.exit_code == 2, result.output
        assert "a race of several drones, which crazyarena dry-run flies" in result.output


def test_a_controller_for_one_drone_is_told_what_a_race_shows(call):
    single = HEAD + "class A(Controller):\n    def compute_control(self, obs, info):\n"
    single += "        return np.concatenate([obs['pos'], np.zeros(10)])\n"
    told = call({"a.py": single}).output
    assert "obs['pos'][info['rank']] is its own" in " ".join(told.split())


@pytest.mark.parametrize("width", [60, 80])
def test_a_narrow_table_of_a_race_folds_words_and_cuts_nothing(call, width, monkeypatch):
    monkeypatch.setenv("COLUMNS", str(width))
    Path("my_racer").mkdir()
    told = call({"my_racer/controller.py": racer(UP, "self.k > 30")}).output
    table = told[: told.index("Seed ")]
    for word in ("my_racer", "CONTROLLER", "drone"):
        assert word in table
    assert "…" not in table
    rows = table[table.index(" #  drone") :].splitlines()
    assert max(map(len, rows)) <= width
