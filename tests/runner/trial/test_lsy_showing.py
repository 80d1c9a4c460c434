"""What viewers are told of a flight in lsy_drone_racing's simulation."""

from __future__ import annotations

import numpy as np
import pytest

from crazyarena.live import POSITION, Live, Watched
from crazyarena.runner.lsy_run import LsyRun
from crazyarena.runner.trial.lsy_showing import LsyShowing
from tests.runner.lsy_controllers import STATE


class Seen(LsyShowing):
    """Looks, as a viewer does, after every step."""

    def __init__(self, live, *arguments, **options):
        super().__init__(live, *arguments, **options)
        self.watched = Watched(live.file)
        self.places, self.drawn, self.scenes = [], 0, []

    def begin(self, index, draw):
        super().begin(index, draw)
        self.scenes.append(self.watched.scene())

    def step(self, time, row, verdict, drawings):
        self._published = -1e9  # every step has its picture
        super().step(time, row, verdict, drawings)
        state = self.watched.state()
        self.places.append((state.facts["time"], *state.rows[0, POSITION : POSITION + 3]))
        drawn = self.watched.scene()["drawn"]
        self.drawn += bool(drawn and drawn[0]["lines"] and drawn[0]["spheres"])


@pytest.fixture
def live(tmp_path):
    live = Live(1, tmp_path)
    yield live
    live.close()


def fly(tmp_path, live=None, **options):
    file = tmp_path / "mine.py"
    file.write_text(STATE)
    run = LsyRun(file, "lsy/level2", seed=4, out=tmp_path / f"out{live is None}", **options)
    if live is not None:
        run._show = Seen(live, run.level, 1, pace=0.0)
    return run.run(), run._show


def test_a_viewer_sees_track_path_drawings_and_end(tmp_path, live):
    result, seen = fly(tmp_path, live)
    (scene,) = seen.scenes
    assert {"gate 0", "gate 3", "obstacle 0"} <= {entity["id"] for entity in scene["track"]}
    assert scene["track"][0]["cubes"][0]["pose"] != scene["nominal"][0]["cubes"][0]["pose"]
    assert scene["arena"]["low"] == [-2.5, -1.5, -0.001]
    (episode,) = result.episodes
    assert len(seen.places) == episode.steps == seen.drawn
    assert seen.places[-1][0] == episode.flight_time
    points, count = seen.watched.paths()
    assert count == episode.steps
    assert np.allclose(points[0], np.array(seen.places)[:, 1:], atol=1e-5)
    facts = seen.watched.state().facts
    assert facts["phase"] in ("complete", "fail")
    assert facts["why"] == episode.why
    assert facts["events"][-1][1] == episode.termination


def test_a_flight_that_is_watched_is_the_same(tmp_path, live):
    fly(tmp_path, live)
    fly(tmp_path)
    one, two = (tmp_path / f"out{name}" / "episode_000.mcap" for name in (True, False))
    assert one.read_bytes() == two.read_bytes()
