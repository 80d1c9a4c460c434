"""Heights that a vehicle may be told, by the model of how it follows them."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyarena.safety import steerable
from crazyarena.safety.flight_model import GRAVITY, PID, FlightModel

LOWS = st.floats(-0.15, 0.05)
SPEEDS = st.floats(-3.0, 3.0)
PUSHES = st.floats(-9.0, 9.0)


def lift_over_weight(model, height, climb, place, velocity, push):
    """What a vehicle makes of a setpoint that hovers ``floats`` above those of its model."""
    asked = model.feed[2] * push + model.damping[2] * (velocity - climb)
    return 1.0 + (asked + model.stiffness[2] * (place + model.floats - height)) / GRAVITY


@given(LOWS, st.floats(-3.0, 3.0), SPEEDS, SPEEDS, PUSHES)
def test_the_lowest_place_keeps_rotors_turning_and_no_more(low, place, climb, velocity, push):
    model = replace(FlightModel(), low=low)
    told = steerable.lowest(model, 1.0, climb, place, velocity, push)
    lift = lift_over_weight(model, 1.0, climb, told, velocity, push)
    assert lift >= steerable.LEAST_LIFT - 1e-9
    if told > place:
        assert lift == pytest.approx(steerable.LEAST_LIFT)


@given(LOWS, st.floats(-3.0, 3.0), SPEEDS, SPEEDS, PUSHES)
def test_the_highest_place_asks_for_no_more_than_there_is(low, place, climb, velocity, push):
    model = replace(FlightModel(), low=low)
    told = steerable.highest(model, 1.0, climb, place, velocity, push)
    assert told <= place
    if told < place:
        lift = lift_over_weight(model, 1.0, climb, told, velocity, push)
        assert lift == pytest.approx(model.lift)


def test_a_controller_that_does_not_heed_velocities_is_bounded_on_board():
    model = FlightModel(controller=PID, follows_velocity=False)
    assert steerable.lowest(model, 1.0, 2.0, -3.0, 0.0, 0.0) == -3.0
    assert steerable.highest(model, 1.0, -2.0, 9.0, 0.0, 0.0) == 9.0


def test_only_what_it_hovers_above_is_taken_off():
    assert replace(FlightModel(), low=-0.1).floats == 0.1
    assert replace(FlightModel(), low=0.03).floats == 0.0
