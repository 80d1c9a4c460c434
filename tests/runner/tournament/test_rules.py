"""Rule sets that people write."""

from __future__ import annotations

import pytest

from crazyarena.errors import InputError
from crazyarena.runner.tournament.rules import Lives, load_rules, parse_rules, shipped_rules


def test_shipped_ones_load():
    assert shipped_rules() == ("iros2022", "lsy")
    rules, text = load_rules("iros2022")
    assert [c.points for c in rules.categories] == [(20.0, 10.0, 5.0)] * 2 or [
        list(c.points) for c in rules.categories
    ] == [[20, 10, 5]] * 2
    assert rules.controller is Lives.LEVEL
    assert parse_rules(text) == rules
    assert load_rules("lsy")[0].qualification.rate == 0.5


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "expected a rule set"),
        ("[1, 2]", "expected a rule set"),
        ("name: x", "categories: missing"),
        ("name: x\ncategories: []", "categories"),
        ("name: x\ncategories: [{name: a}]", "expected points in a category"),
        ("name: x\ncategories: [{name: a, points: [5, 10]}]", "do not grow"),
        ("name: x\ncategories: [{name: a, points: [.nan]}]", "points"),
        ("name: x\ncategories: [{name: a, point: [5]}]", "did you mean 'points'"),
        ("name: x\ncategories: [{name: a, points: [5], statistic: mode}]", "statistic"),
        ("name: x\ncategories: [{name: a, points: [5]}, {name: a}]", "one name"),
        ("name: x\nqualification: {rate: 1.5}\ncategories: [{name: a, points: [5]}]", "<= 1"),
        ("name: x\nqualification: {rate: 50%}\ncategories: [{name: a, points: [5]}]", "rate"),
        ("name: x\nqualification: {episodes: successful}\ncategories: [{name: a, points: [5]}]",
         "expected last or all"),
        ("name: [", "no valid YAML"),
    ],
)  # fmt: skip
def test_wrong_ones_are_refused_with_file_and_field(tmp_path, text, words):
    file = tmp_path / "own.yaml"
    file.write_text(text)
    with pytest.raises(InputError) as error:
        load_rules(str(file))
    assert str(file) in str(error.value)
    assert words in str(error.value)


def test_a_name_that_is_none():
    with pytest.raises(InputError, match="shipped: iros2022, lsy"):
        load_rules("iros2023")
