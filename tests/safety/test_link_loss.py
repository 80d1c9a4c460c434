"""Where a vehicle comes down that hears nothing more, and what that allows a setpoint."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from crazyarena.crazyswarm_compat import commands as c
from crazyarena.errors import InputError
from crazyarena.runner.rig.flight_model import flight_model
from crazyarena.safety import link_loss
from crazyarena.safety.flight_model import FlightModel
from crazyarena.safety.limits import Limits
from crazyarena.safety.link_loss import LinkLoss, Moving
from crazyarena.safety.observation import as_point
from crazyarena.sim_backend.arena import ArenaFleet
from crazyarena.sim_backend.vehicles import load_vehicle, vehicle_rows
from tests.safety.scenes import fence

PLAIN = fence(zones=())
places = st.tuples(st.floats(-2.9, 2.9), st.floats(-2.9, 2.9), st.floats(0.3, 1.9))
horizontal = st.tuples(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0), st.just(0.0))
pushes = st.tuples(st.floats(-4.0, 4.0), st.floats(-4.0, 4.0), st.floats(-2.0, 2.0))


@given(
    stiffness=st.floats(0.5, 30.0),
    damping=st.floats(0.1, 12.0),
    drag=st.floats(0.0, 1.5),
    away=st.floats(-1.0, 1.0),
    speed=st.floats(-3.0, 3.0),
    push=st.floats(-4.0, 4.0),
    swing=st.floats(-20.0, 20.0),
    left=st.floats(-4.0, 4.0),
    usual=st.floats(-3.0, 3.0),
)
@settings(max_examples=40, deadline=None)
def test_the_spring_moves_as_its_equation_says(
    stiffness, damping, drag, away, speed, push, swing, left, usual
):
    model = replace(
        FlightModel(),
        stiffness=(stiffness, stiffness, 38.0),
        damping=(damping, damping, 12.0),
        drag=drag,
    )
    w, z = model.swinging

    def rates(t, y):
        believed, fast, b, turn, _, v = y
        asked = -stiffness * believed - damping * fast if t < 0.5 else link_loss._LEFT * left
        swings = w * w * (asked - b) - 2.0 * z * w * turn
        return fast, b, turn, swings, v, b + drag * (usual - v)

    state, solved = (away, (1.0 + 0.1 * drag) * speed, 0.0, swing, away, speed), []
    state = (*state[:2], push + drag * (speed - usual), *state[3:])
    for begin, end in itertools.pairwise((0.0, 0.25, 0.5, 0.6, 1.0)):
        # To the moment at which it levels out, not beyond.
        state = solve_ivp(
            rates, (begin, end - 1e-9), state, method="LSODA", rtol=1e-9, atol=1e-11
        ).y[:, -1]
        solved.append(state[4])
    got = link_loss._Sideways.of(model).ways(away, speed, push, swing, left, usual)
    assert got == pytest.approx([*solved, state[5]], rel=1e-5, abs=1e-5)


@pytest.mark.parametrize("controller", [1, 2])
@given(place=places, moving=horizontal, velocity=horizontal, push=pushes)
def test_what_is_held_back_ends_inside_wherever_that_is_possible(
    controller, place, moving, velocity, push
):
    model = flight_model(load_vehicle(), controller)
    limits = Limits().for_vehicle(model)
    guard = LinkLoss(PLAIN, limits)
    seen = Moving(place, moving)
    slower = guard.full_state(seen, place, velocity, push)
    later = seen.after(limits.link_delay)
    lift = -model.feed[2] * push[2] / model.stiffness[2]

    def excess(position, told):
        return guard.excess(later, guard.rest(position, told, push), lift=lift)

    if slower is None:
        # One who is too far out whatever it is told is not kept from coming back.
        least = max(limits.link_loss_margin, guard.excess(later, later.place, lift=lift))
        assert excess(place, velocity) <= least + 1e-9
    elif guard.excess(later, later.place, lift=lift) <= 0.05:
        assert excess(*slower[:2]) <= limits.link_loss_margin + 1e-6
        # Held back no further than needed: it ends at the margin, not well inside.
        assert excess(*slower[:2]) >= limits.link_loss_margin - 0.05
        # What a controller does not heed is not what is changed.
        assert (slower[0] == place) is model.follows_velocity


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
    held = guard.full_state(
        Moving((-2.5, 1.3, 1.0), (0.0, 1.5, 0.0)),
        (-2.5, 1.3, 1.0),
        (0.0, 1.5, 0.0),
        (0.0, 0.0, 0.0),
    )
    assert held is not None
    assert held[0] == (-2.5, 1.3, 1.0)
    assert held[1][1] < 1.5


VEHICLES = {
    "cf21plus": [],
    "weak": ["rotors.strength=[0.7, 0.7, 0.7, 0.7]"],
    "strong": ["rotors.strength=[1.2, 1.2, 1.2, 1.2]"],
    "heavy": ["body.mass=0.040"],
    "slow rotors": ["rotors.lag_up=0.12", "rotors.lag_down=0.12"],
    "no drag": ["body.drag=[0, 0, 0]"],
    "much drag": ["body.drag=[0.026, 0.026, 0.03]"],
}


@pytest.mark.parametrize("vehicle", VEHICLES)
@pytest.mark.parametrize("controller", [1, 2])
def test_the_firmware_goes_no_further_than_foretold(controller, vehicle):
    """Flown: cruise at a speed, lose the link, and see where it comes down."""
    model = load_vehicle("cf21plus", VEHICLES[vehicle])
    guard = LinkLoss(Line(), Limits().for_vehicle(flight_model(model, controller)))  # type: ignore[arg-type]
    apart = []
    for speed in (0.8, 1.5, 2.0):
        cruise = Cruise(model, controller, speed)
        lost_at = cruise.fleet.true_state(0)
        rest = guard.rest((cruise.x, 0.0, 1.0), (speed, 0.0, 0.0), (0.0, 0.0, 0.0))
        cruise.fleet.advance(3000)  # the poses are lost as well
        gone = cruise.fleet.true_state(0).position[0] - lost_at.position[0]
        foretold = guard.excess(guard.seen(lost_at), rest) - lost_at.position[0]
        assert 0.2 * lost_at.velocity[0] < gone <= foretold + 0.04
        apart.append(foretold - gone)
    # The PID lets itself be led by its own limit of speed, which is not reckoned with.
    assert max(apart[: 1 if controller == 1 else None]) < 0.55


@pytest.mark.parametrize("heading", [0.0, 2.0])
def test_a_vehicle_that_was_told_body_rates_drifts_on(heading):
    """Flown: the firmware keeps them when it levels out, and a tilt is held against them."""
    model = load_vehicle()
    guard = LinkLoss(Line(), Limits().for_vehicle(flight_model(model)))  # type: ignore[arg-type]
    gone = {}
    for rate in (0.0, 2.0):
        fleet = ArenaFleet([np.array([0.0, 0.0, 0.03])], [heading], vehicles=vehicle_rows(model))
        fleet.set_param(0, "stabilizer.controller", 2)
        omega = np.array([math.sin(heading), math.cos(heading), 0.0]) * rate
        for step in range(450):
            told = omega if step == 449 else np.zeros(3)
            fleet.external_pose(0, fleet.true_pose(0))
            fleet.emergency_watchdog(0)
            height = min(1.0, max(0.0, 0.01 * (step - 50)))
            fleet.send(
                c.FullState((0.0, 0.0, height), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), heading, told), 0
            )
            fleet.advance(10)
        seen = guard.seen(fleet.true_state(0))
        left = guard.left(as_point(omega), seen.heading)
        rest = guard.rest((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), left)
        foretold = guard.excess(seen, rest, left)
        fleet.advance(3000)
        gone[rate] = float(fleet.true_state(0).position[0])
        assert gone[rate] == pytest.approx(foretold, abs=0.05 + 0.35 * abs(foretold))
    assert abs(gone[0.0]) < 0.1
    assert gone[2.0] > 0.6


def test_body_rates_are_held_back_before_anything_else():
    guard = LinkLoss(PLAIN, Limits())
    seen, still = Moving((2.7, 0.0, 1.0), (0.0, 0.0, 0.0)), (0.0, 0.0, 0.0)
    outwards = (0.0, 3.0, 0.5)
    held = guard.full_state(seen, seen.place, still, still, outwards)
    assert held is not None
    assert held[:2] == (seen.place, still)
    assert 0.0 < held[2][1] < 3.0
    assert held[2][2] == 0.5
    left = guard.left(held[2], 0.0)
    assert guard.excess(seen, guard.rest(seen.place, still, still, left), left) == pytest.approx(
        Limits().link_loss_margin, abs=0.01
    )
    assert guard.full_state(seen, seen.place, still, still, (0.0, -1.0, 0.0)) is None
    assert (
        guard.full_state(Moving((0.0, 0.0, 1.0), still), (0.0, 0.0, 1.0), still, still, outwards)
        is None
    )
    # Turned round, the same rates push the other way; the PID heeds none.
    about = replace(seen, heading=math.pi)
    assert guard.full_state(about, seen.place, still, still, (0.0, 1.0, 0.0)) is None
    pid = LinkLoss(PLAIN, Limits().for_vehicle(flight_model(load_vehicle(), 1)))
    assert pid.full_state(seen, seen.place, still, still, outwards) is None


@pytest.mark.parametrize("vehicle", VEHICLES)
@pytest.mark.parametrize("controller", [1, 2])
def test_a_stop_ends_where_it_is_foretold(controller, vehicle):
    """Flown: cruise, then setpoints along the braking curve of the watchdog."""
    model = load_vehicle("cf21plus", VEHICLES[vehicle])
    limits = Limits().for_vehicle(flight_model(model, controller))
    for speed in (1.0, 2.0, 2.8):
        cruise = Cruise(model, controller, speed)
        state = cruise.fleet.true_state(0)
        moving, begin = float(state.velocity[0]), state.position
        duration, furthest = moving / limits.braking, 0.0
        for step in range(200):
            left = max(0.0, 1.0 - 0.01 * step / duration)
            told = moving * min(0.01 * step, duration) * 0.5 * (1.0 + left)
            cruise.tell(
                (begin[0] + told, 0.0, begin[2]),
                (moving * left, 0.0, 0.0),
                (-limits.braking if left else 0.0, 0.0, 0.0),
            )
            furthest = max(furthest, cruise.fleet.true_state(0).position[0] - begin[0])
        # Poses are late, and so are commands, but not here.
        reaction = limits.reaction - 0.02
        assert furthest <= moving * reaction + 0.5 * moving**2 / limits.braking


class Line:
    """A fence at x = 0: what is beyond it is the place itself."""

    floor = 0.0
    people_zones = ()

    def clearance(self, x, y, z):
        return -x


class Cruise:
    """A vehicle at a steady speed along x, at 1 m."""

    def __init__(self, model, controller, speed):
        self.fleet = ArenaFleet([np.array([-2.5, 0.0, 0.03])], vehicles=vehicle_rows(model))
        self.fleet.set_param(0, "stabilizer.controller", controller)
        for _ in range(50):
            self.fleet.external_pose(0, self.fleet.true_pose(0))
            self.fleet.advance(10)
        self.x = -2.5
        for step in range(400):
            t = 0.01 * step
            v = speed * min(1.0, max(0.0, t - 2.2) / 0.8)
            self.x += 0.01 * v
            self.tell((self.x, 0.0, min(1.0, 0.5 * t)), (v, 0.0, 0.0), (0.0, 0.0, 0.0))

    def tell(self, position, velocity, acceleration):
        """One setpoint, and 10 ms."""
        self.fleet.external_pose(0, self.fleet.true_pose(0))
        self.fleet.emergency_watchdog(0)
        self.fleet.send(c.FullState(position, velocity, acceleration, 0.0, np.zeros(3)), 0)
        self.fleet.advance(10)


def test_the_limit_may_be_endless_but_not_nothing():
    assert not LinkLoss(PLAIN, Limits(link_loss_margin=math.inf)).on
    with pytest.raises(InputError, match="link_loss_margin"):
        Limits(link_loss_margin=0.0)
    with pytest.raises(InputError, match="link_delay"):
        Limits(link_delay=math.inf)
