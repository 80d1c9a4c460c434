"""No vehicle in the air is left without anything to follow: it would stop its motors."""

from __future__ import annotations

import math

import pytest

from crazyarena.crazyswarm_compat import commands as c
from crazyarena.safety.events import Action
from crazyarena.safety.gate import Policy
from tests.safety.test_gate import Rig, full
from tests.safety.test_watchdog import Rig as WatchedRig

HOME = (0.0, 0.0, 1.0)
MASK = "hlCommander.groupmask"


def streaming(**options: object) -> Rig:
    rig = Rig(where=HOME, **options)
    rig.send(full(HOME))
    rig.wait(0.05)
    return rig


def kinds(rig: Rig) -> list[type]:
    return [type(one) for one, _ in rig.sink.sent]


@pytest.mark.parametrize("plan", [c.GoTo((0.5, 0.0, 1.0), 0.0, 3.0), c.Takeoff(1.5, 3.0)])
def test_the_end_of_a_stream_is_kept_until_a_plan_follows_it(plan):
    rig = streaming()
    word = c.NotifySetpointsStop(250)
    rig.send(word)
    assert kinds(rig) == [c.FullState]
    assert rig.log[-1][:2] == (word, None)
    rig.refused(c.GoTo((math.nan, 0.0, 1.0), 0.0, 3.0))
    assert "not uploaded" in rig.refused(c.StartTrajectory(3))
    # Nothing has followed: it still holds its last setpoint, and is missed by the watchdog.
    assert rig.gate.stream_age(1, rig.clock.now()) == pytest.approx(0.05)
    rig.send(plan)
    assert [one for one, _ in rig.sink.sent[-2:]] == [word, plan]
    assert rig.gate.stream_age(1, rig.clock.now()) is None
    rig.send(word)  # the vehicle follows its planner: it costs nothing
    assert rig.sink.sent[-1][0] is word


def test_a_new_stream_takes_the_word_back():
    rig = streaming()
    rig.send(c.NotifySetpointsStop())
    rig.send(full(HOME))
    rig.send(c.Takeoff(1.5, 3.0))  # ignored by a vehicle that follows a stream
    assert kinds(rig) == [c.FullState, c.FullState, c.Takeoff]
    assert rig.gate.stream_age(1, rig.clock.now()) is not None


def test_one_of_a_swarm_keeps_it_alone():
    rig = streaming()
    word = c.NotifySetpointsStop()
    rig.send(word, None)
    assert rig.sink.sent[1:] == [(word, 2)]
    rig.send(c.Land(0.02, 4.0), None)
    assert [(type(one), who) for one, who in rig.sink.sent[2:]] == [
        (c.NotifySetpointsStop, 1),
        (c.Land, None),
    ]


def test_on_the_ground_a_stream_ends_at_once():
    rig = streaming()
    rig.gate.low = lambda vehicle: True
    rig.send(c.NotifySetpointsStop())
    assert kinds(rig) == [c.FullState, c.NotifySetpointsStop]
    assert rig.gate.stream_age(1, rig.clock.now()) is None


def test_released_in_the_air_it_is_held():
    rig = WatchedRig()
    rig.fly()
    rig.gate.runner.send(c.NotifySetpointsStop(), 1)
    for _ in range(45):
        rig.frame()
    assert rig.watchdog.action(1) is Action.HOLD
    assert "controller_silent" in rig.rules
    assert not any(isinstance(one, c.NotifySetpointsStop) for _, one in rig.vehicle.sent)


def test_released_low_above_the_ground_it_is_left_alone():
    rig = WatchedRig()
    rig.vehicle.position[2] = 0.05
    rig.fly()
    rig.gate.runner.send(c.NotifySetpointsStop(), 1)
    assert isinstance(rig.last, c.NotifySetpointsStop)
    for _ in range(100):
        rig.frame()
    assert rig.watchdog.action(1) is Action.NONE


@pytest.mark.parametrize("known", ["read", "told", "written", "written with a slash"])
def test_a_plan_for_another_group_ends_no_stream(known):
    rig = Rig(where=HOME)
    rig.sink.params[MASK] = 0.0
    if known == "told":
        rig.send(c.SetGroupMask(1))
    elif known != "read":
        rig.send(c.SetParam(MASK if known == "written" else MASK.replace(".", "/"), 1))
    rig.send(full(HOME))
    for command in (
        c.GoTo((0.5, 0.0, 1.0), 0.0, 3.0, group_mask=4),
        c.Land(0.02, 3.0, group_mask=4),
        c.NotifySetpointsStop(group_mask=4),
        c.Stop(group_mask=4),
    ):
        rig.send(command)
        assert rig.sink.sent[-1][0] is command
        assert c.NotifySetpointsStop() not in [one for one, _ in rig.sink.sent]
        assert rig.gate.stream_age(1, rig.clock.now()) is not None
    if known != "read":
        rig.send(c.GoTo((0.5, 0.0, 1.0), 0.0, 3.0, group_mask=3))
        assert rig.sink.sent[-2][0] == c.NotifySetpointsStop()
    rig.send(c.Stop())
    assert rig.gate.stream_age(1, rig.clock.now()) is None


def test_a_group_mask_that_the_vehicle_does_not_hold_is_refused():
    assert "does not hold" in Rig().refused(c.SetParam(MASK, 256))


def test_a_landing_ends_where_motors_may_stop():
    rig = Rig(where=(0.0, 0.0, 0.02))
    rig.send(c.Takeoff(1.0, 2.0))
    rig.wait(2.0)
    rig.where = HOME
    assert rig.send(c.Land(0.5, 3.0)).height == pytest.approx(0.12)
    assert "motors stop" in rig.events[-1].detail
    low = c.Land(0.1, 3.0)
    assert rig.send(low) is low
    refusing = Rig(where=(0.0, 0.0, 0.02), policy=Policy.REFUSE)
    refusing.send(c.Takeoff(1.0, 2.0))
    assert "motors stop" in refusing.refused(c.Land(0.5, 3.0))


@pytest.mark.parametrize("height", [0.3, 1.0, 1.8])
def test_a_landing_is_slow_enough_to_be_followed_and_to_lean_little(height):
    rig = Rig(where=(0.0, 0.0, height))
    duration = rig.send(c.Land(0.0, 0.1)).duration
    assert 35 / 16 * height / duration <= 1.51
    assert 7.52 * height / duration**2 <= 3.01


@pytest.mark.parametrize("controller", [0.0, 1.0, 2.0])
def test_no_velocity_is_sent_to_a_controller_that_follows_none(controller):
    rig = Rig(where=HOME)
    rig.sink.params["stabilizer.controller"] = controller
    command = c.VelocityWorld((0.5, 0.0, 0.0))
    if controller == 2.0:
        assert "would fall" in rig.refused(command)
    else:
        assert rig.send(command) is command
