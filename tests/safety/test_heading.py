"""A rigid body whose nose is not the vehicle's is found by the gyroscope, and by how much."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from crazyarena.runner.campaign.turned import fly_turned
from crazyarena.safety.heading import GRAVITY, HeadingWatch, Turned
from crazyarena.safety.limits import Limits

RATE = 100.0  # Hz
ANGLES = st.floats(-math.pi, math.pi)


def rotation(rpy):
    """Quaternion x, y, z, w of ZYX Euler angles."""
    (sr, sp, sy), (cr, cp, cy) = np.sin(np.array(rpy) / 2), np.cos(np.array(rpy) / 2)
    return (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )


def watched(angle=0.0, *, heading=0.4, size=0.1, turning=0.0, noise=0.0, mirrored=False, seconds=3):
    """What is found out of a vehicle that rolls and pitches at its place, with perfect physics."""
    rng = np.random.default_rng(5)
    watch = HeadingWatch()
    place, speed = np.zeros(2), np.zeros(2)
    for k in range(round(seconds * RATE)):
        t = k / RATE
        # Slow rolling and pitching of small size: what a hovering vehicle does.
        roll, pitch = size * math.sin(7.0 * t), size * math.sin(5.0 * t + 1.0)
        gyro = (
            7.0 * size * math.cos(7.0 * t),
            5.0 * size * math.cos(5.0 * t + 1.0),
            rng.normal(0.0, 1e-3),
        )
        ahead, left = GRAVITY * pitch, -GRAVITY * roll
        c, s = math.cos(heading), math.sin(heading)
        push = np.array([c * ahead - s * left, s * ahead + c * left])
        speed = speed + push / RATE
        place = place + speed / RATE
        x, y = place + rng.normal(0.0, 1.0, 2) * 0.0005 * noise
        # In the body's own axes roll and pitch are others, and its heading is.
        now = angle + turning * t
        cb, sb = math.cos(now), math.sin(now)
        seen = (cb * roll + sb * pitch, cb * pitch - sb * roll, heading + now)
        q = rotation(np.array(seen) + rng.normal(0.0, 0.008 * noise, 3))
        if mirrored:
            y, q = -y, (-q[0], q[1], -q[2], q[3])
        found = watch.update(t, (x, y, 1.0), q, gyro)
    return found


@settings(max_examples=25, deadline=None)
@given(ANGLES, ANGLES)
def test_the_angle_is_found_whatever_the_heading(angle, heading):
    found = watched(angle, heading=heading, noise=1.0)
    assert math.degrees(abs(math.remainder(found.angle - angle, math.tau))) < 4.0
    assert math.degrees(found.sigma) < 3.0
    assert abs(found.yaw) < 0.1
    assert not found.mirrored


def test_small_tilts_show_it_by_the_way_that_they_push():
    # Four millirad, half of what cameras see of an attitude.
    found = watched(0.8, size=0.004, noise=1.0, seconds=6)
    assert math.degrees(abs(found.angle - 0.8)) < 10.0
    assert found.surely > 0.2


@pytest.mark.parametrize("size", [0.4, 0.9])
@pytest.mark.parametrize("spin", [0.0, 3.0])
def test_one_that_throws_itself_about_shows_it_as_well(size, spin):
    """Turned by 0.7 rad, about all its axes: nothing is small then."""
    rng = np.random.default_rng(2)
    watch, angle, place, speed = HeadingWatch(), 0.7, np.zeros(3), np.zeros(3)
    step = 1.0 / RATE
    for k in range(150):
        t = k * step
        before, now, after = (
            Rotation.from_euler(
                "ZYX", [spin * s, size * math.sin(6.0 * s + 1.0), size * math.sin(8.0 * s)]
            )
            for s in (t - 1e-4, t, t + 1e-4)
        )
        gyro = (before.inv() * after).as_rotvec() / 2e-4
        speed = speed + step * GRAVITY * (now.apply([0.0, 0.0, 1.0]) - [0.0, 0.0, 1.0])
        place = place + step * speed
        noise = Rotation.from_rotvec(rng.normal(0.0, 0.008, 3))
        seen = now * Rotation.from_euler("Z", angle) * noise
        found = watch.update(t, tuple(place), tuple(seen.as_quat()), tuple(gyro))
    assert math.degrees(abs(math.remainder(found.angle - angle, math.tau))) < 3.0
    assert found.known


def test_nothing_is_said_of_a_vehicle_that_does_not_move():
    assert watched(1.5, size=0.0, noise=1.0).surely == 0.0


def test_mirrored_axes_are_told_from_turned_ones():
    found = watched(0.0, mirrored=True, noise=1.0)
    assert found.mirrored
    assert "mirror" in found.remedy


@pytest.mark.parametrize("rate", [1.0, -1.0])
def test_a_turning_yaw_is_found(rate):
    found = watched(0.0, turning=rate, seconds=1)
    assert found.yaw == pytest.approx(rate, rel=0.3)
    assert "gyroscope" in found.remedy


def test_a_yaw_that_the_gyroscope_feels_is_none():
    watch = HeadingWatch()
    for k in range(300):
        found = watch.update(0.01 * k, (0, 0, 1), rotation((0, 0, 0.02 * k)), (1e-4, 0, 2.0))
    assert abs(found.yaw) < 0.05


def test_pauses_and_repeated_times_are_no_motion():
    watch = HeadingWatch()
    watch.update(0.0, (0, 0, 1), rotation((0, 0, 0)), (0, 0, 0))
    watch.update(0.0, (5, 0, 1), rotation((0, 0, 3)), (0, 0, 0))
    found = watch.update(9.0, (0, 9, 1), rotation((0, 0, 2)), (0, 0, 0))
    assert found == Turned()


def test_the_remedy_says_which_way():
    assert "+90 deg against" in Turned(math.pi / 2, 0.1).remedy
    assert "by -90 deg about z" in Turned(math.pi / 2, 0.1).remedy


# In flight, with estimator, watchdog and gate.


@pytest.mark.parametrize("degrees", [45, -90, 180])
def test_far_turned_is_cut_before_it_gets_away(degrees):
    flight = fly_turned(math.radians(degrees), 1)
    assert flight.taken[0] == "body_turned_far"
    assert flight.way < 0.3
    assert flight.excursion < 0.0
    (told,) = re.findall(r"turned by (\S+) deg against", flight.told)
    assert abs(math.remainder(float(told) - degrees, 360.0)) < 25.0


@pytest.mark.parametrize("degrees", [45, -45, 135])
def test_a_vehicle_that_rises_straight_up_is_cut_before_it_is_high(degrees):
    flight = fly_turned(math.radians(degrees), 3, climb=2.0)
    assert flight.taken[0] == "body_turned_far"
    assert flight.height < 0.3
    assert flight.way < 0.1


def test_a_little_turned_is_named_in_a_calm_flight():
    flight = fly_turned(math.radians(-20), 4, climb=2.5)
    assert flight.warned < 3.0
    assert flight.taken == ()
    (told,) = re.findall(r"turned by (\S+) deg against", flight.told)
    assert float(told) == pytest.approx(-20, abs=5)


@pytest.mark.parametrize("climb", [None, 2.0])
def test_ten_degrees_are_nobodys_business_in_any_flight(climb):
    flight = fly_turned(math.radians(10), 5, climb=climb)
    assert (flight.told, flight.taken) == ("", ())


def test_without_the_nudge_a_straight_climb_shows_little():
    # What the nudge is for; if this fails, it is no longer needed.
    flight = fly_turned(math.radians(45), 3, climb=2.0, limits=Limits(nudge=0.0))
    assert not flight.height < 0.3


def test_a_little_turned_is_told_and_flown():
    flight = fly_turned(math.radians(20), 1)
    assert flight.warned < 3.0
    assert flight.taken == ()
    assert "turned by +" in flight.told


def test_a_yaw_that_slowly_turns_is_cut():
    flight = fly_turned(0.0, 0, turning=1.0)
    # Meanwhile it is turned, too: whatever says so first.
    assert flight.taken[0] in ("yaw_apart", "body_turned_far")
    assert flight.way < 0.3


@pytest.mark.parametrize("seed", [0, 8])
def test_sent_to_the_opposite_heading_it_is_cut_before_it_is_high(seed):
    """Spun at once it would be deaf in roll and pitch meanwhile, and show nothing."""
    flight = fly_turned(math.pi, seed, about=True)
    assert flight.taken[0] == "body_turned_far"
    assert flight.height < 0.3
    assert flight.way < 0.1
