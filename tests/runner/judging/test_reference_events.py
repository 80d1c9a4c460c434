"""Flights of the original, flown again under our referee: the same events at the same steps.

The disturbed ones too: a level's draws follow the original's order, so its seed gives the same
track, the same vehicle and the same gusts, episode after episode.
"""

from __future__ import annotations

import json
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest

from crazyarena.levels import load_level, shipped_levels
from crazyarena.levels.draw import LevelRandom
from crazyarena.runner.judging.referee import Referee
from crazyarena.sim_backend.competition import CompetitionWorld
from crazyarena.sim_backend.trace import TR_POS
from tests.recorded import arrays, folder
from tests.sim_backend.test_reference_flights import _VERBS, recorded_world

_SERIES = ("target_gate", "gate_in_range", "at_goal", "task_completed", "collision", "violation")


def _meta(path: Path) -> dict:
    return json.loads(str(arrays(path)["meta_json"]))


FLIGHTS = [
    path
    for path in sorted(folder("reference_flights").glob("*.npz"))
    if _meta(path)["level"] in shipped_levels()
]
UNDISTURBED = [path for path in FLIGHTS if not _meta(path)["disturbed"]]
DISTURBED = [path for path in FLIGHTS if _meta(path)["disturbed"]]


def fly(world: CompetitionWorld, referee: Referee, draw, flight: dict) -> dict[str, np.ndarray]:
    """Fly the recorded commands; what our referee said after each control step."""
    world.reset(draw)
    referee.begin(draw.gates, draw.obstacles)
    begun = world.clock.now()
    said = defaultdict(list)
    orders = json.loads(str(flight["commands_json"]))
    for (_, verb, args), now in zip(orders, flight["t"], strict=False):
        command = _VERBS[verb](args)
        if command is not None:
            world.send(command)
        world.clock.sleep_until(begun + float(now))
        rows = world.poll()
        verdict = referee.judge(rows)
        info = verdict.info
        said["position"].append(rows[-1, TR_POS : TR_POS + 3])
        said["target_gate"].append(info["current_target_gate_id"])
        said["gate_in_range"].append(info["current_target_gate_in_range"])
        said["at_goal"].append(info["at_goal_position"])
        said["task_completed"].append(info["task_completed"])
        said["collision"].append(info["collision"][1])
        said["violation"].append(bool(info["constraint_violation"]))
        said["reward"].append(verdict.reward)
    return {name: np.array(values) for name, values in said.items()}


def changes(series: np.ndarray) -> list[tuple[int, float]]:
    """(step, new value) of every change."""
    values = np.asarray(series, dtype=float)
    steps = np.flatnonzero(np.diff(values)) + 1
    return [(int(step), values[step]) for step in steps]


def compare(flight: dict, said: dict[str, np.ndarray]) -> None:
    for name in _SERIES:
        theirs, ours = changes(flight[name]), changes(said[name])
        assert [value for _, value in ours] == [value for _, value in theirs], name
        late = [abs(a - b) for (a, _), (b, _) in zip(ours, theirs, strict=True)]
        assert all(steps <= 1 for steps in late), (name, ours, theirs)
    # One-tick rewards may fall on either side of a step's end; all others are the same.
    different = int((said["reward"] != flight["reward"]).sum())
    assert different <= 2 + len(changes(flight["reward"])) // 4
    error = np.linalg.norm(said["position"] - flight["state"][:, [0, 2, 4]], axis=1)
    assert np.sqrt((error**2).mean()) <= 0.01
    assert error.max() <= 0.04


@pytest.mark.parametrize("path", UNDISTURBED, ids=lambda p: p.stem)
def test_events_of_an_undisturbed_flight(path):
    flight = arrays(path)
    meta, draw = recorded_world(flight)
    level = load_level(meta["level"])
    world = CompetitionWorld(level.control_frequency)
    compare(flight, fly(world, Referee(level), draw, flight))


@pytest.mark.parametrize("name", sorted({_meta(path)["level"] for path in DISTURBED}))
def test_consecutive_disturbed_episodes(name):
    """One generator serves draws and gusts: episode n only fits if all before it were flown."""
    waiting = [path for path in DISTURBED if _meta(path)["level"] == name]
    level = load_level(name)
    world, referee, draws = CompetitionWorld(level.control_frequency), Referee(level), None
    draws = LevelRandom(level)
    flown = 0
    while waiting:
        draw = draws.reset()
        match = [path for path in waiting if abs(_meta(path)["mass"] - draw.mass) < 1e-12]
        if not match:
            break
        flight = arrays(match[0])
        gates = np.array(_meta(match[0])["gates"], dtype=float)
        np.testing.assert_allclose(draw.gates[:, :6], gates[:, :6], atol=1e-12)
        np.testing.assert_allclose(draw.start, flight["initial_state"], atol=1e-12)
        compare(flight, fly(world, referee, draw, flight))
        waiting.remove(match[0])
        flown += 1
    if not flown:
        pytest.skip(f"these episodes of {name} do not begin at the level's own seed")
