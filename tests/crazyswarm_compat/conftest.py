"""Swarms for the tests: perfect tracking, no viewer."""

from __future__ import annotations

import math

import pytest

from crazyarena.crazyswarm_compat import crazyswarm1, crazyswarm2
from crazyarena.crazyswarm_compat.uav_trajectory import Polynomial4D, Trajectory

TWO = """
crazyflies:
- {id: 1, channel: 100, type: default, initialPosition: [1.0, 0, 0]}
- {id: 10, channel: 110, type: default, initialPosition: [0, -1.0, 0]}
"""
TWO_2 = """
fileversion: 3
robots:
  cf1: {enabled: true, uri: "radio://0/80/2M/E7E7E7E701", initial_position: [1, 0, 0], type: cf21}
  cfa: {enabled: true, uri: "radio://0/80/2M/E7E7E7E70A", initial_position: [0, -1, 0], type: cf21}
robot_types:
  cf21: {connection: crazyflie}
"""


@pytest.fixture
def swarm1():
    """Factory of Crazyswarm 1 swarms of vehicles 1 and 10."""

    def make(args="", yaml=TWO):
        return crazyswarm1.Crazyswarm(crazyflies_yaml=yaml, args="--sim --vis null " + args)

    return make


@pytest.fixture
def swarm2():
    """Factory of Crazyswarm2 swarms of vehicles cf1 and cfa."""

    def make(args="", yaml=TWO_2):
        return crazyswarm2.Crazyswarm(crazyflies_yaml=yaml, args="--sim --vis null " + args)

    return make


@pytest.fixture
def figure8():
    """Figure of eight, x = sin wt, y = sin(wt) cos(wt), in 20 pieces (Taylor polynomials)."""
    pieces, period = 20, 6.0
    w, length = 2 * math.pi / period, period / pieces
    trajectory = Trajectory()
    for k in range(pieces):
        a = w * k * length
        px = [math.sin(a + j * math.pi / 2) * w**j / math.factorial(j) for j in range(8)]
        py = [
            0.5 * math.sin(2 * a + j * math.pi / 2) * (2 * w) ** j / math.factorial(j)
            for j in range(8)
        ]
        trajectory.polynomials.append(Polynomial4D(length, px, py, [0.0] * 8, [0.0] * 8))
    trajectory.duration = period
    return trajectory
