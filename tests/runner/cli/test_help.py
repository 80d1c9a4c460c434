"""The command line explains itself: whole sentences, exit code 0, short forms."""

import pytest
import typer
from typer.testing import CliRunner

from crazyarena import __version__
from crazyarena.runner.cli import make_app

COMMANDS = typer.main.get_command(make_app()).commands
GIVEN = {"--help", "--install-completion", "--show-completion"}  # by typer


def run(*arguments):
    return CliRunner().invoke(make_app(), arguments)


@pytest.mark.parametrize("arguments", [(), ("-h",), ("--help",), ("dry-run", "-h")])
def test_help_is_no_error(arguments):
    result = run(*arguments)
    assert result.exit_code == 0
    assert "Usage:" in result.output


def test_version():
    result = run("--version")
    assert result.output.strip() == f"crazyarena {__version__}"


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_every_command_and_option_says_what_it_does(name):
    command = COMMANDS[name]
    assert command.short_help.endswith((".", ":"))
    assert command.short_help[0].isupper()
    for parameter in command.params:
        if parameter.opts[0] in GIVEN:
            continue
        text = getattr(parameter, "help", None)
        assert text, f"{name} {parameter.opts[0]} has no help"
        assert text.rstrip().endswith((".", ".)")), f"{name} {parameter.opts[0]}: {text!r}"


def test_the_list_of_commands_cuts_nothing_off():
    assert "..." not in run().output.partition("Commands:")[2]
