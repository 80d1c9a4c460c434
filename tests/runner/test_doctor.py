"""What the doctor says of a machine."""

import sys

from typer.testing import CliRunner

from crazyarena import jit
from crazyarena.runner import doctor
from crazyarena.runner.cli import make_app
from crazyarena.runner.warm_up import PARTS, missing


def test_every_line_that_does_not_work_has_a_remedy():
    lines = list(doctor.examine())
    assert {line.name for line in lines} >= {"python", "compile cache", "sandbox", "radio", "zenoh"}
    for line in lines:
        assert line.found
        if line.works is not True and line.name != "display":
            assert line.remedy, line.name


def test_a_missing_package_names_the_command_that_brings_it(monkeypatch):
    monkeypatch.setattr(doctor, "find_spec", lambda name: None)
    line = next(line for line in doctor.examine() if line.name == "viewer")
    assert line.works is None
    assert line.remedy == "pip install 'crazyarena[viewer]'"


def test_an_empty_cache_is_told(tmp_path, monkeypatch):
    monkeypatch.setattr(jit, "cache_folder", lambda: tmp_path)
    assert missing(list(PARTS)) == list(PARTS)
    line = next(line for line in doctor.examine() if line.name == "compile cache")
    assert line.works is None
    assert "not compiled yet" in line.found or str(tmp_path) in line.found


def test_an_old_python_is_an_error(monkeypatch):
    monkeypatch.setattr(sys, "version_info", (3, 10, 0))
    monkeypatch.setattr(doctor, "examine", lambda: iter([doctor._python()]))
    result = CliRunner().invoke(make_app(), ["doctor"])
    assert result.exit_code == 1
    assert "3.11 or newer" in result.output
