"""What a student reads after each of the usual mistakes, at 80 columns: word for word.

``REWRITE_GOLDEN=1 pytest tests/runner/cli/test_mistakes.py`` writes the files anew; read the
difference before you commit it.
"""

import os
import re
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from crazyarena.runner.cli import make_app
from crazyarena.runner.contestant.compute import Budget
from crazyarena.runner.records import outcome_table
from crazyarena.runner.trial.options import FlightOptions
from tests.runner.fakes import controller

GOLDEN = Path(__file__).parent / "mistakes"
UP = "if time == 0: return Command.TAKEOFF, [1.0, 1.0]\n        "
THEN = "if len(self.calls) == {at}: return {what}\n        "
NONE = "return Command.NONE, []"


def then(*steps):
    """A controller that takes off, and then does something at certain steps."""
    return controller(UP + "".join(THEN.format(at=at, what=what) for at, what in steps) + NONE)


# name: (source of the submission, options)
MISTAKES = {
    "wrong_class": (controller().replace("class Controller", "class MyController"), ()),
    "syntax_error": (controller("return Command.NONE, [").replace("pass", "x ="), ()),
    "missing_import": ("import no_such_package\n" + controller(), ()),
    "exception_in_init": (controller(init="self.path = initial_info['waypoints']"), ()),
    "wrong_constructor": (controller().replace("initial_obs, initial_info, ", ""), ()),
    "no_cmd_firmware": (controller().replace("def cmdFirmware", "def cmd_firmware"), ()),
    "wrong_argument_count": (then((30, "Command.GOTO, [[1, 1, 1], 0.0]")), ()),
    "method_takes_too_few": (controller().replace(", reward=None, done=None, info=None", ""), ()),
    "returns_none": (controller("return None"), ()),
    "returns_command_only": (controller("return Command.NONE"), ()),
    "unknown_command": (controller("return 12, []"), ()),
    "command_as_text": (controller("return 'TAKEOFF', [1.0, 1.0]"), ()),
    "misspelt_command": (controller("return Command.TAKE_OFF, [1.0, 1.0]"), ()),
    "not_a_number": (controller("return Command.TAKEOFF, [float('nan'), 1.0]"), ()),
    "position_as_text": (then((30, "Command.GOTO, ['a', 0.0, 1.0, False]")), ()),
    "forgotten_takeoff": (controller(), ()),
    "gate_hit": (then((60, "Command.GOTO, [[1.2, -2.68, 1.0], 0.0, 3.0, False]")), ()),
    "out_of_the_arena": (then((60, "Command.GOTO, [[-0.9, -6.0, 1.0], 0.0, 3.0, False]")), ()),
    "never_lands_or_moves": (then(), ("--set", "episode_length=4.0")),
    "stops_in_the_air": (then((60, "Command.STOP, []")), ()),
    "finished_too_early": (then((40, "Command.FINISHED, []")), ()),
    "slow_step": (
        controller("import time as t; t.sleep(0.05)\n        " + NONE),
        ("--set", "episode_length=0.4"),
    ),
    "endless_loop": (controller(UP + "while len(self.calls) > 4: pass\n        " + NONE), ()),
    "prints_too_much": (
        then((9, "1 / 0")).replace("self.calls.append", "print('at', time); self.calls.append"),
        (),
    ),
    "exits": (then((20, "exit(3)")), ()),
    "exception_in_flight": (then((40, "self.waypoints[7]")), ()),
}  # fmt: skip


def masked(text, folder, slow):
    """What is of this machine or this moment is not looked at: folders, times of computing."""
    text = text.replace(str(folder), "FOLDER")
    # Frames of Python's own modules, and marks below lines, are not the same in all versions.
    text = re.sub(r'^  File "(?!FOLDER).*\n(?:    .*\n)*', "", text, flags=re.M)
    text = re.sub(r"^ +[~^]+ *\n", "", text, flags=re.M)
    if not slow:  # but only the machine, busy with other things
        text = re.sub(r"^Slow:.*?(?:would come late|a command|after [\d.]+ s)\n", "", text,
                      flags=re.M | re.S)  # fmt: skip
    text = re.sub(r"B [\d.]+ s", "B TIME s", text)
    return "\n".join(map(str.rstrip, text.splitlines())).strip("\n") + "\n"


@pytest.fixture
def tell(tmp_path, monkeypatch):
    """Flies a submission as a student does, and returns what the terminal shows."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("TERM", "dumb")
    # The times decide how much room the table has for words.
    monkeypatch.setattr(outcome_table, "computing", lambda milliseconds: "0.12/0.34")

    def run(source, *options, slow=False):
        (tmp_path / "pilot.py").write_text(source)
        arguments = ["dry-run", "pilot.py", "--episodes", "1", "--out", "r", "--no-record"]
        result = CliRunner().invoke(make_app("dry_run"), [*arguments, "--no-figure", *options])
        return f"exit code {result.exit_code}\n{masked(result.output, tmp_path, slow)}"

    return run


@pytest.fixture
def hurried(monkeypatch):
    """Steps may take 2 s and not 30."""
    wait = FlightOptions.deadlines

    def deadlines(options, level):
        found = wait(options, level)
        return replace(found, compute=replace(found.compute, budget=Budget(step=2.0)))

    monkeypatch.setattr(FlightOptions, "deadlines", deadlines)


@pytest.mark.parametrize("name", MISTAKES)
@pytest.mark.usefixtures("hurried")
def test_what_a_student_reads(tell, name):
    source, options = MISTAKES[name]
    told = tell(source, *options, slow=name == "slow_step")
    golden = GOLDEN / f"{name}.txt"
    if os.environ.get("REWRITE_GOLDEN"):
        golden.write_text(told)
    assert told == golden.read_text()
    assert not told.startswith("exit code 0")


def test_every_golden_file_is_of_a_mistake():
    assert {file.stem for file in GOLDEN.glob("*.txt")} == set(MISTAKES)
    assert len(MISTAKES) >= 20


def test_no_row_of_a_table_is_wider_than_the_terminal():
    for file in GOLDEN.glob("*.txt"):
        lines = file.read_text().splitlines()
        rows = [line for line in lines if line.endswith("0.12/0.34") or "──" in line]
        assert len(rows) == (0 if lines[0] == "exit code 2" else 2), file.name
        assert all(len(row) <= 80 for row in rows), file.name
