"""What a trial publishes of itself, and that it flies the same whether it does or not."""

from __future__ import annotations

import math

import numpy as np
import pytest
from rich.console import Console

from crazyarena.live import POSITION, STOP, VELOCITY, Live, Watched
from crazyarena.runner.dry_run import DryRun
from crazyarena.runner.trial.pace import Pace
from crazyarena.runner.trial.showing import supervisor_words
from crazyarena.viewer_process import View


class Kept(View):
    """A view without a viewer that keeps what was published."""

    def __init__(self, folder):
        self.live = Live(1, folder)
        self._viewer = None
        self.states = []
        self.scenes = []
        publish, scene = self.live.publish, self.live.scene
        self.live.publish = lambda facts: (
            self.states.append((dict(facts), self.live.rows[0].copy())),
            publish(facts),
        )
        self.live.scene = lambda fields: (self.scenes.append(fields), scene(fields))


@pytest.fixture
def view(tmp_path):
    (tmp_path / "live").mkdir()
    view = Kept(tmp_path / "live")
    yield view
    view.close()


def fly(tmp_path, view, level, name, *overrides):
    run = DryRun(
        None,
        level,
        overrides,
        episodes=1,
        seed=5,
        out=tmp_path / name,
        figure=False,
        console=Console(quiet=True),
        view=view,
        pace=0.0,
    )
    return run.run()


@pytest.mark.parametrize("level", ["level3", "sim2real"])
def test_a_flight_is_the_same_whether_it_is_shown_or_not(tmp_path, view, level):
    shown = fly(tmp_path, view, level, "a", "episode_length=3.0")
    other = fly(tmp_path, None, level, "b", "episode_length=3.0")
    assert shown.episodes[0].steps == other.episodes[0].steps
    if level == "level3":  # thinking costs wall time on the other
        files = [tmp_path / run / "episode_000.mcap" for run in "ab"]
        assert files[0].read_bytes() == files[1].read_bytes()


def test_a_competition_flight_shows_its_state_and_end(tmp_path, view):
    result = fly(tmp_path, view, "level0", "out")
    paths, _ = Watched(view.live.file).paths()
    assert paths.shape[1] == result.episodes[0].steps
    facts, _ = view.states[-1]
    assert facts["phase"] == "over"
    assert facts["gate"] == -1
    assert "COMPLETION" in facts["events"][-1][1]
    assert any(event[1] == "gate passed" for event in facts["events"])
    assert {e["id"] for e in view.scenes[-1]["track"]} >= {"gate 0", "goal"}


def test_an_arena_flight_shows_every_phase_and_what_the_operator_needs(tmp_path, view):
    fly(tmp_path, view, "sim2real", "out")
    phases = list(dict.fromkeys(facts["phase"] for facts, _ in view.states))
    expected = ["connect", "pre-flight", "survey", "arm", "countdown", "run", "complete"]
    assert [phase for phase in phases if phase in expected] == expected
    assert "return-and-land" in phases
    running = [entry for entry in view.states if entry[0]["phase"] == "run"]
    facts, row = running[-1]
    assert facts["battery"] > 3.0
    assert facts["cameras"]["bodies"] >= 1
    assert facts["ladder"] in ("NONE", "WARN")
    assert "flying" in facts["supervisor"]
    assert math.isfinite(facts["room"])
    assert all(ok for _, ok, *_ in facts["checklist"])
    # It comes to rest ahead of where it flies.
    ahead = row[STOP : STOP + 3] - row[POSITION : POSITION + 3]
    assert float(ahead @ row[VELOCITY : VELOCITY + 3]) >= 0.0


def test_simulated_time_keeps_the_pace_asked_for():
    class Wall:
        def __init__(self):
            self.time = 0.0

        def now(self):
            return self.time

        def sleep_until(self, deadline):
            self.time = deadline
            return 0.0

    wall = Wall()
    pace = Pace(2.0, wall)
    for time in np.arange(0.0, 10.01, 0.5):
        pace.keep(float(time))
    assert wall.time == pytest.approx(5.0)
    wall.time += 60.0  # the machine slept
    pace.keep(10.5)
    pace.keep(11.5)
    assert wall.time == pytest.approx(65.5)
    Pace(0.0, wall).keep(1e9)
    assert wall.time == pytest.approx(65.5)


def test_a_supervisor_in_words():
    assert supervisor_words(None) == []
    assert supervisor_words(0) == ["disarmed"]
    assert supervisor_words(0b10010) == ["flying", "armed"]
