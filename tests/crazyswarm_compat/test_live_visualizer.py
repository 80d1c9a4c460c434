"""Scripts in the browser: what is published, at which pace, for which arena."""

from __future__ import annotations

import numpy as np
import pytest

from crazyarena.crazyswarm_compat import crazyswarm1, live_visualizer
from crazyarena.live import COLOUR, ID, POSITION, Live, Watched
from crazyarena.viewer_process import View, ViewOptions
from tests.browser import needs_viser

pytestmark = needs_viser

TWO = """
crazyflies:
  - {id: 1, channel: 80, initialPosition: [0.0, 0.0, 0.0], type: default}
  - {id: 7, channel: 80, initialPosition: [1.0, 0.0, 0.0], type: default}
"""


class Wall:
    def __init__(self):
        self.time = 0.0

    def now(self):
        return self.time

    def sleep_until(self, deadline):
        self.time = max(self.time, deadline)
        return 0.0


@pytest.fixture
def views(monkeypatch, tmp_path):
    """Views that are opened, without a viewer, on a clock of their own."""
    opened = []

    class Silent(View):
        def __init__(self, options, say, vehicles=1):
            self.options = options
            self.live = Live(vehicles, tmp_path)
            self.watched = Watched(self.live.file)
            self._viewer = None
            opened.append(self)

    monkeypatch.setattr(live_visualizer, "View", Silent)
    monkeypatch.setattr(live_visualizer, "WallClock", Wall)
    yield opened
    for view in opened:
        view.close()


def fly(flags=""):
    swarm = crazyswarm1.Crazyswarm(crazyflies_yaml=TWO, args=f"--sim --vis viser {flags}")
    swarm.allcfs.takeoff(targetHeight=1.0, duration=2.0)
    swarm.timeHelper.visualizer.setGraph([(0, 1)])
    swarm.timeHelper.visualizer.showEllipsoids([0.1, 0.1, 0.3])
    swarm.allcfs.crazyflies[0].setLEDColor(1.0, 0.0, 0.5)
    swarm.timeHelper.sleep(3.0)
    return swarm


@pytest.mark.parametrize("flags", ["", "--backend sim"])
def test_a_fleet_is_published_with_what_the_script_draws(views, flags):
    swarm = fly(flags)
    (view,) = views
    state = view.watched.state()
    np.testing.assert_array_equal(state.rows[:, ID], [1, 7])
    heights = state.rows[:, POSITION + 2]
    np.testing.assert_allclose(heights, [1.0, 1.0], atol=0.1)
    np.testing.assert_allclose(state.rows[0, COLOUR : COLOUR + 3], [1.0, 0.0, 0.5])
    assert state.facts["edges"] == [[0, 1]]
    assert state.facts["ellipsoid"] == [0.1, 0.1, 0.3]
    assert view.watched.paths()[1] > 10
    assert view.watched.scene()["vehicles"] == ["cf1", "cf7"]
    swarm.timeHelper.visualizer.close()
    assert view.watched.over


def test_simulated_time_passes_as_time_does(views):
    swarm = fly()
    wall = swarm.timeHelper.visualizer._wall
    assert wall.time == pytest.approx(swarm.timeHelper.time(), abs=2 * swarm.timeHelper.dt)


def test_a_guarded_script_is_shown_in_its_arena(views):
    swarm = fly("--guard level0")
    (view,) = views
    assert view.watched.scene()["arena"]["low"][0] == pytest.approx(-3.0)
    assert view.watched.state().facts["control"] is True
    assert view.watched.state().facts["ladder"] == "NONE"
    swarm.allcfs.guard.finish()
    swarm.allcfs.close()


def test_a_fleet_that_flies_by_itself_is_not_held_up():
    wall = Wall()
    shown = live_visualizer.LiveVisualizer(ViewOptions(), pace=0.0, wall=wall)
    shown._keep_pace(5.0)
    assert wall.time == 0.0
