"""Whatever a file holds or is: a value, or one line that says where it is wrong."""

import os

import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyarena.bounded_read import parse_yaml, read_json, read_text
from crazyarena.errors import InputError


def refused(call):
    with pytest.raises(InputError) as error:
        call()
    text = str(error.value)
    assert len(text.splitlines()) == 1
    assert len(text) < 1000
    return text


@given(st.binary(max_size=200))
def test_any_bytes(tmp_path_factory, data):
    file = tmp_path_factory.mktemp("any") / "file"
    file.write_bytes(data)
    for read in (
        lambda: read_json(file, "thing"),
        lambda: parse_yaml(read_text(file, "thing"), str(file)),
    ):
        told = ""
        try:
            read()
        except InputError as error:
            told = str(error)
        assert not told or str(file) in told
        assert len(told.splitlines()) <= 1


def test_no_text(tmp_path):
    file = tmp_path / "file"
    file.write_bytes(b"one\ntwo \xff")
    assert f"{file}:2" in refused(lambda: read_text(file, "track"))


@pytest.mark.parametrize("make", [os.mkdir, os.mkfifo, lambda path: None])
def test_no_file(tmp_path, make):
    file = tmp_path / "file"
    make(file)
    assert str(file) in refused(lambda: read_text(file, "track"))


def test_a_sparse_terabyte(tmp_path):
    file = tmp_path / "file"
    with open(file, "wb") as stream:
        stream.truncate(1 << 40)
    assert "16 MiB" in refused(lambda: read_text(file, "track"))


def test_json_that_is_deep_or_long(tmp_path):
    file = tmp_path / "file"
    for text, words in (
        ("[" * 100_000, "deep"),
        ("9" * 100_000, "digits"),
        ('{"a": 1,\n  "b": }', ":2:8: "),
    ):
        file.write_text(text)
        assert words in refused(lambda: read_json(file, "track"))


def test_yaml_that_grows():
    lines = ["a: &a [x, x, x, x, x, x, x, x, x, x]"]
    for before, name in zip("abcdefgh", "bcdefghi", strict=True):
        lines.append(f"{name}: &{name} [{', '.join([f'*{before}'] * 10)}]")
    assert "aliases" in refused(lambda: parse_yaml("\n".join(lines), "fleet.yaml"))
    assert "nesting" in refused(lambda: parse_yaml("[" * 10_000, "fleet.yaml"))
    assert "fleet.yaml:3:1: " in refused(lambda: parse_yaml("a: 1\nb: [\n", "fleet.yaml"))
    assert parse_yaml("a: &x [1, 2]\nb: *x", "fleet.yaml") == {"a": [1, 2], "b": [1, 2]}
