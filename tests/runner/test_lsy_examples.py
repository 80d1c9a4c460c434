"""The two examples for lsy_drone_racing's contract."""

from pathlib import Path

import pytest

from crazyarena.runner.lsy_run import LsyRun

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.mark.parametrize("mode", ["state", "attitude"])
def test_examples_pass_the_gates_of_a_level_that_moves(mode):
    """One episode here; what share of many they pass is in docs/lsy.md."""
    overrides = [f"env.control_mode={mode}"]
    run = LsyRun(EXAMPLES / f"racer_{mode}", "lsy/level1", overrides, seed=2)
    result = run.run()
    assert result.clean, result.episodes[0]
    assert result.mean_time < 6.5


def test_both_plan_by_the_same_files():
    """A controller is copied with its folder alone, so each has its own."""
    for name in ("pilot.py", "route.py"):
        one, two = (EXAMPLES / f"racer_{mode}" / name for mode in ("state", "attitude"))
        assert one.read_bytes() == two.read_bytes()
