"""The vehicles of virtual-cf as a viewer sees them."""

from __future__ import annotations

import numpy as np

from crazyarena.live import ID, POSITION, Live, Watched
from crazyarena.runner.viewer import virtual_fleet
from crazyarena.sim_backend.arena import ArenaFleet
from crazyarena.viewer_process import View, ViewOptions
from tests.waiting import eventually


def test_vehicles_are_shown_where_they_truly_are(monkeypatch, tmp_path):
    class Silent(View):
        def __init__(self, options, say, vehicles=1):
            self.live = Live(vehicles, tmp_path)
            self._viewer = None

    monkeypatch.setattr(virtual_fleet, "View", Silent)
    fleet = ArenaFleet([[0.0, 0.0, 0.0], [1.0, 0.5, 0.0]], ids=[3, 9])
    shown = virtual_fleet.ShownFleet(fleet, "level0", ViewOptions(), print)
    try:
        watched = Watched(next(tmp_path.glob("*.live")))
        eventually(lambda: watched.state() is not None)
        state = watched.state()
        np.testing.assert_array_equal(state.rows[:, ID], [3, 9])
        np.testing.assert_allclose(state.rows[1, POSITION : POSITION + 2], [1.0, 0.5])
        assert state.facts["phase"] == "0 of 2 fly"
        assert state.facts["battery"] > 3.0
        assert watched.scene()["vehicles"] == ["cf3", "cf9"]
    finally:
        shown.close()
    assert watched.over
