"""Draw files."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyarena.errors import InputError
from crazyarena.levels import load_level
from crazyarena.levels.draw_file import dump_draw, read_draw
from crazyarena.levels.lsy import lsy_text


@given(
    st.lists(st.integers(0, 2**128 - 1), min_size=1, max_size=20),
    st.sampled_from(["level0", "level3", "sim2real", "getting_started"]),
)
def test_what_is_written_is_read(tmp_path_factory, seeds, name):
    file = tmp_path_factory.mktemp("draw") / "draw.yaml"
    level = load_level(name)
    file.write_text(dump_draw(level, seeds, "fixed=2"))
    drawn = read_draw(file)
    assert drawn.level == level
    assert drawn.seeds == tuple(seeds)
    assert drawn.file.compute == "fixed=2"


def test_levels_of_lsy_lie_beside_it(tmp_path):
    (tmp_path / "mine.toml").write_text(lsy_text("lsy/level2"))
    file = tmp_path / "draw.yaml"
    file.write_text(dump_draw("mine.toml", [5], "free", ["env.control_mode=attitude"]))
    drawn = read_draw(file)
    assert drawn.level.name == "mine"
    assert drawn.level.env.control_mode == "attitude"
    file.write_text(dump_draw("lsy/level1", [5], "free"))
    assert read_draw(file).level.name == "lsy-level1"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "expected a draw file"),
        ("seeds: [1]", "expected either level or lsy_level"),
        ("seeds: [1]\nlsy_level: lsy/level0\nlevel: {}", "expected either level or lsy_level"),
        ("lsy_level: lsy/level0", "seeds: missing"),
        ("seeds: []\nlsy_level: lsy/level0", "seeds"),
        ("seeds: [-1]\nlsy_level: lsy/level0", "seeds[0]"),
        ("seeds: [1.5]\nlsy_level: lsy/level0", "seeds[0]"),
        (f"seeds: [{2**128}]\nlsy_level: lsy/level0", "seeds[0]"),
        ("draw: 2\nseeds: [1]\nlsy_level: lsy/level0", "draw"),
        ("seeds: [1]\nlevel: {name: x}", "start: missing"),
        ("seeds: [1]\nlsy_level: ../level.toml", "expected a file beside this one"),
        ("seeds: [1]\nlsy_level: gone.toml", "no such level file"),
        ("seeds: [1]\nsead: 1\nlsy_level: lsy/level0", "unknown field"),
        ("seeds: [1]\nlevel: {name: x}\noverrides: [a=1]", "only for lsy_level"),
    ],
)
def test_wrong_ones_are_refused_with_file_and_field(tmp_path, text, words):
    file = tmp_path / "draw.yaml"
    file.write_text(text)
    with pytest.raises(InputError) as error:
        read_draw(file)
    assert str(file.parent) in str(error.value)
    assert words in str(error.value)


def test_one_that_is_not_there(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_draw(tmp_path / "none.yaml")
