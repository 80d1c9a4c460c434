"""What the watchdog flies once it has taken over, setpoint by setpoint."""

from __future__ import annotations

import math

import pytest

from crazyarena.crazyswarm_compat.commands import FullState
from crazyarena.safety import steerable
from crazyarena.safety.events import Action
from crazyarena.safety.flight_model import GRAVITY
from crazyarena.safety.limits import Limits
from crazyarena.safety.pilot import SafePilot
from tests.safety.scenes import fence, flying, tilted


def first_setpoint(pilot: SafePilot, time: float, **changes: object) -> FullState:
    (command,) = pilot.update(Action.HOLD, flying(time, **changes))
    assert isinstance(command, FullState)
    return command


def test_a_velocity_that_explodes_for_a_frame_is_not_flown():
    """Cameras that hang and catch up: 1 m/s, then 6 m/s from one frame to the next."""
    pilot = SafePilot(fence(), Limits())
    for k in range(20):
        pilot.see(flying(0.01 * k, velocity=(1.0, 0.0, 0.0)))
    told = first_setpoint(pilot, 0.2, velocity=(6.0, 0.0, 0.0))
    assert 0.9 < told.velocity[0] < 1.3
    # The brake ends where a vehicle of that speed can stop, not metres away.
    for k in range(1, 60):
        pilot.update(Action.HOLD, flying(0.2 + 0.01 * k, velocity=(1.0, 0.0, 0.0)))
    assert pilot.reference is not None
    assert pilot.reference[0] < 0.15


def test_real_braking_and_the_first_look_are_believed():
    pilot = SafePilot(fence(), Limits())
    assert first_setpoint(pilot, 5.0, velocity=(2.0, 0.0, 0.0)).velocity[0] == pytest.approx(2.0)
    pilot = SafePilot(fence(), Limits())
    for k in range(30):
        pilot.see(flying(0.01 * k, velocity=(2.0 - 0.06 * k, 0.0, 0.0)))
    told = first_setpoint(pilot, 0.3, velocity=(0.2, 0.0, 0.0))
    assert told.velocity[0] == pytest.approx(0.2)


def test_without_poses_it_brakes_gently():
    """A sharp tilt excites slow rotors, and without cameras nothing steadies the vehicle."""
    for age, braking in ((0.01, 6.0), (0.2, 3.0)):
        pilot = SafePilot(fence(), Limits())
        told = first_setpoint(pilot, 5.0, velocity=(2.0, 0.0, 0.0), pose_age=age)
        assert told.acceleration[0] == pytest.approx(-braking)
    weak = SafePilot(fence(), Limits(braking=2.0))
    told = first_setpoint(weak, 5.0, velocity=(2.0, 0.0, 0.0), pose_age=0.2)
    assert told.acceleration[0] == pytest.approx(-2.0)


def test_a_velocity_that_is_no_number_is_left_out():
    pilot = SafePilot(fence(), Limits())
    pilot.see(flying(0.0, velocity=(0.5, 0.0, 0.0)))
    told = first_setpoint(pilot, 0.01, velocity=(math.nan, 0.0, 0.0))
    assert told.velocity[0] == pytest.approx(0.5)


def test_a_brake_setpoint_may_be_the_last_one_to_arrive():
    """Close to the fence the pilot asks for less speed than its braking curve would have."""
    pilot = SafePilot(fence(), Limits())
    near = first_setpoint(pilot, 0.0, position=(2.9, 0.0, 1.0), velocity=(2.0, 0.0, 0.0))
    assert near.velocity[0] < 1.7
    free = SafePilot(fence(), Limits(link_loss_margin=math.inf))
    told = first_setpoint(free, 0.0, position=(2.9, 0.0, 1.0), velocity=(2.0, 0.0, 0.0))
    assert told.velocity[0] == pytest.approx(2.0)


def test_a_climb_is_braked_gently_and_the_rest_as_hard_as_ever():
    pilot = SafePilot(fence(), Limits())
    moving = (0.6, 0.0, 1.2)
    pilot.see(flying(0.0, velocity=moving))
    told = first_setpoint(pilot, 0.01, velocity=moving)
    # Rotors that stand still cannot steer: something of gravity must be left to carry.
    assert slowed(told, 1.0, moving[2]) == pytest.approx(2.5, abs=0.1)
    # Sideways it would be stopped together with the rest, but for being so slow.
    assert told.acceleration[0] == pytest.approx(-0.5 * Limits().braking)
    sinking = SafePilot(fence(), Limits())
    sinking.see(flying(0.0, velocity=(0.0, 0.0, -1.2)))
    told = first_setpoint(sinking, 0.01, velocity=(0.0, 0.0, -1.2))
    assert told.acceleration[2] == pytest.approx(Limits().braking)


def test_one_that_is_outside_is_not_kept_from_coming_back():
    pilot = SafePilot(fence(), Limits())
    where = {"position": (-3.2, 0.0, 0.7), "velocity": (-0.5, 0.0, -1.0)}
    pilot.see(flying(0.0, **where))
    for k in range(1, 80):
        told = pilot.update(Action.HOLD, flying(0.01 * k, **where))
    (setpoint,) = told or [None]
    assert setpoint is not None
    assert setpoint.position[0] > -3.1
    # Towards the place inside, not with the vehicle outwards.
    assert setpoint.velocity[0] > 0.0


def test_the_integral_that_a_contestant_wound_up_is_not_flown_on_with():
    limits = Limits(link_loss_margin=math.inf)
    winding = limits.vehicle.winding

    def told(lead: float, **changes: object) -> float:
        pilot = SafePilot(fence(zones=()), limits)
        for step in range(101):
            pilot.see(flying(0.01 * step, streamed=(lead, 0.0, 1.0), **changes))
        sent = first_setpoint(pilot, 1.01, **changes)
        return float(sent.acceleration[0])

    assert told(0.6) == pytest.approx(-0.6 * winding, rel=0.05)
    assert told(0.0) == pytest.approx(0.0, abs=0.05)
    # Never more than the firmware keeps, nothing of what nobody can have been told, and nothing on
    # the ground, where it is forgotten.
    assert told(1.1, velocity=(0.0, 0.0, 0.0)) >= -2.0 * winding
    assert told(3.0) == pytest.approx(0.0, abs=0.05)
    pilot = SafePilot(fence(zones=()), limits)
    for step in range(400):
        pilot.see(flying(0.01 * step, streamed=(1.0, 0.0, 1.0), airborne=step < 350))
    assert first_setpoint(pilot, 4.0).acceleration[0] == pytest.approx(0.0, abs=0.05)


def test_the_integral_is_kept_within_what_the_firmware_keeps():
    limits = Limits(link_loss_margin=math.inf)
    pilot = SafePilot(fence(zones=()), limits)
    for step in range(1000):
        pilot.see(flying(0.01 * step, streamed=(0.0, -1.0, 1.0)))
    sent = first_setpoint(pilot, 10.0)
    assert sent.acceleration[1] == pytest.approx(2.0 * limits.vehicle.winding, rel=0.01)


def asked(told: FullState, height: float, climb: float) -> float:
    """m/s2 upwards that Mellinger's controller makes of a setpoint."""
    model = Limits().vehicle
    (_, _, z), (_, _, v), (_, _, a) = told.position, told.velocity, told.acceleration
    push = model.feed[2] * a + model.damping[2] * (v - climb)
    return float(push + model.stiffness[2] * (z - height))


def slowed(told: FullState, height: float, climb: float) -> float:
    """m/s2 downwards that the setpoint asks for."""
    return -asked(told, height, climb) / Limits().vehicle.feed[2]


@pytest.mark.parametrize("busy", [{"rates": (-5.0, 0.0, 0.0)}, {"quaternion": tilted(0.6)}])
def test_a_hold_leaves_a_vehicle_that_tips_what_it_needs_to_be_upright(busy):
    """Sinking fast, it would be stopped with all thrust there is, and go over."""
    moving = {"velocity": (0.0, 0.0, -1.5), "position": (0.0, 0.0, 0.5)}
    spare = GRAVITY * (Limits().vehicle.lift - 1.0)

    def most(**changes: object) -> float:
        pilot = SafePilot(fence(), Limits())
        pilot.see(flying(0.0, **moving))
        return max(
            asked(first_setpoint(pilot, 0.01 * k, **moving, **changes), 0.5, -1.5)
            for k in range(1, 40)
        )

    assert most(**busy) <= 1.51 * spare
    assert most() > 2.0 * spare


def test_a_hold_keeps_the_rotors_turning():
    """A climb to the ceiling: what would be too far up is not braked by doing without lift."""
    pilot = SafePilot(fence(), Limits())
    pilot.see(flying(0.0, position=(0.0, 0.0, 1.1), velocity=(0.0, 0.0, 2.6)))
    height, climb = 1.1, 2.6
    for k in range(1, 60):
        where = {"position": (0.0, 0.0, height), "velocity": (0.0, 0.0, climb)}
        told = first_setpoint(pilot, 0.01 * k, **where)
        push = asked(told, height, climb)
        assert push >= -0.61 * GRAVITY
        push = min(push, 0.53 * GRAVITY)
        height, climb = height + 0.01 * climb, climb + 0.01 * push
    assert height < 2.0
    assert abs(climb) < 0.5


def test_a_climb_far_below_the_ceiling_is_braked_gently_near_it_harder():
    def braking(height: float) -> float:
        pilot = SafePilot(fence(), Limits())
        moving = {"position": (0.0, 0.0, height), "velocity": (0.0, 0.0, 1.8)}
        pilot.see(flying(0.0, **moving))
        return slowed(first_setpoint(pilot, 0.01, **moving), height, 1.8)

    assert braking(0.5) == pytest.approx(2.5, abs=0.1)
    assert 2.6 < braking(1.3) < 5.0
    # As hard as rotors that must go on turning allow.
    hardest = (1.0 - steerable.CALM_LIFT) * GRAVITY / Limits().vehicle.feed[2]
    assert braking(1.9) == pytest.approx(hardest, abs=0.1)


def test_a_hold_that_is_the_last_word_brakes_by_the_place_it_tells():
    """Firmware that hears no more levels out without the acceleration it was told last."""
    pilot = SafePilot(fence(), Limits())
    moving = {"position": (0.0, 0.0, 1.2), "velocity": (1.0, 0.0, 2.0)}
    pilot.see(flying(0.0, **moving))
    told = first_setpoint(pilot, 0.01, **moving)
    assert told.acceleration[2] == 0.0
    assert slowed(told, 1.2, 2.0) > 2.5
    # By so little that other gains than the model's are worth no more than a tenth of it.
    assert told.position[2] > 1.2 - 0.2
    assert told.velocity[2] == pytest.approx(2.0, abs=0.1)
    sinking = {"position": (0.0, 0.0, 1.2), "velocity": (0.0, 0.0, -1.0)}
    pilot = SafePilot(fence(), Limits())
    pilot.see(flying(0.0, **sinking))
    assert first_setpoint(pilot, 0.01, **sinking).acceleration[2] > 1.0


@pytest.mark.parametrize(
    ("busy", "least"), [({}, 0.25), ({"rates": (-5.0, 0.0, 0.0)}, 0.4)], ids=["calm", "tips"]
)
def test_what_lift_is_left_to_one_that_must_not_climb(busy, least):
    pilot = SafePilot(fence(), Limits())
    moving = {"position": (0.0, 0.0, 1.95), "velocity": (0.0, 0.0, 0.3)}
    for k in range(60):
        obs = flying(0.02 * k, **moving, **busy)
        pilot.see(obs)
        sent = pilot.update(Action.HOLD, obs)
    # The rest is far below by now.
    (told,) = sent or [None]
    push = asked(told, 1.95, 0.3)
    assert push == pytest.approx((least - 1.0) * GRAVITY, abs=0.05)


def test_a_spin_is_not_stopped_at_once():
    def heading(rate: float) -> float:
        return float(first_setpoint(SafePilot(fence(), Limits()), 0.0, rates=(0.0, 0.0, rate)).yaw)

    assert heading(0.0) == 0.0
    assert heading(5.0) == pytest.approx(1.0)
    assert heading(-40.0) == pytest.approx(-2.0)
    assert heading(math.nan) == 0.0


def test_one_that_falls_does_not_drift_on_until_it_has_stopped_falling():
    def stops(velocity: tuple[float, float, float]) -> float:
        pilot = SafePilot(fence(zones=()), Limits(link_loss_margin=math.inf))
        told = first_setpoint(pilot, 0.0, velocity=velocity)
        return -velocity[0] / float(told.acceleration[0])

    braking = Limits().braking
    assert stops((0.2, 0.0, -3.0)) == pytest.approx(0.4 / braking)
    assert stops((2.0, 0.0, 0.0)) == pytest.approx(2.0 / braking)
    assert stops((2.0, 0.0, -2.0)) == pytest.approx(math.sqrt(8.0) / braking)


def test_a_landing_waits_until_it_is_beside_whoever_is_below():
    pilot = SafePilot(fence(), Limits())
    under = (0.1, 0.0, 0.03)
    for k in range(200):
        told = pilot.update(Action.LAND, flying(0.02 * k, below=(under,)))
    (sent,) = told or [None]
    assert isinstance(sent, FullState)
    assert sent.position[2] == pytest.approx(1.0)
    assert math.dist(sent.position[:2], under[:2]) > 0.4
    pilot.update(Action.LAND, flying(4.02))
    (sent,) = pilot.update(Action.LAND, flying(4.5))
    assert sent.velocity[2] < 0.0


def test_blind_it_comes_down_where_it_is():
    pilot = SafePilot(fence(), Limits())
    for k in range(200):
        told = pilot.update(Action.LAND, flying(0.02 * k, below=((0.1, 0.0, 0.03),), pose_age=1.0))
    (sent,) = told or [None]
    assert sent is None or sent.velocity[2] < 0.0
