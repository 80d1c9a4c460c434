"""A stream that is y up is named before anything flies; one that is z up never."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyarena.mocap.axes import recognised_axes
from crazyarena.mocap.check import MocapCheck
from crazyarena.mocap.frames import pose_to_y_up
from crazyarena.mocap.source import SourceState, SourceStatus
from crazyarena.types import Pose, PoseFrame


def standing(x: float, y: float, yaw: float = 0.0, z: float = 0.03) -> Pose:
    half = 0.5 * yaw
    return Pose(np.array([x, y, z]), np.array([0.0, 0.0, math.sin(half), math.cos(half)]))


@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(-math.pi, math.pi))
def test_a_vehicle_that_stands_at_its_place_is_never_called_y_up(x, y, yaw):
    pose = standing(x, y, yaw)
    assert recognised_axes({"cf1": pose}, {"cf1": pose.position}) is None
    assert recognised_axes({"cf1": pose}) is None


@given(st.floats(-3, 3), st.floats(0.5, 3), st.floats(-0.05, 0.05))
def test_a_y_up_stream_is_named_by_where_a_vehicle_stands(x, y, yaw):
    pose = standing(x, y, yaw)
    assert recognised_axes({"cf1": pose_to_y_up(pose)}, {"cf1": pose.position}) == "y-up"


@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(0.3, math.pi))
def test_a_y_up_stream_is_named_by_gravity_where_a_body_stands_turned(x, y, yaw):
    assert recognised_axes({"gate1": pose_to_y_up(standing(x, y, yaw, 0.0))}) == "y-up"


def test_a_vehicle_somewhere_else_is_no_matter_of_axes():
    place = {"cf1": np.array([0.0, 0.0, 0.03])}
    assert recognised_axes({"cf1": standing(2.0, 1.0)}, place) is None
    assert recognised_axes({"cf1": pose_to_y_up(standing(2.0, 2.0))}, place) is None
    assert recognised_axes({}, place) is None


@pytest.mark.parametrize("y_up", [False, True])
def test_the_check_names_a_y_up_stream(y_up):
    rng = np.random.default_rng(0)
    check = MocapCheck()
    for k in range(100):
        bodies = {}
        for i, yaw in enumerate((0.0, 0.6, -1.57)):
            pose = standing(1.0 * i, 2.0, yaw)
            pose = Pose(pose.position + rng.normal(0, 2e-4, 3), pose.quaternion)
            bodies[f"gate{i + 1}"] = pose_to_y_up(pose) if y_up else pose
        check.add(PoseFrame(k / 100, k / 100 + 0.004, k, bodies))
    problems = check.report(SourceStatus(SourceState.LIVE), 1.0).problems
    assert [p for p in problems if "y-up" in p] == list(problems)
    assert bool(problems) is y_up
