"""What is watched of vehicles that nobody guards."""

from __future__ import annotations

import math
import warnings

import numpy as np
import pytest

from crazyarena.crazyswarm_compat import commands as c
from crazyarena.crazyswarm_compat.guard import FlightEnded
from crazyarena.crazyswarm_compat.options import CrazyswarmWarning
from crazyarena.mocap.estimator import FrameResult
from crazyarena.runner.campaign.turned import turn
from crazyarena.safety.lookout import Lookout
from crazyarena.sim_backend.arena import ArenaFleet, SensorNoise
from crazyarena.types import Pose, PoseFrame, Telemetry


class Link:
    vehicles = (1,)

    def __init__(self, fleet):
        self.fleet = fleet
        self.sent = []

    def telemetry(self, vehicle) -> Telemetry:
        return self.fleet.telemetry(0)

    def send(self, command, vehicle=None):
        self.sent.append(command)
        self.fleet.send(command, 0)

    def send_external_poses(self, poses):
        self.fleet.external_pose(0, poses[1], 0.01)

    def now(self):
        return self.fleet.time


def fly(degrees, seconds=6.0):
    """A take-off and a go-to with a turned body; the lookout, the link and the fleet."""
    angle = math.radians(degrees)
    rng = np.random.default_rng(4)
    fleet = ArenaFleet([[0, 0, 0]], noise=SensorNoise(gyro=0.1, accelerometer=0.005), rng=rng)
    fleet.set_param(0, "stabilizer.controller", 2)
    fleet.set_param(0, "kalman.initialYaw", angle)
    fleet.set_param(0, "kalman.resetEstimation", 1)
    fleet.advance(1)
    fleet.set_param(0, "kalman.resetEstimation", 0)
    link = Link(fleet)
    lookout = Lookout(link, {"cf1": 1}, link)
    for k in range(round(100 * (seconds + 1.0))):
        if k == 100:
            fleet.send(c.Takeoff(1.0, 2.0), 0)
        if k == 320:
            fleet.send(c.GoTo((0.8, 0.4, 1.0), 0.0, 2.0), 0)
        true = fleet.true_pose(0)
        pose = turn(Pose(true.position + rng.normal(0, 5e-4, 3), true.quaternion), angle)
        lookout.send_external_poses({1: pose})
        time = fleet.time
        lookout.on_frame(PoseFrame(time, time, k, {"cf1": pose}), FrameResult({"cf1": pose}, ()))
        fleet.advance(10)
        if link.sent:
            break
    return lookout, link, fleet


@pytest.mark.parametrize("degrees", [60, -90, 180])
def test_far_turned_is_cut(degrees):
    lookout, link, fleet = fly(degrees)
    assert link.sent == [c.Emergency()]
    x, y, z = fleet.true_pose(0).position
    assert np.hypot(x, y) < 0.3
    assert z < 0.3
    with pytest.raises(FlightEnded, match="turned by"):
        lookout.check()
    lookout.check()  # once


def test_a_little_turned_is_told():
    lookout, link, _ = fly(20)
    assert link.sent == []
    with pytest.warns(CrazyswarmWarning, match=r"turned by \+(1[6-9]|2[0-4]) deg"):
        lookout.check()


@pytest.mark.parametrize("degrees", [0, 8])
def test_right_bodies_are_left_alone(degrees):
    lookout, link, _ = fly(degrees)
    assert link.sent == []
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        lookout.check()
