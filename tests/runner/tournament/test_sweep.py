"""Sweeps of parameters."""

from __future__ import annotations

import json

import pytest
from typer.testing import CliRunner

from crazyarena.errors import InputError
from crazyarena.runner.cli import make_app
from crazyarena.runner.tournament.sweep import open_sweep, parse_axis
from tests.runner.fakes import controller

pytest.importorskip("distributed")

TOLD = controller(
    "return Command.FINISHED, []",
    init="assert initial_info['parameters']['speed'] < 2.0, initial_info['parameters']",
)


@pytest.fixture
def pilot(tmp_path):
    file = tmp_path / "pilot.py"
    file.write_text(TOLD)
    return file


@pytest.mark.parametrize(
    ("text", "name", "values", "of_level"),
    [
        ("speed=1,2,3", "speed", ("1", "2", "3"), False),
        ("disturbances.dynamics=null", "disturbances.dynamics", ("null",), True),
        ("goal.position=[0, 1, 1],[1,1,1]", "goal.position", ("[0, 1, 1]", "[1,1,1]"), True),
        ("track.gates[0].yaw=0.1,0.2", "track.gates[0].yaw", ("0.1", "0.2"), True),
        ("submission.seed=1,2", "seed", ("1", "2"), False),
        ("level.episode_length=3.0", "episode_length", ("3.0",), True),
        ("mode='a,b',c", "mode", ("'a,b'", "c"), False),
    ],
)
def test_what_a_set_says(text, name, values, of_level):
    axis = parse_axis(text)
    assert (axis.name, axis.values, axis.of_level) == (name, values, of_level)


@pytest.mark.parametrize(
    ("sets", "words"),
    [
        (["speed"], "expected name=value"),
        (["speed=1,,2"], "a value is empty"),
        (["speed=1,1"], "there twice"),
        (["speed=[1"], "no valid YAML"),
        (["=1"], "expected name=value"),
        (["a=1", "a=2"], "a name is there twice"),
        ([], "nothing to sweep"),
        ([f"a={','.join(map(str, range(40)))}", f"b={','.join(map(str, range(40)))}"], "at most"),
        (["track.gate=1"], "track.gate"),
        (["episode_length=-1.0"], "episode_length"),
    ],
)
def test_bad_sets_are_refused_before_anything_flies(tmp_path, pilot, sets, words):
    with pytest.raises(InputError, match=r"(?s).*" + words.replace("[", r"\[")):
        open_sweep(pilot, sets, ["level0"], tmp_path / "out", 2)


def test_levels_of_another_contract(tmp_path, pilot):
    with pytest.raises(InputError, match="not a level of this submission's contract"):
        open_sweep(pilot, ["a=1"], ["lsy/level2"], tmp_path / "out", 2)


def test_every_combination_meets_the_same_worlds(tmp_path, pilot):
    sets = ["speed=1,2", "episode_length=1.0,2.0"]
    event, axes = open_sweep(pilot, sets, ["level0", "level3"], tmp_path / "out", 12)
    event.close()
    assert [axis.of_level for axis in axes] == [False, True]
    orders = list(event.plan.orders())
    assert len(orders) == 4 * 2 * 2  # combinations, levels, blocks of ten and two
    assert {order.parameters["speed"] for order in orders} == {1, 2}
    for base in ("level0", "level3"):
        own = {level.seeds for level in event.plan.levels if level.key.startswith(base)}
        assert len(own) == 1
        lengths = {
            level.level.episode_length
            for level in event.plan.levels
            if level.key.startswith(base) and level.level
        }
        assert lengths == {1.0, 2.0}


def test_from_values_to_a_table_and_a_heat_map_and_on_from_there(tmp_path, pilot):
    out = tmp_path / "out"
    arguments = ["sweep", str(pilot), "--set", "speed=1.5,2.5", "--levels", "level0,level1"]
    arguments += ["--seeds", "2", "--out", str(out), "--set", "episode_length=1.0"]
    done = CliRunner().invoke(make_app(), arguments)
    assert done.exit_code == 0, done.output
    assert (out / "sweep.png").stat().st_size > 5000
    document = json.loads((out / "sweep.json").read_text())
    assert [axis["of"] for axis in document["axes"]] == ["submission", "level"]
    assert [(p["values"]["speed"], p["level"], p["flown"]) for p in document["points"]] == [
        ("1.5", "level0", 2), ("1.5", "level1", 2), ("2.5", "level0", 2), ("2.5", "level1", 2)
    ]  # fmt: skip
    lines = [json.loads(text) for text in (out / "episodes.jsonl").read_text().splitlines()]
    outcomes = {line["team"]: line["outcome"] for line in lines}
    assert outcomes == {"c0000": "FINISHED", "c0001": "SUBMISSION ERROR"}
    again = CliRunner().invoke(make_app(), arguments)
    assert again.exit_code == 0
    assert "8 episodes were there already" in again.output
    other = CliRunner().invoke(make_app(), [*arguments, "--set", "other=1"])
    assert other.exit_code == 2
    assert "another sweep was begun here" in other.output
