"""What comes before what, when processors are short."""

import os
from dataclasses import replace

import pytest

from crazyarena.runner.contestant.sandbox import quota
from crazyarena.runner.contestant.sandbox.process import Sandboxed
from tests.runner.contestant.test_hostile import LIMITS
from tests.runner.fakes import controller
from tests.runner.hostile import IMPORTS


@pytest.mark.parametrize("niceness", [0, 3])
def test_all_of_a_contestant_is_as_nice_as_its_limits_say(tmp_path, niceness):
    file = tmp_path / "edit_this.py"
    file.write_text(IMPORTS + controller(step="return Command.NONE, []"))
    mine = os.getpriority(os.PRIO_PROCESS, 0)
    contestant = Sandboxed(file, replace(LIMITS, niceness=niceness))
    try:
        family = quota.descendants(contestant._process.pid)
        found = {os.getpriority(os.PRIO_PROCESS, pid) for pid in family}
    finally:
        contestant.close()
    assert found == {niceness or mine}
