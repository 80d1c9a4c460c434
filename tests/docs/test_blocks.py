"""Every command line of README and docs: run as it stands, or at least one that exists.

Blocks marked ``sh`` are run, in the folder that their page names, in the order of the page. Those
that need cameras, radios or an afternoon say ``no-run``, or have no language; of them every line
that begins with ``crazyarena`` must be one that the command line takes. docs/hardware.md and
docs/tutorial.md have tests of their own.
"""

import re
import shlex
import shutil
import sys
from pathlib import Path

import pytest
import typer

from crazyarena.runner.cli import make_app
from tests.docs.blocks import ROOT, blocks, shell

OWN_TESTS = {"hardware.md", "tutorial.md"}
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
ROOT_COMMAND = typer.main.get_command(make_app())
# What installs or tests everything is run by .ci/run, not by a test.
MADE = re.compile(r"^(make |\.ci/run)")
_ANY_FENCE = re.compile(r"^```(?:sh[^\n]*)?\n(.*?)^```", re.MULTILINE | re.DOTALL)


def lines(text):
    """Commands of a block, continued lines joined, comments off."""
    for line in text.replace("\\\n", " ").splitlines():
        words = re.sub(r"\s#\s.*$", "", line).strip().rstrip("&").strip()
        if words and not words.startswith("#"):
            yield words


def in_prose_and_blocks(page):
    text = page.read_text(encoding="utf-8")
    for match in _ANY_FENCE.finditer(text):
        line = text.count("\n", 0, match.start()) + 1
        for command in lines(match[1]):
            command = command.removeprefix(".venv/bin/")
            if command.startswith("crazyarena "):
                yield line, command


COMMANDS = [(page, *found) for page in PAGES for found in in_prose_and_blocks(page)]


@pytest.mark.parametrize(
    ("page", "line", "command"), COMMANDS, ids=[f"{p.name}:{n}" for p, n, _ in COMMANDS]
)
def test_the_command_line_takes_it(page, line, command):
    command = re.split(r"\s(?:\|\|?|>|&&|2>)\s", command)[0]
    words = shlex.split(command.replace("…", ""))[1:]
    words = [word for word in words if word not in ("...", "[...]")]
    if words == ["-h"] or words[0].startswith("--"):
        return
    known = ROOT_COMMAND.commands
    assert words[0] in known, f"{page}:{line}: {command}"
    subcommand = known[words[0]]
    context = typer.Context(subcommand, **subcommand.context_settings)
    parser = subcommand.make_parser(context)
    try:
        # Options must exist and have their values; arguments may stand for something.
        parser.parse_args(args=list(words[1:]))
    except typer.BadParameter.__base__ as error:
        pytest.fail(f"{page}:{line}: {command}: {error.format_message()}")


def test_there_are_commands_to_look_at():
    assert len(COMMANDS) > 40


def run_blocks(page):
    return [b for b in blocks(page) if b.language == "sh" and "no-run" not in b.marks]


RUN = [page for page in PAGES if page.name not in OWN_TESTS and run_blocks(page)]


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("page", RUN, ids=[str(p.relative_to(ROOT)) for p in RUN])
def test_every_block_runs(tmp_path, page):
    """In a copy of what a checkout has, or in an empty folder for those who installed a wheel."""
    if page.parent == ROOT:
        (tmp_path / ".venv").symlink_to(Path(sys.executable).parent.parent)
        for name in ("examples", "docs"):
            (tmp_path / name).symlink_to(ROOT / name)
    for block in run_blocks(page):
        told = "\n".join(line for line in block.text.splitlines() if not MADE.match(line))
        if not told.strip():
            continue
        folder = tmp_path
        if "in" in block.options:
            folder = tmp_path / "copy" / block.options["in"]
            shutil.copytree(ROOT / block.options["in"], folder, dirs_exist_ok=True)
        done = shell(f"set -m\n{told}", folder)
        report = f"{block}\n{told}\n{done.stdout}\n{done.stderr}"
        if block.options.get("exit") == "drawn":  # by luck: the world is a secret one
            assert done.returncode in (0, 1), report
            assert "Results in" in done.stdout, report
        else:
            assert done.returncode == int(block.options.get("exit", 0)), report


def test_what_is_made_has_a_target():
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    assert "make test" in (ROOT / ".ci" / "run").read_text()
    for page in PAGES:
        for block in run_blocks(page):
            for line in lines(block.text):
                if not line.startswith("make "):
                    continue
                wanted = {word for word in line.split()[1:] if "=" not in word}
                assert wanted <= targets, f"{block}: {line}"
