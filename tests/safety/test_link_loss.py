"""Where a vehicle comes down that hears nothing more, and what that allows a setpoint."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from crazyarena.clock import VirtualClock
from crazyarena.crazyswarm_compat import commands as c
from crazyarena.errors import InputError
from crazyarena.safety import link_loss
from crazyarena.safety.limits import Limits
from crazyarena.safety.link_loss import LinkLoss
from crazyarena.sim_backend.arena import ArenaFleet
from tests.safety.scenes import fence

PLAIN = fence(zones=())
places = st.tuples(st.floats(-2.9, 2.9), st.floats(-2.9, 2.9), st.floats(0.3, 1.9))
horizontal = st.tuples(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0), st.just(0.0))
pushes = st.tuples(st.floats(-4.0, 4.0), st.floats(-4.0, 4.0), st.floats(-2.0, 2.0))


@given(
    time=st.floats(0.01, 2.0),
    stiffness=st.floats(0.5, 60.0),
    damping=st.floats(0.1, 30.0),
    away=st.floats(-1.0, 1.0),
    speed=st.floats(-3.0, 3.0),
)
@settings(max_examples=40, deadline=None)
def test_the_spring_moves_as_its_equation_says(time, stiffness, damping, away, speed):
    solved = solve_ivp(
        lambda t, y: (y[1], -stiffness * y[0] - damping * y[1]),
        (0.0, time),
        (away, speed),
        rtol=1e-9,
        atol=1e-11,
    ).y[:, -1]
    r = link_loss._Response.after(time, stiffness, damping)
    assert r.place_place * away + r.place_speed * speed == pytest.approx(solved[0], abs=1e-6)
    assert r.speed_place * away + r.speed_speed * speed == pytest.approx(solved[1], abs=1e-5)


@given(place=places, moving=horizontal, velocity=horizontal, push=pushes)
def test_what_is_held_back_ends_inside_wherever_that_is_possible(place, moving, velocity, push):
    limits = Limits()
    guard = LinkLoss(PLAIN, limits)
    slower = guard.feedforward(place, moving, place, velocity, push)
    later = tuple(p + limits.link_delay * v for p, v in zip(place, moving, strict=True))

    def excess(told):
        rest = tuple(
            p + (d * v + a) / k
            for p, v, a, k, d in zip(
                place, told, push, link_loss._STIFFNESS, link_loss._DAMPING, strict=True
            )
        )
        return guard.excess(later, moving, rest, -push[2] / link_loss._STIFFNESS[2])

    if slower is None:
        assert excess(velocity) <= limits.link_loss_margin + 1e-9
    elif guard.excess(later, moving, later, -push[2] / link_loss._STIFFNESS[2]) <= 0.05:
        assert excess(slower) <= limits.link_loss_margin + 1e-6
        # Held back no further than needed: it ends at the margin, not well inside.
        assert excess(slower) >= limits.link_loss_margin - 0.05


@given(place=places, velocity=horizontal)
def test_a_velocity_setpoint_keeps_its_direction(place, velocity):
    allowed = LinkLoss(PLAIN, Limits()).velocity(place, velocity)
    if allowed is not None:
        assert np.cross(allowed, velocity) == pytest.approx(0.0, abs=1e-9)
        assert np.dot(allowed, velocity) >= 0.0


def test_a_plan_gets_the_time_in_which_it_may_be_cut_anywhere():
    guard = LinkLoss(PLAIN, Limits())
    start, goal = (0.5, 0.0, 1.0), (2.9, 0.0, 1.0)
    still = (0.0, 0.0, 0.0)
    assert guard.duration(start, still, (1.0, 0.0, 1.0), 1.0) == 1.0
    duration = guard.duration(start, still, goal, 1.5)
    assert 1.5 < duration < 12.0
    assert guard.duration(start, still, goal, duration) == duration
    # Too fast already: nothing is good, and nothing endless is made of it.
    assert guard.duration((2.8, 0.0, 1.0), (3.0, 0.0, 0.0), goal, 1.0) < 30.0


def test_zones_for_people_count_as_outside():
    guard = LinkLoss(fence(), Limits())
    towards = guard.feedforward(
        (-2.5, 1.3, 1.0), (0.0, 1.5, 0.0), (-2.5, 1.3, 1.0), (0.0, 1.5, 0.0), (0.0, 0.0, 0.0)
    )
    assert towards is not None
    assert towards[1] < 1.5


@pytest.mark.parametrize("speed", [0.8, 1.5, 2.0])
def test_the_firmware_goes_no_further_than_foretold(speed):
    """Flown: cruise at a speed, lose the link, and see where it comes down."""
    fleet = ArenaFleet([np.array([-2.5, 0.0, 0.03])], rng=np.random.default_rng(0))
    fleet.set_param(0, "stabilizer.controller", 2)
    clock = VirtualClock()
    x, lost_at = -2.5, None
    for step in range(round(4.0 * 30)):
        t = step / 30
        height = min(1.0, 0.5 * t)
        v = speed * min(1.0, max(0.0, t - 2.2) / 0.8)
        x += v / 30
        fleet.external_pose(0, fleet.true_pose(0))
        fleet.emergency_watchdog(0)
        fleet.send(c.FullState((x, 0.0, height), (v, 0.0, 0.0), np.zeros(3), 0.0, np.zeros(3)), 0)
        lost_at = fleet.true_state(0)
        for _ in range(3):
            fleet.advance(11)
            fleet.external_pose(0, fleet.true_pose(0))
        clock.sleep_until(t)
    assert lost_at is not None
    place, moving = tuple(lost_at.position), tuple(lost_at.velocity)
    assert moving[0] == pytest.approx(speed, rel=0.15)
    rest = (x + speed * link_loss._DAMPING[0] / link_loss._STIFFNESS[0], 0.0, 1.0)
    for _ in range(300):
        fleet.external_pose(0, fleet.true_pose(0))
        fleet.advance(10)
    end = fleet.true_state(0).position[0]
    foretold = 3.0 + LinkLoss(PLAIN, Limits()).excess(place, moving, rest)
    assert lost_at.position[0] + 0.2 * speed < end <= foretold + 0.02


def test_the_limit_may_be_endless_but_not_nothing():
    assert not LinkLoss(PLAIN, Limits(link_loss_margin=math.inf)).on
    with pytest.raises(InputError, match="link_loss_margin"):
        Limits(link_loss_margin=0.0)
    with pytest.raises(InputError, match="link_delay"):
        Limits(link_delay=math.inf)
