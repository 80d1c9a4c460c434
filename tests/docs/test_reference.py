"""The reference is what the code is."""

import json
import re
import subprocess
import sys
from importlib.util import find_spec

import jsonschema
import pytest
import typer
from typer.testing import CliRunner

from crazyarena.mocap.zenoh_link import DEFAULT_KEY
from crazyarena.runner.cli import make_app
from crazyarena.runner.records.result_schema import result_schema
from crazyarena.runner.trial.injection import DEFAULT_PREFIX
from crazyarena.safety.estop_sources import ZENOH_KEY, ZENOH_SESSION_KEY
from docs_site import pages
from tests.docs.blocks import ROOT
from tests.runner.fakes import controller

HOVER = "if time == 0: return Command.TAKEOFF, [0.75, 1.0]\n        return Command.NONE, []"


def test_every_command_and_option_is_told():
    text = pages.command_line()
    root = typer.main.get_command(make_app())
    for name, command in root.commands.items():
        section = text.partition(f"## crazyarena {name}\n")[2].partition("\n## ")[0]
        assert section, name
        for parameter in command.params:
            told = parameter.opts[0] if parameter.opts[0].startswith("-") else ""
            assert told in section, (name, parameter.opts)


def test_every_field_of_a_level_is_told():
    text = pages.level_fields()
    from crazyarena.levels.schema import Level

    for field in Level.model_fields:
        assert f"| `{field}` |" in text
    assert "1337" in text
    # Links lead to a heading of the page.
    headings = {heading.lower() for heading in re.findall(r"^## (\w+)$", text, re.MULTILINE)}
    assert set(re.findall(r"\]\(#(\w+)\)", text)) <= headings


def test_every_topic_is_told():
    text = pages.recording()
    for topic in ("/state", "/command", "/referee", "/pose", "/event", "/scene", "/gate"):
        assert f"## {topic}\n" in text
    assert "float64[4] rotor_force" in text


def test_the_zenoh_keys_are_told():
    text = (ROOT / "docs" / "reference" / "zenoh.md").read_text()
    for key in (DEFAULT_KEY, DEFAULT_PREFIX, ZENOH_KEY, ZENOH_SESSION_KEY):
        assert f"`{key}" in text


@pytest.mark.parametrize(
    ("source", "options"),
    [
        (controller(HOVER), ["--set", "episode_length=1.0", "--episodes", "2"]),
        (controller("raise ValueError('lost')"), []),
        (controller(HOVER), ["--level", "sim2real", "--set", "episode_length=2.0"]),
    ],
)
def test_results_are_as_the_schema_says(tmp_path, source, options):
    (tmp_path / "pilot.py").write_text(source)
    out = tmp_path / "out"
    words = ["dry-run", tmp_path / "pilot.py", "--no-figure", "--out", out, *options]
    CliRunner().invoke(make_app(), [str(word) for word in words])
    schema = result_schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    jsonschema.validate(
        json.loads((out / "result.json").read_text()), schema, jsonschema.Draft202012Validator
    )


def test_the_schema_refuses_what_is_none():
    schema = result_schema()
    for document in ({}, {"format": 1}, {"format": 2, "episodes": []}):
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate(document, schema, jsonschema.Draft202012Validator)


def test_every_page_has_a_place():
    menu = (ROOT / "mkdocs.yml").read_text()
    optional = {file for _, _, file in pages.OPTIONAL}
    made = set(pages.generated())
    for page in (ROOT / "docs").rglob("*.md"):
        name = page.relative_to(ROOT / "docs").as_posix()
        assert f": {name}\n" in menu or name in optional, name
    for name in re.findall(r": ([\w/-]+\.md)$", menu, re.MULTILINE):
        assert (ROOT / "docs" / name).is_file() or name in made, name


@pytest.mark.slow
@pytest.mark.skipif(find_spec("mkdocs") is None, reason="the extra 'docs' is not installed")
def test_the_site_builds_without_a_warning(tmp_path):
    built = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "-q", "-d", str(tmp_path / "site")],
        cwd=ROOT, capture_output=True, text=True, timeout=240, check=False,
    )  # fmt: skip
    assert built.returncode == 0, built.stdout + built.stderr
    assert (tmp_path / "site" / "reference" / "result.schema.json").is_file()
