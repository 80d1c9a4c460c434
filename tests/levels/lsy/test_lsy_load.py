"""Level files of lsy_drone_racing: what is read, warned of and refused, by file, line and key."""

import contextlib
import math
import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyarena.errors import InputError
from crazyarena.levels.lsy import is_lsy_level, load_lsy_level, lsy_text, shipped_lsy_levels
from crazyarena.levels.lsy import load as module
from crazyarena.levels.lsy.toml_document import parse_toml

LEVEL2 = (Path(module.__file__).parent / "level2.toml").read_text("utf-8")


def write(folder, old="", new=""):
    assert old in LEVEL2
    file = folder / "level.toml"
    file.write_text(LEVEL2.replace(old, new, 1) if old else LEVEL2)
    return file


def line_of(text, part):
    return next(i for i, line in enumerate(text.splitlines(), 1) if part in line)


SINGLE = tuple(f"lsy/level{i}" for i in range(4))
RACES = "lsy/multi_level0", "lsy/multi_level2"


def test_levels_are_shipped_under_their_own_names():
    assert shipped_lsy_levels() == (*SINGLE, *RACES)
    for name in SINGLE:
        assert is_lsy_level(name)
        level = load_lsy_level(name)
        assert level.warnings == ()
        assert level.duration == 30.0
        assert level.ticks == 10
        assert level.config["env"]["freq"] == 50
    assert not is_lsy_level("level0")
    assert is_lsy_level("anything.toml")


def test_what_each_level_draws():
    drawn = [
        {k for k, v in load_lsy_level(name).env.randomizations if v is not None} for name in SINGLE
    ]
    drone = {"drone_pos", "drone_rpy", "drone_mass", "drone_inertia"}
    track = {"gate_pos", "gate_rpy", "obstacle_pos"}
    assert drawn == [set(), drone, drone | track, drone | track]
    assert [load_lsy_level(n).env.track.randomize for n in SINGLE] == [
        False, False, False, True,
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("old", "new", "where", "words"),
    [
        ("freq = 50 ", "freq = 51 ", "env.freq", "divisor of sim.freq"),
        ("[0.5, 0.25, 0.7]", "[0.5, nan, 0.7]", "env.track.gates[0].pos[1]", "finite"),
        ("[0.5, 0.25, 0.7]", "[0.5, 0.25]", "env.track.gates[0].pos", "3"),
        ("[1, 2, 3, 4]", "[1, -5]", "env.track.gate_order[1]", "from 1 to 4"),
        ("[1, 2, 3, 4]", "[]", "env.track.gate_order", "at least one"),
        ("drone_mass]", "drone_mas]", "env.randomizations.drone_mas", "drone_mass"),
        ('physics = "first', 'physics = "last', "sim.physics", "first_principles"),
        ('"cf21B_500"\nfreq', '"cf3"\nfreq', "sim.drone_model", "cf2x_L250"),
        ('"state"', '"thrust"', "env.control_mode", "attitude"),
        ('"DroneRacing-v0"', '"MultiDroneRacing-v0"', "env.id", "several drones"),
        ("minval = -0.005", "minval = 0.5", "env.randomizations.drone_mass.kwargs", "<= maxval"),
        ("minval = -0.005", "mean = 0.5", "env.randomizations.drone_mass.kwargs", "minval"),
        ("[0.15, 0.15, 0.1]", "[1e9, 0.15, 0.1]", "env.randomizations.gate_pos", "within 100 m"),
        ("scale = 0.001", "scale = [1.0, 2.0]", "env.disturbances.action", "broadcast"),
    ],
)  # fmt: skip
def test_bad_values_are_refused_with_line_and_key(tmp_path, old, new, where, words):
    file = write(tmp_path, old, new)
    with pytest.raises(InputError, match=re.escape(words)) as error:
        load_lsy_level(file)
    match = re.match(rf"{re.escape(str(file))}:(\d+): (\S+): ", str(error.value))
    assert match is not None, error.value
    assert match[2].startswith(where)
    assert abs(int(match[1]) - line_of(file.read_text(), new.split("\n")[0])) <= 2


def test_unknown_keys_are_a_warning_with_their_line(tmp_path):
    file = write(tmp_path, "sensor_range", "sensor_rage")
    level = load_lsy_level(file)
    line = line_of(file.read_text(), "sensor_rage")
    assert level.warnings == (
        f"{file}:{line}: env.sensor_rage: not known here, ignored; did you mean 'sensor_range'?",
    )
    assert level.config["env"]["sensor_rage"] == 0.7
    assert level.env.sensor_range == 0.5


def test_levels_before_gate_order_and_with_words_for_a_seed(tmp_path):
    file = write(tmp_path, "gate_order = [1, 2, 3, 4]\n")
    file.write_text(file.read_text().replace("seed = -1", 'seed = "random"'))
    level = load_lsy_level(file)
    assert level.env.seed == -1
    assert level.env.track.order == (1, 2, 3, 4)


def test_signed_gate_order(tmp_path):
    level = load_lsy_level(write(tmp_path, "[1, 2, 3, 4]", "[-4, 1, 1]"))
    assert level.env.track.order == (-4, 1, 1)


def test_overrides_reach_fields_and_our_own():
    level = load_lsy_level(
        "lsy/level2", ["env.seed=7", "rng=threefry", "env.track.gates[0].pos=[0,0,1]"]
    )
    assert (level.env.seed, level.rng) == (7, "threefry")
    assert level.config["env"]["seed"] == 7
    assert level.env.track.gates[0].pos == (0.0, 0.0, 1.0)
    with pytest.raises(InputError, match=r"rng.*pcg64"):
        load_lsy_level("lsy/level2", ["rng=dice"])


@pytest.mark.parametrize("text", ["[env", "a = 1\na = 2", "x = nope", "\x00", "[env]\nid = 3", ""])
def test_what_is_no_level_is_refused_by_name(tmp_path, text):
    file = tmp_path / "bad.toml"
    file.write_text(text)
    with pytest.raises(InputError, match=r"bad\.toml"):
        load_lsy_level(file)


def test_missing_files(tmp_path):
    with pytest.raises(InputError, match="lsy/level0"):
        load_lsy_level(tmp_path / "none.toml")


def test_lines_of_a_document_with_everything_in_it():
    text = (
        'a = """one\n[not.a.table]\nb = 2\n"""\n'  # lines 1 to 4
        "c = [\n  1, # ]\n  2,\n]\n"  # 5 to 8
        "[t.u]\n'd e' = {x = 1}\n"  # 9, 10
        "[[t.v]]\ny = 1\n[[t.v]]\ny = 2\n[t.v.w]\nz.q = '#['\n"  # 11 to 16
    )
    root = parse_toml(text, "f")

    def at(*keys):
        node = root
        for key in keys:
            node = node.value[key]
        return node.source

    assert at("a") == "f:1"
    assert at("c") == "f:5"
    assert at("c", 1) == "f:5"
    assert at("t", "u") == "f:9"
    assert at("t", "u", "d e", "x") == "f:10"
    assert at("t", "v", 0, "y") == "f:12"
    assert at("t", "v", 1, "y") == "f:14"
    assert at("t", "v", 1, "w", "z", "q") == "f:16"


@given(st.text(max_size=200))
def test_any_text_is_read_or_refused(text):
    with contextlib.suppress(InputError):
        assert isinstance(parse_toml(text, "f").value, dict)


def test_limits_are_what_the_contract_says():
    limits = load_lsy_level("lsy/level3").env.track.safety_limits
    assert limits.pos_limit_low == (-2.5, -1.5, -1e-3)
    assert limits.pos_limit_high == (2.5, 1.5, 2.0)
    assert math.isclose(load_lsy_level("lsy/level0").env.sensor_range, 0.7)


RACE = (Path(module.__file__).parent / "multi_level2.toml").read_text("utf-8")


def race_file(folder, old="", new=""):
    assert old in RACE
    file = folder / "race.toml"
    file.write_text(RACE.replace(old, new, 1) if old else RACE)
    return file


def test_a_race_has_the_rate_of_its_fastest_drone_and_the_mode_of_its_first():
    for name in RACES:
        level = load_lsy_level(name, race=True)
        assert level.race
        assert level.warnings == ()
        assert (level.drones, level.periods) == (2, (2, 1))
        assert (level.env.freq, level.env.control_mode, level.ticks) == (100, "attitude", 5)
        assert level.env.sensor_range == 0.7
        assert level.duration == 15.0
        assert [level.config_of(rank)["env"]["freq"] for rank in range(2)] == [50, 100]
        assert level.config_of(1)["controller"][1] == {"file": "attitude_mpc_multi.py"}
        assert [c.file for c in level.controller] == [
            "attitude_controller_multi.py", "attitude_mpc_multi.py",
        ]  # fmt: skip
    starts = [drone.pos for drone in load_lsy_level(RACES[0], race=True).env.track.drones]
    assert starts == [(-1.5, 0.55, 0.01), (-1.5, 0.95, 0.01)]


def test_a_race_is_refused_where_single_drones_are_flown():
    with pytest.raises(InputError, match=r"multi_level0.toml:\d+: env.id: .*dry-run flies"):
        load_lsy_level(RACES[0])


@pytest.mark.parametrize(
    ("old", "new", "where", "words"),
    [
        ("freq = 50  ", "freq = 30  ", "env.kwargs[0].freq", "divisor of the highest one (100)"),
        ("freq = 50  ", "freq = true  ", "env.kwargs[0].freq", "whole number"),
        ("[[env.kwargs]]\nfreq = 100\n", "[env.extra]\n", "env.kwargs", "each of the 2 drones"),
        ("[[env.kwargs]]\nfreq = 100\n", "[[env.kwargs]]\nfreq = 300\n", "env.freq", "divisor"),
        ("control_mode = ", "control_mode = \"thrust\" # ", "env.kwargs[0].control_mode", "state"),
        ("Multi", "", "controller", "belongs to a race"),
        ("file = \"att", "file = 3 # \"att", "controller[0].file", "text"),
        ("minval = -0.005", "minval = [[0.0], [0.0], [0.0]]",
         "env.randomizations.drone_mass", "broadcast to [1, 2, 1]"),
    ],
)  # fmt: skip
def test_bad_races_are_refused_with_line_and_key(tmp_path, old, new, where, words):
    with pytest.raises(InputError, match=re.escape(words)) as error:
        load_lsy_level(race_file(tmp_path, old, new), race=True)
    assert re.match(rf"{re.escape(str(tmp_path))}\S+:\d+: {re.escape(where)}", str(error.value))


def test_what_a_race_does_not_heed_is_warned_of(tmp_path):
    file = race_file(tmp_path, "seed = -1", 'control_mode = "state"\nseed = -1')
    text = file.read_text()
    cut = text.rindex('control_mode = "attitude"')
    file.write_text(text[:cut] + text[cut:].replace("attitude", "state", 1))
    level = load_lsy_level(file, race=True)
    assert level.env.control_mode == "attitude"
    ignored, first = level.warnings
    assert "env.control_mode: ignored; a race has it in env.kwargs" in ignored
    assert "control_mode: the first one's is that of all drones" in first


@pytest.mark.parametrize("content", [None, b"\xff\xfe", bytes(1 << 24)])
def test_what_is_no_level_is_refused_in_one_line(tmp_path, content):
    file = Path("/dev/zero") if content is None else tmp_path / "level.toml"
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(InputError) as error:
        lsy_text(file)
    assert str(file) in str(error.value)
    assert "\n" not in str(error.value)
