"""Errors quote strangers; whoever prints them, the terminal obeys nothing of it."""

import subprocess
import sys

import pytest

from crazyarena.crazyswarm_compat.config import load_crazyflies
from crazyarena.errors import CommandError, CrazyarenaError, InputError
from crazyarena.levels import load_level
from crazyarena.sim_backend.vehicles.load import load_vehicle

HOSTILE = '"\\e[2J\\u202ekey": 1\n'


@pytest.mark.parametrize("kind", [CrazyarenaError, InputError, CommandError])
def test_what_is_quoted_is_escaped(kind):
    assert str(kind("a\x1b[2J\x9b\u202e\ud800 größer\nb")) == (
        "a\\x1b[2J\\x9b\\u202e\\ud800 größer\nb"
    )


@pytest.mark.parametrize("load", [load_level, load_vehicle, load_crazyflies])
def test_a_hostile_name_of_a_field_is_only_read(tmp_path, load):
    file = tmp_path / "hostile.yaml"
    file.write_text(HOSTILE)
    with pytest.raises(InputError) as error:
        load(str(file))
    assert str(error.value).isprintable()


def test_a_scripts_traceback_hands_no_control_characters_on(tmp_path):
    """A script is no command of ours: Python itself prints what it does not catch."""
    file = tmp_path / "hostile.yaml"
    file.write_text(HOSTILE)
    code = f"from crazyarena.levels import load_level; load_level({str(file)!r})"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False)
    assert b"InputError" in said.stderr
    assert rb"\x1b[2J\u202ekey" in said.stderr
    assert b"\x1b" not in said.stderr
