"""How fast anybody may be turned about the vertical, and how far below it may be told to be."""

from __future__ import annotations

import math

import numpy as np
import pytest

from crazyarena.crazyswarm_compat import commands as c
from crazyarena.errors import CommandError
from crazyarena.safety.flight_model import GRAVITY, PID, FlightModel
from crazyarena.safety.gate import Policy
from crazyarena.safety.limits import Limits
from tests.safety.test_gate import ZERO, Rig, full, piece

HERE = (0.0, 0.0, 1.0)
FASTEST = Limits().setpoint_yaw_rate


@pytest.mark.parametrize("yaw", [3.0, -3.0, 1.2, math.tau - 2.0])
def test_a_stream_turns_a_vehicle_bit_by_bit(yaw):
    turn = math.remainder(yaw, math.tau)
    for command in (c.Position(HERE, yaw), c.FullState(HERE, ZERO, ZERO, yaw, ZERO)):
        rig = Rig()
        assert rig.send(command).yaw == pytest.approx(math.copysign(0.8, turn))
        assert "turns by" in rig.events[-1].detail
        # Asked for all along, it still does not spin.
        rig.wait(0.03)
        assert abs(rig.send(command).yaw) == pytest.approx(0.8)
        assert "turns by" in Rig(policy=Policy.REFUSE).refused(command)
        near = c.Position(HERE, 0.75)
        assert rig.send(near) is near


def test_rates_of_yaw_are_bounded():
    rig = Rig()
    assert rig.send(c.VelocityWorld(ZERO, -12.0)).yaw_rate == -FASTEST
    assert rig.send(c.Hover(0.0, 0.0, 12.0, 1.0)).yaw_rate == FASTEST
    calm = c.Hover(0.0, 0.0, 0.9 * FASTEST, 1.0)
    assert rig.send(calm) is calm


def peak(turn: float, duration: float) -> float:
    return 35 / 16 * turn / duration


@pytest.mark.parametrize(
    "command",
    [
        c.GoTo(HERE, 3.0, 0.3),
        c.GoTo(ZERO, 3.0, 0.3, relative=True),
        c.GoTo(ZERO, -3.0, 0.3, relative=True),
        c.Takeoff(1.1, 0.3, 3.0),
        c.Land(0.9, 0.3, 3.0),
    ],
)
def test_plans_take_the_time_that_their_turn_needs(command):
    rig = Rig()
    assert 5.9 < peak(3.0, rig.send(command).duration) < 6.01
    assert "turn by" in rig.events[-1].detail


def test_the_shorter_way_round_is_what_a_plan_turns():
    rig = Rig()
    for yaw in (math.tau, math.tau - 0.5, 0.4, -0.4):
        command = c.GoTo(HERE, yaw, 0.3)
        assert rig.send(command) is command
    keeps = c.Takeoff(1.1, 2.0, None)
    assert rig.send(keeps) is keeps


def turning(duration: float, *coefficients: float) -> np.ndarray:
    row = piece(duration, 0.1)
    row[0, 25 : 25 + len(coefficients)] = coefficients
    return row


def test_trajectories_may_not_spin():
    def started(*pieces, timescale=1.0, reverse=False):
        rig = Rig()
        rig.send(c.UploadTrajectory(1, 0, np.concatenate(pieces)))
        command = c.StartTrajectory(1, timescale, reverse=reverse, relative=True)
        try:
            assert rig.send(command) is command
        except CommandError as error:
            return str(error)
        return ""

    assert started(turning(3.0, 0.0, 2.0), timescale=0.5) == ""
    assert "turns with 6.7" in started(turning(3.0, 0.0, 2.0), timescale=0.3)
    assert "jumps by 2.0" in started(turning(3.0, 2.0))
    assert started(turning(3.0, 1.7)) == ""
    assert started(turning(3.0, math.tau)) == ""
    # From one piece to the next, forwards and backwards.
    broken = turning(3.0, 0.0, 0.8), turning(3.0, 0.0, 0.0)
    assert "jumps by 2.4" in started(*broken)
    assert "jumps by 2.4" in started(*broken, reverse=True)


def lift(height: float, climb: float, told: float) -> float:
    """m/s2 upwards of the rotors, of what Mellinger's controller makes of a place."""
    model = FlightModel()
    return GRAVITY + model.stiffness[2] * (told - height) - model.damping[2] * climb


@pytest.mark.parametrize("climb", [0.0, 0.5, -0.5, -1.0])
def test_a_place_far_below_leaves_a_vehicle_its_lift(climb):
    below = (0.0, 0.0, 0.45)
    for command in (c.Position(below), full(below), c.Hover(0.0, 0.0, 0.0, 0.45)):
        rig = Rig(velocity=(0.0, 0.0, climb))
        sent = rig.send(command)
        told = sent.height if isinstance(sent, c.Hover) else sent.position[2]
        assert 0.45 <= told <= 1.0  # never raised above where it is
        if told < 1.0:
            assert lift(1.0, climb, told) >= 0.39 * GRAVITY
        refused = Rig(velocity=(0.0, 0.0, climb), policy=Policy.REFUSE).refused(command)
        assert "asks for no lift" in refused


def test_who_descends_as_told_or_near_the_ground_is_left_alone():
    rig = Rig(velocity=(0.0, 0.0, -1.0))
    for command in (
        c.Position((0.0, 0.0, 0.7)),
        full((0.0, 0.0, 0.7), velocity=(0.0, 0.0, -1.0)),
    ):
        assert rig.send(command) is command
    low = Rig(where=(0.0, 0.0, 0.3))
    low.gate.low = lambda vehicle: True
    down = c.Position((0.0, 0.0, 0.05))
    assert low.send(down) is down
    # The PID bounds on board how fast it sinks.
    pid = Rig(limits=Limits().for_vehicle(FlightModel(controller=PID, follows_velocity=False)))
    below = c.Position((0.0, 0.0, 0.45))
    assert pid.send(below) is below
