"""Attitude setpoints: the gate's bounds, the watchdog's foresight, a lost link."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyarena.crazyswarm_compat import commands as c
from crazyarena.safety.attitude_path import FULL, GRAVITY, AttitudeLoss, push, tilt_of
from crazyarena.safety.events import Action
from crazyarena.safety.limits import Limits
from crazyarena.safety.monitors import RULES, Monitor
from crazyarena.safety.observation import Observation
from tests.safety.scenes import fence
from tests.safety.test_gate import Rig

LIMITS = Limits(allow_attitude=True, attitude_loss_margin=math.inf)
HOVER = int(FULL / LIMITS.thrust_to_weight)


def asked(roll=0.0, pitch=0.0, yaw=0.0, thrust=HOVER):
    return c.RollPitchYawThrust(roll, pitch, yaw, thrust)


def flying(limits=LIMITS, position=(0.0, 0.0, 1.0), velocity=(0.0, 0.0, 0.0)):
    return Rig(position, velocity, limits=limits)


def test_refused_unless_allowed():
    assert "allow_attitude" in Rig().refused(asked())


def test_tilt_is_cut_in_its_direction():
    sent = flying().send(asked(0.8, -0.6))
    assert math.hypot(sent.roll, sent.pitch) == pytest.approx(LIMITS.setpoint_tilt)
    assert sent.roll / sent.pitch == pytest.approx(-0.8 / 0.6)
    assert flying().send(asked(0.3, -0.2)) == asked(0.3, -0.2)


def test_thrust_is_cut():
    limits = Limits(allow_attitude=True, setpoint_thrust=0.8, attitude_loss_margin=math.inf)
    assert flying(limits).send(asked(thrust=60000)).thrust == int(0.8 * FULL)


def test_a_heading_turns_no_faster_than_a_rate_may():
    rig = flying()
    assert rig.send(asked(yaw=0.1)) == asked(yaw=0.1)
    rig.wait(0.02)
    sent = rig.send(asked(yaw=3.0))
    assert sent.yaw == pytest.approx(0.1 + 0.02 * LIMITS.setpoint_yaw_rate, abs=2e-3)
    # The short way round.
    rig.wait(0.02)
    assert rig.send(asked(yaw=-3.0)).yaw > sent.yaw
    rig.wait(0.02)
    assert rig.send(asked(yaw=-1.0)).yaw < sent.yaw + 1e-6
    assert flying().send(c.Attitude(0.0, 0.0, 50.0, HOVER)).yaw_rate == LIMITS.setpoint_yaw_rate


def test_the_watchdog_is_told_what_is_pushed_until_something_else_is_streamed():
    rig = flying()
    assert rig.gate.pushed(1) is None
    rig.send(asked(pitch=0.3, thrust=40000))
    assert rig.gate.pushed(1) == pytest.approx(push(0.0, 0.3, 0.0, 40000, LIMITS))
    rig.send(c.FullState((0.0, 0.0, 1.0), np.zeros(3), np.zeros(3), 0.0, np.zeros(3)))
    assert rig.gate.pushed(1) is None


def test_pushing_is_gravity_where_it_hovers():
    assert push(0.0, 0.0, 1.0, HOVER, LIMITS) == pytest.approx((0.0, 0.0, 0.0), abs=1e-3)
    ahead = push(0.0, 0.2, 0.5 * math.pi, HOVER, LIMITS)
    assert ahead[1] == pytest.approx(GRAVITY * math.sin(0.2), rel=1e-3)


@given(
    st.floats(-1.0, 1.0),
    st.floats(-1.0, 1.0),
    st.floats(-3.0, 3.0),
    st.integers(20000, 65535),
)
def test_tilt_and_push_are_each_others_inverse(roll, pitch, yaw, thrust):
    ax, ay, _ = push(roll, pitch, yaw, thrust, LIMITS)
    lift = thrust / FULL * LIMITS.thrust_to_weight * GRAVITY
    if math.hypot(ax, ay) < 0.94 * lift:
        again = push(*tilt_of(ax, ay, yaw, lift), yaw, thrust, LIMITS)
        assert again[:2] == pytest.approx((ax, ay), abs=1e-6)


def predicted(position, velocity, pushed):
    rule = next(rule for rule in RULES if rule.name == "fence_predicted")
    obs = Observation(
        time=1.0, active=True, airborne=True, position=position, velocity=velocity, pushed=pushed
    )
    found = Monitor(rule, fence(), LIMITS).update(obs, overriding=False)
    return None if found is None else found.action


def test_what_is_asked_for_counts_before_it_shows():
    _low, high = fence().bounds
    near = (high[0] - 0.35, 0.0, 1.0)
    level = (0.7, 0.0, 0.0)
    assert predicted(near, level, None) is None
    assert predicted(near, level, push(0.0, 0.6, 0.0, 50000, LIMITS)) is Action.HOLD
    # Whoever brakes already is let be.
    assert predicted(near, level, push(0.0, -0.4, 0.0, HOVER, LIMITS)) is None
    under = (0.0, 0.0, high[2] - 0.4)
    assert predicted(under, (0.0, 0.0, 0.8), None) is None
    assert predicted(under, (0.0, 0.0, 0.8), push(0.0, 0.0, 0.0, 65535, LIMITS)) is Action.HOLD


def test_a_lost_link_is_held_to_its_margin():
    limits = Limits(allow_attitude=True, attitude_loss_margin=0.3)
    _low, high = fence().bounds
    place, moving = (high[0] - 1.2, 0.0, 1.0), (0.8, 0.0, 0.0)
    rig = flying(limits, place, moving)
    sent = rig.send(asked(pitch=0.5, thrust=int(1.1 * HOVER)))
    assert sent.pitch < 0.45
    loss = AttitudeLoss(fence(), limits)
    after = push(sent.roll, sent.pitch, sent.yaw, sent.thrust, limits)
    assert loss.excess(place, moving, after) <= 0.3 + 1e-6
    assert loss.excess(place, moving, push(0.0, 0.5, 0.0, int(1.1 * HOVER), limits)) > 0.3
    # Where nothing keeps within, it brakes.
    fast = flying(limits, (high[0] - 0.4, 0.0, 1.0), (2.5, 0.0, 0.0))
    assert fast.send(asked(pitch=0.3)).pitch < -0.3


def test_a_vehicle_on_its_way_in_is_let_be():
    limits = Limits(allow_attitude=True, attitude_loss_margin=0.3)
    _low, high = fence().bounds
    rig = flying(limits, (high[0] - 0.3, 0.0, 1.0), (-0.5, 0.0, 0.0))
    assert rig.send(asked(pitch=-0.2)) == asked(pitch=-0.2)


def test_a_fall_is_caught_before_the_ground():
    full = int(FULL)
    # High up a vehicle may fall for a while, and come down gently anywhere.
    assert flying(position=(0.0, 0.0, 1.9)).send(asked(thrust=0)) == asked(thrust=0)
    gentle = flying(position=(0.0, 0.0, 0.3), velocity=(0.0, 0.0, -0.4))
    assert gentle.send(asked(thrust=int(0.95 * HOVER))) == asked(thrust=int(0.95 * HOVER))
    for height, falling in ((0.9, 2.0), (0.4, 1.2), (1.5, 3.2)):
        rig = flying(position=(0.0, 0.0, height), velocity=(0.0, 0.0, -falling))
        sent = rig.send(asked(roll=0.5, thrust=0))
        assert (sent.thrust, sent.roll) == (full, pytest.approx(0.3))
    # What stands may be given any thrust.
    assert flying(position=(0.0, 0.0, 0.03)).send(asked(thrust=0)) == asked(thrust=0)
