"""What controllers of 2022 draw with PyBullet, or its stand-in, reaches recordings and viewers."""

import importlib.machinery
import sys

import numpy as np
import pytest

from crazyarena.runner.contestant.contract_2022.drawn import MOST, Drawn
from crazyarena.runner.dry_run import DryRun
from crazyarena.runner.viewer.recorded import read_flight

DRAWS = """
import os
import pybullet as p
from competition_utils import Command, draw_trajectory
import numpy as np

class Controller:
    def __init__(self, initial_obs, initial_info, use_firmware=False, verbose=False):
        self.client = initial_info["pyb_client"]
        way = np.linspace(0.0, 1.0, 100)
        draw_trajectory(initial_info, np.array([[0.0, 0, 1], [1, 0, 1]]), way, 0 * way, 1 + way)
        self.steps = 0

    def cmdFirmware(self, time, obs, reward=None, done=None, info=None):
        self.steps += 1
        if self.steps == 20:
            p.addUserDebugLine([0, 0, 0], [0, 0, 2], lineColorRGB=[0, 1, 0],
                               physicsClientId=self.client)
        if self.steps == 1:
            return Command.TAKEOFF, [1.0, 1.0]
        return Command.NONE, []
"""


@pytest.fixture(params=["installed or not", "not installed"])
def pybullet(request, monkeypatch):
    monkeypatch.delitem(sys.modules, "pybullet", raising=False)
    if request.param == "not installed":
        find = importlib.machinery.PathFinder.find_spec
        monkeypatch.setattr(
            importlib.machinery.PathFinder,
            "find_spec",
            lambda name, *args: None if name == "pybullet" else find(name, *args),
        )


def drawn_in(file):
    """(time, number of points of each line, centres of spheres) at each change."""
    found = []
    for time, entities in read_flight(file).updates:
        for entity in entities:
            if entity["id"] == "drawings":
                lines = [len(line["points"]) for line in entity["lines"]]
                found.append((time, lines, len(entity["spheres"])))
    return found


def fly(tmp_path, sandbox):
    from crazyarena.runner.trial.options import FlightOptions

    file = tmp_path / "draws.py"
    file.write_text(DRAWS)
    run = DryRun(
        file, "level0", ["episode_length=2"], episodes=2, out=tmp_path / "out", figure="none",
        options=FlightOptions(sandbox=sandbox),
    )  # fmt: skip
    run.run()
    return [drawn_in(tmp_path / "out" / f"episode_00{k}.mcap") for k in range(2)]


def test_lines_and_waypoints_are_recorded(tmp_path, pybullet):
    first, second = fly(tmp_path, sandbox=False)
    # One polyline of its fifty pieces; the line of step 20 comes with the next news.
    assert first[0] == (0.0, [50], 2)
    assert [(lines, spheres) for _, lines, spheres in first[1:]] == [([50, 2], 2)]
    assert 0.6 < first[1][0] < 0.7
    # The same controller flies on: what it has drawn is still there.
    assert second == [(0.0, [50, 2], 2)]


def test_they_come_out_of_a_sandbox_too(tmp_path):
    first, _ = fly(tmp_path, sandbox=True)
    assert first[0] == (0.0, [50], 2)
    assert first[1][1:] == ([50, 2], 2)


def test_what_is_removed_goes_and_the_newest_stay():
    drawn = Drawn()
    for k in range(MOST + 5):
        drawn.addUserDebugLine(k, [k, 0, 0], [k, 1, 0])
    items = drawn.news(0)
    assert len(items) == MOST
    assert items[0][1][0] == (5.0, 0.0, 0.0)
    drawn.removeUserDebugItem(None, MOST)
    assert drawn.news(1) is None
    assert len(drawn.news(100)) == MOST - 1
    drawn.loadURDF(1, "a/sphere.urdf", [0, 0, 1])
    drawn.loadURDF(2, "a/gate.urdf", [0, 0, 1])
    drawn.removeAllUserDebugItems(None)
    assert [item[0] for item in drawn.news(200)] == ["points"]
    drawn.removeBody(None, 1)
    assert drawn.news(300) == []
    assert drawn.news(400) is None


@pytest.mark.parametrize("place", [[np.nan, 0, 0], [0, 0], "abc", None, ["x", 1, 2]])
def test_what_is_no_place_is_not_shown_and_harms_nobody(place):
    import types

    from crazyarena.runner.contestant.contract_2022 import drawn as module

    module.DRAWN.clear()
    assert module.DRAWN.news(0) is None
    fake = types.SimpleNamespace(addUserDebugLine=lambda *args, **options: 7)
    module.patch(fake)
    assert fake.addUserDebugLine(place, [0, 0, 1]) == 7
    assert fake.addUserDebugLine([0, 0, 1], [0, 0, 2], nonsense=3, physicsClientId=0) == 7
    module.unpatch(fake)
    fake.addUserDebugLine([0, 0, 1], [0, 0, 3])
    told = module.DRAWN.news(1000)
    module.DRAWN.clear()
    assert len(told) == 1
    assert module.DRAWN.news(0) is None
