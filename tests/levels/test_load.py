from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from crazyarena.errors import InputError
from crazyarena.levels import GateType, Level, dump_level, load_level, shipped_levels
from tests.levels.competition_files import (
    DISTURBANCES,
    DISTURBANCES_AS_DICT,
    EMPTY_TRACK,
    FILES,
    competition_file,
)

MINIMAL = """\
start: {position: [0, 0, 0.03]}
goal: {position: [1, 1, 1]}
track:
  gates:
    - {x: 0.5, y: 0.5, type: tall}
"""


def write(folder: Path, text: str | bytes, name: str = "mine.yaml") -> Path:
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def refusal(path: Path | str, *overrides: str) -> str:
    with pytest.raises(InputError) as caught:
        load_level(path, overrides)
    message = str(caught.value)
    assert "\n" not in message
    return message


def outcome(path: Path | str, *overrides: str) -> Level | str:
    """The level or the refusal; any other exception is the caller's failed test."""
    try:
        return load_level(path, overrides)
    except InputError as error:
        return str(error)


# -- what loads ------------------------------------------------------------------------------


def test_all_shipped_levels_load():
    expected = {"getting_started", "level0", "level1", "level2", "level3", "sim2real"}
    assert set(shipped_levels()) == expected
    for name in shipped_levels():
        level = load_level(name)
        assert level.name == name
        assert len(level.track.gates) == 4
        assert len(level.track.obstacles) == 4
        assert level.profile == ("arena" if name == "sim2real" else "competition")


@pytest.mark.parametrize("name", sorted(FILES))
def test_competition_file_equals_shipped_level(name, tmp_path):
    assert load_level(write(tmp_path, FILES[name], f"{name}.yaml")) == load_level(name)


def test_disturbances_may_be_mappings_instead_of_lists(tmp_path):
    as_list = load_level(write(tmp_path, competition_file(disturbances=DISTURBANCES)))
    as_dict = load_level(write(tmp_path, competition_file(disturbances=DISTURBANCES_AS_DICT)))
    assert as_dict == as_list


def test_dev_sim2real_file_without_gates_and_keys(tmp_path):
    text = competition_file(track=EMPTY_TRACK, reseed=None, done=None, top="1.5", span="0.1")
    level = load_level(write(tmp_path, text))
    assert level.track.gates == ()
    assert level.track.obstacles == ()
    assert not level.reseed_on_reset
    flags = (level.done_on_collision, level.done_on_violation, level.done_on_completion)
    assert flags == (False, False, False)
    assert level.arena.high == (3.0, 3.0, 1.5)


def test_inertial_prop_and_missing_constraints(tmp_path):
    text = competition_file()
    text = text[: text.index("  constraints:")] + "  inertial_prop: {M: 0.027, Iyy: 1.5e-5}\n"
    level = load_level(write(tmp_path, text))
    assert (level.vehicle.mass, level.vehicle.ixx, level.vehicle.iyy) == (0.027, 1.4e-5, 1.5e-5)
    assert (level.constraints.input, level.constraints.state) == (False, False)
    listed = text.replace("{M: 0.027, Iyy: 1.5e-5}", "[0.027, 1.4e-5, 1.5e-5, 2.17e-5]")
    assert load_level(write(tmp_path, listed)) == level


@pytest.mark.parametrize("name", [*sorted(FILES), "sim2real"])
def test_dump_round_trip(name, tmp_path):
    level = load_level(name)
    assert load_level(write(tmp_path, dump_level(level))) == level


def test_numbers_as_people_write_them(tmp_path):
    for text, value in (("1e-1", 0.1), ("1E-1", 0.1), ("+1e-1", 0.1), (".1", 0.1), ("1", 1.0)):
        level = load_level(write(tmp_path, MINIMAL), [f"goal.tolerance={text}"])
        assert level.goal.tolerance == value


def test_single_letter_names_are_names(tmp_path):
    # To YAML 1.1 (though not to PyYAML) "y" is a boolean; to us it is a field of every gate.
    level = load_level(write(tmp_path, MINIMAL), ["track.gates[0].y=1"])
    assert level.track.gates[0].y == 1.0
    level = load_level(write(tmp_path, MINIMAL + "randomization: {start: {y: [0, 0.1]}}"))
    assert level.randomization.start is not None
    assert level.randomization.start.y == (0.0, 0.1)


def test_level_is_immutable():
    level = load_level("level0")
    with pytest.raises(ValueError, match="frozen"):
        level.seed = 2  # type: ignore[misc]
    with pytest.raises(ValueError, match="frozen"):
        level.track.gates[0].x = 0.0  # type: ignore[misc]


def test_gate_rows_and_heights():
    gates = load_level("level0").track.gates
    assert gates[0].row == [0.5, -2.5, 0, 0, 0, -1.57, 0]
    assert gates[1].row == [2, -1.5, 0, 0, 0, 0, 1]
    assert gates[0].centre == (0.5, -2.5, 1.0)
    assert gates[1].centre == (2.0, -1.5, 0.525)
    assert [gate.type for gate in gates] == [
        GateType.TALL,
        GateType.LOW,
        GateType.LOW,
        GateType.TALL,
    ]


def test_arena_limits():
    arena = load_level("level0").arena
    assert arena.soft_low == (-2.95, -2.95, -0.1)
    assert arena.soft_high == (2.95, 2.95, 1.95)
    assert arena.contains((2.98, 0.0, 1.0))
    assert not arena.contains((2.98, 0.0, 1.0), soft=True)
    assert not arena.contains((0.0, 0.0, 2.01))


def test_import_is_light():
    code = (
        "import crazyarena.levels, sys;"
        "print([m for m in ('numpy', 'numba', 'scipy', 'munch') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


# -- overrides -------------------------------------------------------------------------------


def test_overrides_in_our_format():
    level = load_level(
        "level3",
        [
            "seed=42",
            "disturbances.action.std=[0.001, 0.002, 0.003, 0.004]",
            "track.gates[0].yaw=0.5",
            "track.gates.1.type=tall",
            "randomization.inertia=null",
            "goal.hold= 1",
            "seed=43",
        ],
    )
    assert level.seed == 43
    assert level.disturbances.action is not None
    assert level.disturbances.action.std == (0.001, 0.002, 0.003, 0.004)
    assert level.track.gates[0].yaw == 0.5
    assert level.track.gates[1].type is GateType.TALL
    assert level.randomization.inertia is None
    assert level.goal.hold == 1.0


def test_override_creates_what_is_not_there():
    level = load_level("level0", ["randomization.start.x=[-0.2, 0.2]"])
    assert level.randomization.start is not None
    assert level.randomization.start.x == (-0.2, 0.2)
    assert level.randomization.start.y is None


def test_overrides_on_a_competition_file(tmp_path):
    path = write(tmp_path, FILES["level1"])
    level = load_level(
        path,
        [
            "quadrotor_config.seed=7",
            "quadrotor_config.gates[0][5]=0.25",
            "quadrotor_config.disturbances.action.0.std=0.002",
            "num_episodes=2",
            "profile=arena",
            "goal.hold=1.0",
        ],
    )
    assert (level.seed, level.num_episodes, level.profile) == (7, 2, "arena")
    assert level.track.gates[0].yaw == 0.25
    assert level.goal.hold == 1.0
    assert level.disturbances.action is not None
    assert level.disturbances.action.std == (0.002,) * 4


@pytest.mark.parametrize(
    ("override", "parts"),
    [
        ("seed", ["override 'seed'", "field=value"]),
        ("=3", ["field=value"]),
        ("seed=x", ["override 'seed=x'", "seed", "whole number", "'x'"]),
        ("seed=[1", ["no valid YAML"]),
        ("sed=1", ["sed", "unknown field", "did you mean 'seed'"]),
        ("track.gates[9].x=1", ["track.gates", "index below 4", "'9'"]),
        ("track.gates.first.x=1", ["index below 4", "'first'"]),
        ("seed.x=1", ["seed", "has no field 'x'"]),
        ("²=1", ["²", "unknown field"]),
        ("a..b=1", ["expected a field"]),
        ("goal.tolerance=.nan", ["goal.tolerance", "finite number", "nan"]),
        ("goal.tolerance=", ["goal.tolerance", "finite number", "nothing"]),
        ("goal.tolerance=true", ["goal.tolerance", "finite number", "true"]),
        ("seed=1.5", ["seed", "whole number", "1.5"]),
        ("seed=-1", ["seed", ">= 0", "-1"]),
        ("profile=moon", ["profile", "'competition' or 'arena'", "'moon'"]),
        ("quadrotor_config.seed=1", ["quadrotor_config", "unknown field"]),
        (".".join("a" * 40) + "=1", ["at most"]),
    ],
)
def test_bad_override(override, parts):
    message = refusal("level0", override)
    assert all(part in message for part in parts), message


@given(st.text(max_size=40))
def test_any_override_loads_or_is_refused(text):
    assert outcome("level0", text)


KEYS = st.sampled_from(["track", "gates", "seed", "goal", "0", "arena", "low", "randomization"])
SCALARS = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=8), st.just(10**400)
)


@given(st.lists(KEYS, min_size=1, max_size=4), SCALARS)
def test_any_assignment_loads_or_is_refused(keys, value):
    assert outcome("level3", f"{'.'.join(keys)}={yaml.safe_dump(value)}")


# -- what is refused -------------------------------------------------------------------------


def test_message_names_line_column_and_field(tmp_path):
    path = write(tmp_path, FILES["level0"].replace("1.57, 1]", "nan, 1]"), "level0.yaml")
    lines = path.read_text().splitlines()
    line = next(i for i, text in enumerate(lines, 1) if "nan" in text)
    column = lines[line - 1].index("nan") + 1
    assert refusal(path) == (
        f"{path}:{line}:{column}: quadrotor_config.gates[2][5]: "
        "expected a finite number, found 'nan'"
    )


@pytest.mark.parametrize(
    ("old", "new", "field", "parts"),
    [
        ("seed: 1337", "seed: x", "quadrotor_config.seed", ["whole number", "'x'"]),
        ("seed: 1337", "sead: 1", "quadrotor_config.sead", ["did you mean 'seed'?"]),
        ("verbose: False", "verbos: False", "verbos", ["did you mean 'verbose'?"]),
        ("task: stabilization", "task: tracking", "quadrotor_config.task", ["'stabilization'"]),
        ("quad_type: 3", "quad_type: 2", "quadrotor_config.quad_type", ["3", "found 2"]),
        ("quad_type: 3", "quad_type: true", "quadrotor_config.quad_type", ["found true"]),
        ("pyb_freq: 500", "pyb_freq: 240", "quadrotor_config.pyb_freq", ["500", "240"]),
        ("use_firmware: True", "use_firmware: False", "use_firmware", ["cmdFirmware", "false"]),
        ("ctrl_freq: 30", "ctrl_freq: 0", "quadrotor_config.ctrl_freq", [">= 1", "0"]),
        ("[2, -1.5, 0, 0, 0, 0, 1]", "[2, -1.5, 0, 0, 0, 1]", "quadrotor_config.gates[1]",
         ["[x, y, z, roll, pitch, yaw, type]", "list of 6"]),
        ("[2, -1.5, 0, 0, 0, 0, 1]", "[2, -1.5, 0, 0, 0, 0, 2]", "quadrotor_config.gates[1][6]",
         ["0 (tall) or 1 (low)", "2"]),
        ("[2, -1.5, 0, 0, 0, 0, 1]", "[2, -9, 0, 0, 0, 0, 1]", "quadrotor_config.gates[1]",
         ["inside the arena", "[2, -9, 0.525]"]),
        ("[1.5, 0, 0, 0, 0, 0]", "[1.5, 3.5, 0, 0, 0, 0]", "quadrotor_config.obstacles[2]",
         ["inside the arena"]),
        ("[1.5, 0, 0, 0, 0, 0]", "[1.5, .inf, 0, 0, 0, 0]", "quadrotor_config.obstacles[2][1]",
         ["finite number", "inf"]),
        ("-0.5, 2.9, 0.75", "-0.5, 3.1, 0.75", "quadrotor_config.task_info.stabilization_goal",
         ["goal inside the arena", "[-0.5, 3.1, 0.75]"]),
        ("-0.5, 2.9, 0.75", "-0.5, 2.9", "quadrotor_config.task_info.stabilization_goal",
         ["expected 3 values, found 2"]),
        ("init_z: 0.03", "init_z: 5", "quadrotor_config.init_state", ["start inside the arena"]),
        ("init_z: 0.03", "init_zz: 5", "quadrotor_config.init_state.init_zz",
         ["did you mean 'init_z'?"]),
        ("std: 0.001", "std: -1", "quadrotor_config.disturbances.action[0].std", [">= 0"]),
        ("white_noise", "impulse", "quadrotor_config.disturbances.action[0].disturbance_func",
         ["'white_noise'", "'impulse'"]),
        ("    action:", "    observation:", "quadrotor_config.disturbances.observation",
         ["allowed: action, dynamics"]),
        ("      low: -0.01", "      low: -0.04",
         "quadrotor_config.inertial_prop_randomization_info.M", ["-0.03454", "-0.04"]),
        ("      low: -0.01", "      low: 0.04",
         "quadrotor_config.inertial_prop_randomization_info.M", ["low <= high"]),
        ("active_dims: [0, 2, 4]", "active_dims: [0, 2]",
         "quadrotor_config.constraints[1].active_dims", ["[0, 2, 4]", "list of 2"]),
        ("  randomized_init: True\n", "", "quadrotor_config.randomized_init", ["true or false"]),
        ("num_episodes: 5", "num_episodes: 0", "num_episodes", [">= 1"]),
    ],
)  # fmt: skip
def test_bad_competition_file(old, new, field, parts, tmp_path):
    assert old in FILES["level3"]
    path = write(tmp_path, FILES["level3"].replace(old, new, 1))
    message = refusal(path)
    match = re.match(re.escape(str(path)) + r":(\d+):(\d+): (\S+): ", message)
    assert match, message
    assert match[3] == field
    assert all(part in message for part in parts), message
    if new:
        line = path.read_text().splitlines()[int(match[1]) - 1]
        tail = field.rsplit(".", 1)[-1].split("[")[0]
        assert new.strip().splitlines()[0] in line or tail in line, (message, line)


def test_missing_field_is_named(tmp_path):
    message = refusal(write(tmp_path, MINIMAL.replace("type: tall", "yaw: 0")))
    assert re.search(r"mine.yaml:5:\d+: track.gates\[0\].type: missing", message)
    message = refusal(write(tmp_path, MINIMAL.replace("goal:", "# goal:")))
    assert ":1:1: goal: missing" in message


def test_several_problems_are_counted(tmp_path):
    text = MINIMAL.replace("0.03", "x").replace("[1, 1, 1]", "[1, 1, y]")
    assert refusal(write(tmp_path, text)).endswith("(and 1 more in this file)")


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("", ["empty"]),
        ("# nothing\n", ["empty"]),
        ("- 1\n- 2\n", ["mapping", "list of 2"]),
        ("hello", ["mapping", "'hello'"]),
        ("a: [1, 2\nb: 3", [":2:", "no valid YAML"]),
        ("a: 1\n\tb: 2", [":2:", "no valid YAML"]),
        (MINIMAL + "goal: {}\n", [":6:1:", "goal", "duplicate", "mine.yaml:2:"]),
        (MINIMAL + "<<: {seed: 1}\n", [":6:1:", "merge keys"]),
        (MINIMAL + "[1, 2]: 3\n", [":6:1:", "name of a field"]),
        (MINIMAL + "seed: !!python/object/apply:os.system [id]\n", [":6:1:", "seed", "tag"]),
        (MINIMAL + "seed: !!int abc\n", [":6:7:", "seed", "valid int", "'abc'"]),
        (MINIMAL + "seed: !!bool abc\n", [":6:7:", "seed", "valid bool"]),
        (MINIMAL + "seed: 2022-13-45\n", [":6:7:", "whole number", "'2022-13-45'"]),
        (MINIMAL + f"seed: {'9' * 6000}\n", [":6:7:", "valid int"]),
        (MINIMAL + f"seed: {'9' * 400}\n", [":6:7:", "seed"]),
        (MINIMAL + f"episode_length: {'9' * 400}\n", [":6:17:", "episode_length"]),
        (MINIMAL + "episode_length: 1e999\n", ["episode_length", "finite number", "inf"]),
        (MINIMAL + "arena: {low: [0, 0, 0], high: [2, 2, 0]}\n", ["arena", "z: low 0.0"]),
        (MINIMAL + "name: ../../etc\n", ["name", "text matching"]),
        (MINIMAL + "track: &t [*t]\n", ["duplicate"]),
        ("track: &t [*t]\n", ["32 levels"]),
        ("a: " + "[" * 3000, ["nesting"]),
        ("a: &a [1,1,1,1,1,1,1,1]\nb: &b [*a,*a,*a,*a,*a,*a,*a,*a]\n"
         "c: &c [*b,*b,*b,*b,*b,*b,*b,*b]\nd: &d [*c,*c,*c,*c,*c,*c,*c,*c]\n"
         "e: &e [*d,*d,*d,*d,*d,*d,*d,*d]\nf: &f [*e,*e,*e,*e,*e,*e,*e,*e]\n", ["50000 values"]),
        ("# " + "x" * 300_000, ["256 KiB"]),
        (b"\xff\xfe\x00", ["UTF-8"]),
        ("a: \x07", ["no valid YAML"]),
        ("a: 1\n---\nb: 2\n", ["no valid YAML"]),
        ("a: *nowhere\n", [":1:4:", "no valid YAML"]),
    ],
)  # fmt: skip
def test_bad_file(text, parts, tmp_path):
    path = write(tmp_path, text)
    message = refusal(path)
    assert message.startswith(str(path))
    assert all(part in message for part in parts), message


def test_missing_files_and_folders(tmp_path, monkeypatch):
    message = refusal("levle0")
    assert "no such level file" in message
    assert "did you mean 'level0'" in message
    monkeypatch.chdir(tmp_path)
    assert "did you mean 'level2'" in refusal("level2.yaml")
    assert "folder" in refusal(tmp_path)
    assert "folder or device" in refusal("/dev/zero")
    refusal("\0")
    refusal("x" * 5000)


def test_a_shipped_name_wins_over_a_folder_of_that_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "level0").mkdir()
    assert load_level("level0").name == "level0"


LEAVES = st.one_of(SCALARS, st.lists(st.floats(), max_size=8))
OUR_KEYS = st.sampled_from([*Level.model_fields, "x", "y", "gates", "position", "action", "low"])
THEIR_KEYS = st.sampled_from(
    ["seed", "gates", "obstacles", "task_info", "stabilization_goal", "init_state", "init_x",
     "randomized_init", "init_state_randomization_info", "constraints", "disturbances", "action",
     "dynamics", "disturbance_func", "inertial_prop", "ctrl_freq", "distrib", "low", "high"]
)  # fmt: skip


def trees(keys: st.SearchStrategy[str]) -> st.SearchStrategy[object]:
    return st.recursive(
        LEAVES,
        lambda inner: st.lists(inner, max_size=4) | st.dictionaries(keys, inner, max_size=6),
        max_leaves=12,
    )


garbage = st.one_of(
    st.text(max_size=200),
    st.binary(max_size=200),
    st.text(alphabet="abtruey01.-:[]{},&*!|>'\"#%@\n <?", max_size=120),
    trees(OUR_KEYS).map(yaml.safe_dump),
    st.dictionaries(OUR_KEYS, trees(OUR_KEYS), max_size=8).map(yaml.safe_dump),
    st.dictionaries(THEIR_KEYS, trees(THEIR_KEYS), max_size=10).map(
        lambda tree: yaml.safe_dump({"quadrotor_config": {"randomized_init": False} | tree})
    ),
)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=300)
@given(text=garbage)
def test_garbage_is_refused_and_nothing_else(text, tmp_path):
    path = write(tmp_path, text)
    result = outcome(path)
    assert isinstance(result, Level) or result.startswith(str(path))


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=200)
@given(data=st.data(), name=st.sampled_from(sorted(FILES)))
def test_damaged_competition_file_is_refused_and_nothing_else(data, name, tmp_path):
    text = FILES[name]
    start = data.draw(st.integers(0, len(text)))
    length = data.draw(st.integers(0, 30))
    patch = data.draw(st.text(alphabet="0159.-e[]{}:, \nabx_&*!", max_size=10))
    path = write(tmp_path, text[:start] + patch + text[start + length :])
    result = outcome(path)
    assert isinstance(result, Level) or result.startswith(str(path))
