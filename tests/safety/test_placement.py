"""One rule for where a track may stand, and what stands in a gate's way."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from crazyarena.levels import Level, load_level
from crazyarena.levels.draw import LevelRandom
from crazyarena.mocap.survey import SurveyConfig, misplaced, survey
from crazyarena.runner.cli import make_app
from crazyarena.safety.placement import MEASURING, allowed, nominal_track, obstructions
from crazyarena.types import Pose, PoseFrame

TRACK = """\
profile: arena
start: {{position: [-1, 0, 0.03]}}
goal: {{position: [2, 0, 1]}}
track:
  gates: [{{x: 0.5, y: 0, yaw: -1.57, type: tall}}, {{x: {x}, y: {y}, yaw: {yaw}, type: low}}]
  obstacles: [{{x: {px}, y: {py}}}]
{more}
"""
NARROW = "randomization: {gates_and_obstacles: {gates: [-0.05, 0.05], obstacles: [-0.02, 0.03]}}"


def level(tmp_path, x=1.5, y=0.0, yaw=-1.57, px=0.0, py=1.0, more=NARROW) -> Level:
    file = tmp_path / "track.yaml"
    file.write_text(TRACK.format(x=x, y=y, yaw=yaw, px=px, py=py, more=more))
    return load_level(str(file))


def moved(pose: Pose, x=0.0, y=0.0, yaw=0.0) -> Pose:
    qx, qy, qz, qw = pose.quaternion.tolist()
    half = math.atan2(qz, qw) + 0.5 * yaw
    turned = np.array([qx, qy, math.sin(half), math.cos(half)])
    return Pose(pose.position + [x, y, 0.0], turned)


def verdict(flown: Level, name: str, **by) -> str | None:
    nominal = nominal_track(flown)[name]
    return misplaced(moved(nominal, **by), nominal, allowed(flown)[name])


@pytest.mark.parametrize("seed", range(20))
def test_whatever_a_level_draws_is_legal(seed):
    flown = load_level("sim2real")
    draw = LevelRandom(flown, seed).reset()
    nominal, rules = nominal_track(flown), allowed(flown)
    for i, row in enumerate(draw.gates):
        half = 0.5 * row[5]
        pose = Pose(
            np.array([row[0], row[1], 0.0]), np.array([0.0, 0.0, math.sin(half), math.cos(half)])
        )
        name = f"gate{i + 1}"
        assert misplaced(pose, nominal[name], rules[name]) is None


@given(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(-0.3, 0.3))
def test_each_axis_is_judged_by_itself(x, y, yaw):
    flown = load_level("sim2real")
    more, turn = MEASURING
    legal = max(abs(x), abs(y)) <= 0.15 + more and abs(yaw) <= 0.15 + turn
    edge = min(abs(0.15 + more - abs(v)) for v in (x, y))
    if min(edge, abs(0.15 + turn - abs(yaw))) > 1e-9:
        assert (verdict(flown, "gate1", x=x, y=y, yaw=yaw) is None) is legal


def test_the_words_name_axis_distance_and_what_is_allowed(tmp_path):
    flown = level(tmp_path)
    assert verdict(flown, "gate1", x=0.12) == (
        "stands +12.0 cm from its nominal place in x; -6.0 to +6.0 cm are allowed"
    )
    assert "in y" in (verdict(flown, "gate2", y=-0.07) or "")
    assert "turned by +34.4 degrees" in (verdict(flown, "gate1", yaw=0.6) or "")
    # A gate has no front, and obstacles have a range of their own.
    assert verdict(flown, "gate1", yaw=math.pi) is None
    assert verdict(flown, "obstacle1", x=0.035) is None
    assert verdict(flown, "obstacle1", x=-0.035) is not None


def test_a_level_without_ranges_allows_what_a_hand_misses(tmp_path):
    flown = level(tmp_path, more="")
    assert verdict(flown, "gate1", x=0.04, y=-0.04) is None
    assert verdict(flown, "gate1", x=0.06) is not None


def test_survey_uses_the_rule_it_is_given(tmp_path):
    flown = level(tmp_path)
    nominal = nominal_track(flown)
    rng = np.random.default_rng(0)
    config = SurveyConfig(frames=50, allowed=allowed(flown), full_turn=False)
    for by, good in (({"x": 0.05, "y": 0.05, "yaw": 0.05}, True), ({"x": 0.08}, False)):
        true = {name: moved(pose, **by) if name == "gate1" else pose
                for name, pose in nominal.items()}  # fmt: skip
        frames = [
            PoseFrame(
                k, k, k,
                {n: replace(p, position=p.position + rng.normal(0, 2e-4, 3))
                 for n, p in true.items()},
            )
            for k in range(50)
        ]  # fmt: skip
        report = survey(frames, nominal, config)
        assert report.accepted is good
        assert good or "gate1 stands +8.0 cm" in report.problems[0]


def test_shipped_levels_can_be_flown_through():
    for name in ("level0", "level1", "level2", "level3", "sim2real", "getting_started"):
        assert obstructions(load_level(name)) == []


@pytest.mark.parametrize("where", [(1.5, 0.0), (1.5, 0.15), (1.45, -0.2), (1.62, 0.0)])
def test_a_pole_in_an_opening_is_named(tmp_path, where):
    problems = obstructions(level(tmp_path, px=where[0], py=where[1]))
    assert problems == ["obstacle1 stands in the opening of gate2; move one of them"]


@pytest.mark.parametrize("where", [(1.5, 0.4), (1.9, 0.0), (0.5, 0.5)])
def test_a_pole_beside_or_behind_is_not(tmp_path, where):
    assert obstructions(level(tmp_path, px=where[0], py=where[1])) == []


def test_a_gate_within_a_gate_is_named(tmp_path):
    problems = obstructions(level(tmp_path, x=0.5, y=0.3, yaw=0.0))
    assert problems == []  # stands lower and beside
    problems = obstructions(level(tmp_path, x=0.5, y=0.0, yaw=0.0))
    assert any("gate1 stands in the opening of gate2" in p for p in problems)


def test_a_gate_against_the_fence_or_in_a_zone_has_no_room(tmp_path):
    problems = obstructions(level(tmp_path, x=2.85))
    assert problems
    assert all("gate2 has no room on one side" in p or "other side" in p for p in problems)
    zone = (
        "arena: {keep_out: [{name: desk, shape: {kind: box, low: [1.3, -0.5, 0], "
        "high: [1.7, 0.5, 1]}}]}"
    )
    assert any("gate2 has no room in it" in p for p in obstructions(level(tmp_path, more=zone)))


def test_measured_poses_count(tmp_path):
    flown = level(tmp_path)
    gate = nominal_track(flown)["gate2"]
    (problem,) = obstructions(flown, {"obstacle1": gate})
    assert "obstacle1 stands in the opening of gate2" in problem


def test_arena_check_says_so(tmp_path):
    level(tmp_path, px=1.5, py=0.0)
    result = CliRunner().invoke(
        make_app(), ["arena-check", str(tmp_path / "track.yaml"), "--out", str(tmp_path / "a.png")]
    )
    assert result.exit_code == 1
    assert "obstacle1 stands in the opening of gate2" in result.output
