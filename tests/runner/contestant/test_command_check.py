"""What a controller may return, and what it is told when it returns something else."""

from enum import Enum

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyarena.crazyswarm_compat import commands as cs
from crazyarena.errors import CommandError
from crazyarena.runner.contestant.contract_2022.command_check import FINISHED, VERBS, checked
from crazyarena.runner.contestant.contract_2022.names.competition_utils import Command

Other = Enum("Other", dict(VERBS))
V = [1.0, 2.0, 3.0]


def test_enumeration_is_the_contracts():
    assert {c.name: c.value for c in Command} == VERBS


@pytest.mark.parametrize("enum", [Command, Other])
def test_commands_are_told_by_name_or_value(enum):
    asked = checked((enum.FULLSTATE, [V, [0, 0, 0], np.zeros(3), 0.5, V]), 0).command
    assert isinstance(asked, cs.FullState)
    np.testing.assert_array_equal(asked.position, V)
    assert asked.yaw == 0.5
    assert checked((enum.TAKEOFF, [1, 2]), 0).command == cs.Takeoff(1.0, 2.0)
    assert checked((enum.LAND, [0.02, 2]), 0).command == cs.Land(0.02, 2.0)
    assert checked((enum.STOP, []), 0).command == cs.Stop()
    assert checked((enum.NOTIFYSETPOINTSTOP, []), 0).command == cs.NotifySetpointsStop()
    go_to = checked((enum.GOTO, [V, 0.1, 2.5, False]), 0).command
    assert (go_to.yaw, go_to.duration, go_to.relative) == (0.1, 2.5, False)
    assert checked((enum.FINISHED, []), 0).verb == FINISHED
    assert checked((enum.NONE, None), 0).command is None


def test_the_controllers_array_may_change_afterwards():
    position = np.array(V)
    asked = checked((Command.FULLSTATE, [position, V, V, 0, V]), 0).command
    position[0] = 99
    assert asked.position[0] == 1.0


def test_column_vectors_pass():
    asked = checked((Command.FULLSTATE, [np.array([V]).T, V, V, np.array([0.2]), V]), 0).command
    np.testing.assert_array_equal(asked.position, V)


@pytest.mark.parametrize(
    ("returned", "message"),
    [
        (None, "expected (Command, args)"),
        ((Command.NONE,), "expected (Command, args)"),
        (("TAKEOFF", [1, 2]), "expected a member of competition_utils.Command"),
        ((17, []), "expected a member of competition_utils.Command"),
        ((Command.TAKEOFF, ["1.0", 2]), "argument 'height' is text, '1.0' (str); expected one"),
        ((Command.TAKEOFF, [1, b"2"]), "argument 'duration' is text"),
        ((Command.GOTO, [["1", 2, 3], 0, 1, False]), "argument 'position' holds text"),
        ((Command.GOTO, [np.array(["1", "2", "3"]), 0, 1, False]), "'position' holds text"),
        ((Command.GOTO, [np.array([1, "2", 3], object), 0, 1, False]), "'position' holds text"),
        ((Command.GOTO, ["123", 0, 1, False]), "'position' holds text"),
        ((Command.FULLSTATE, [V, V, V, np.array("0.5"), V]), "argument 'yaw' is text"),
        ((Command.TAKEOFF, [1]), "TAKEOFF got 1 arguments; expected 2"),
        ((Command.TAKEOFF, 3), "arguments of TAKEOFF are 3 (int)"),
        ((Command.TAKEOFF, [1, 0]), "argument 'duration' is 0.0; expected more than 0 s"),
        (
            (Command.TAKEOFF, ["high", 1]),
            "argument 'height' is text, 'high' (str); expected",
        ),
        ((Command.LAND, [float("nan"), 1]), "LAND argument 'height' is nan"),
        ((Command.GOTO, [1, 2, 3, 0, 2.5, False]), "expected 4 arguments: [[x, y, z], yaw"),
        ((Command.GOTO, [V, 0, 2.5, "no"]), "'relative' is 'no' (str)"),
        ((Command.GOTO, [V[:2], 0, 2.5, False]), "'position' has shape (2,)"),
        ((Command.FULLSTATE, [V, V, V, 0]), "FULLSTATE got 4 arguments"),
        ((Command.FULLSTATE, [V, [0, np.inf, 0], V, 0, V]), "'velocity' is [0.0, inf, 0.0]"),
        ((Command.FULLSTATE, [V, V, V, 0, [0, 0, None]]), "'rpy_rates'"),
        (
            (Command.FULLSTATE, [V, V, ["a", 0, 0], 0, V]),
            "'acceleration' holds text, ['a', 0, 0]",
        ),
        ((Command.FULLSTATE, [V, V, V, None, V]), "'yaw' is None"),
    ],
)
def test_errors_name_step_command_and_argument(returned, message):
    with pytest.raises(CommandError) as caught:
        checked(returned, 12)
    assert str(caught.value).startswith("step 12: ")
    assert message in str(caught.value)


junk = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=3),
    lambda inner: st.lists(inner, max_size=5) | st.tuples(inner, inner),
    max_leaves=8,
)


@given(st.sampled_from(list(Command)), junk)
def test_anything_is_a_command_or_a_command_error(command, args):
    try:
        verb = checked((command, args), 3).verb
    except CommandError:
        return
    assert verb == command.value
