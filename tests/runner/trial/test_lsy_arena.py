"""Controllers of lsy_drone_racing through the arena's firmware, by the one trial."""

from __future__ import annotations

import io
import json

import numpy as np
import pytest
from rich.console import Console

from crazyarena.errors import InputError
from crazyarena.runner.dry_run import DryRun
from crazyarena.runner.records import export
from crazyarena.runner.records.mcap_records import read_records
from crazyarena.runner.trial.entry import Entry2022, EntryLsy, default_level, enter
from crazyarena.runner.trial.options import FlightOptions
from tests.runner.lsy_controllers import ATTITUDE, HEAD, LOG, STATE, controller

FREE = FlightOptions(sandbox=False, compute="free")


@pytest.fixture
def fly(tmp_path):
    def flown(source, *overrides, level="lsy/level0", episodes=1, options=FREE, where=None):
        if where is not None:
            source = source.replace('"log.jsonl"', repr(str(where / "log.jsonl")))
        (tmp_path / "mine.py").write_text(source)
        run = DryRun(
            tmp_path / "mine.py",
            level,
            ["profile=arena", *overrides],
            episodes=episodes,
            seed=2,
            out=tmp_path / "out",
            figure=False,
            console=Console(file=io.StringIO()),
            options=options,
        )
        return run.run()

    return flown


def test_state_mode_from_the_floor_to_the_last_gate_and_home(fly, tmp_path):
    result = fly(STATE)
    episode = result.episodes[0]
    assert episode.termination == "GATES PASSED", episode.why
    assert episode.completed
    assert episode.gates_passed == 4
    # Their spline takes 15 s in simulation; no take-off command was ever given.
    assert 12.0 < episode.flight_time < 16.0
    assert "return-and-land" in episode.phases
    document = json.loads((tmp_path / "out" / "result.json").read_text())
    assert document["provenance"]["contract"] == "lsy_drone_racing"
    assert document["provenance"]["rig"]["vehicle"] == "cf21b"
    metadata = read_records(tmp_path / "out" / "episode_000.mcap").metadata
    assert metadata["contract"] == "lsy_drone_racing"


def test_who_is_slow_at_the_last_gate_leaves_it_before_the_way_up(fly, tmp_path):
    level = tmp_path / "one.toml"
    level.write_text(
        "[env.track]\ngates = [{pos = [0.0, 0.0, 1.0], rpy = [0.0, 0.0, 0.0]}]\n"
        "drones = [{pos = [-1.0, 0.0, 0.01]}]\n"
    )
    source = (
        HEAD
        + """
class Slow(Controller):
    steps = 0

    def compute_control(self, obs, info=None):
        t = self.steps / 50
        x = -1.0 + 0.2 * min(max(t - 3.0, 0.0), 6.5)
        return np.array([x, 0.0, min(0.5 * t, 0.9), *np.zeros(10)])

    def step_callback(self, *args):
        self.steps += 1
        return False
"""
    )
    episode = fly(source, level=str(level)).episodes[0]
    assert episode.termination == "GATES PASSED", episode.why
    assert episode.error is None
    table = export.read(tmp_path / "out" / "episode_000.mcap")
    first = table.columns["state"].index("position_0")
    x, _, z = table.tables["state"][:, first : first + 3].T
    assert z.max() > 1.4
    # Nowhere near where the upper bar is; the way home leads over it.
    assert not np.any((np.abs(x) < 0.2) & (z > 1.16) & (z < 1.46))


def test_attitude_mode_goes_as_attitudes(fly, tmp_path):
    result = fly(ATTITUDE, "env.control_mode=attitude")
    episode = result.episodes[0]
    assert episode.error is None
    assert episode.termination == "FINISHED", episode.why
    assert b"RollPitchYawThrust" in (tmp_path / "out" / "episode_000.mcap").read_bytes()


def test_every_episode_has_a_new_controller(fly, tmp_path):
    result = fly(LOG, level="lsy/level2", episodes=2, where=tmp_path)
    assert [e.termination for e in result.episodes] == ["FINISHED", "FINISHED"]
    lines = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    for number, (calls, seen, config, info) in enumerate(lines):
        assert calls[0] == f"made {number + 1}"
        assert calls[-2:] == ["episode_callback", "episode_reset"]
        assert calls.count("step") == 3
        assert seen["gates_quat"] == [[4, 4], "float32"]
        assert config[0] == 50
        assert info == {}


def test_a_crashing_controller_is_told_and_the_vehicle_brought_down(fly):
    source = HEAD + (
        "class Bad(Controller):\n"
        "    def __init__(self, obs, info, config):\n"
        "        super().__init__(obs, info, config)\n"
        "        self.k = 0\n"
        "    def compute_control(self, obs, info=None):\n"
        "        self.k += 1\n"
        "        if self.k > 60:\n"
        "            raise ZeroDivisionError('mine')\n"
        "        return np.concatenate([[-1.5, 0.75, 0.8], np.zeros(10)])\n"
        "    def step_callback(self, *a):\n"
        "        return False\n"
    )
    episode = fly(source).episodes[0]
    assert episode.termination == "CONTROLLER ERROR"
    assert "ZeroDivisionError: mine" in episode.error
    assert "return-and-land" in episode.phases


def test_a_slow_controller_costs_ticks_here(fly):
    result = fly(STATE, options=FlightOptions(sandbox=False, compute="fixed=40"))
    episode = result.episodes[0]
    assert episode.missed_ticks > 0.4 * episode.steps
    assert episode.over_period == 0 or episode.late_commands > 0


def test_draws_of_a_secret_run_take_128_bits(fly, tmp_path):
    source = controller("return np.zeros(13)")
    options = FlightOptions(secret=True, compute="free")
    (tmp_path / "mine.py").write_text(source)
    run = DryRun(
        tmp_path / "mine.py",
        "lsy/level2",
        ["profile=arena"],
        options=options,
        out=tmp_path / "secret",
        figure=False,
        console=Console(file=io.StringIO()),
    )
    assert run.seed > 2**64
    with pytest.raises(InputError, match="pcg64"):
        DryRun(
            tmp_path / "mine.py", "lsy/level2", ["profile=arena", "rng=threefry"], options=options
        )


def test_a_submission_is_told_by_its_file(tmp_path):
    mine = tmp_path / "mine.py"
    mine.write_text(STATE)
    assert isinstance(enter(mine, "lsy/level1"), EntryLsy)
    assert default_level(mine) == "lsy/level0"
    with pytest.raises(InputError, match="none of its levels"):
        enter(mine, "sim2real")
    other = tmp_path / "edit_this.py"
    other.write_text("class Controller: ...\n")
    assert isinstance(enter(other, "level0"), Entry2022)
    with pytest.raises(InputError, match="derives from"):
        enter(other, "lsy/level0")
    assert np.isfinite(enter(mine, "lsy/level1").level.episode_length)


SPRINT = (
    HEAD
    + '''
class Sprint(Controller):
    """Up to 1.4 m, then 1.4 m/s along x, and it has finished."""

    def __init__(self, obs, info, config):
        super().__init__(obs, info, config)
        self.start, self.steps = np.array(obs["pos"]), 0

    def compute_control(self, obs, info=None):
        action = np.zeros(13)
        t = self.steps / 50
        action[:3] = self.start + [max(0.0, t - 3.0) * 1.4, 0.0, min(t * 0.7, 1.4)]
        action[3] = 1.4 if t > 3.0 else 0.0
        return action.astype(np.float32)

    def step_callback(self, action, obs, reward, terminated, truncated, info):
        self.steps += 1
        return self.steps >= 190
'''
)


def test_it_comes_home_below_a_low_ceiling(fly):
    """A Brushless hovers a hand above what it is told; above poles of 1.55 m are 0.45 m of room."""
    result = fly(SPRINT, level="lsy/level1", episodes=3)
    for episode in result.episodes:
        words = [str(word) for event in episode.events for word in event]
        assert not [word for word in words if "aborted" in word or "fence" in word]
        assert episode.phases["return-and-land"] > 5.0
