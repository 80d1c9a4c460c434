"""Poses that are a vehicle's own estimate: when they were made, and when they are believed."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyarena.clock import VirtualClock
from crazyarena.errors import InputError
from crazyarena.mocap.onboard import Certainty, OnboardSource, certainty
from crazyarena.mocap.opening import open_source
from crazyarena.mocap.source import SourceState
from crazyarena.mocap.survey import read_track, write_taped
from crazyarena.types import Pose, Telemetry, VehicleState


def told(position=(1.0, 2.0, 0.5), position_std=0.01, velocity_std=0.02):
    state = VehicleState(
        0.0, np.array(position), np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3)
    )
    return Telemetry(0.0, state=state, position_std=position_std, velocity_std=velocity_std)


@given(
    first=st.integers(0, (1 << 24) - 1),
    delays=st.lists(st.floats(0.0, 0.2), min_size=5, max_size=60),
)
def test_capture_times_have_the_vehicle_s_own_distances(first, delays):
    clock = VirtualClock()
    source = OnboardSource(clock)
    arrived = 0.0
    for k, delay in enumerate([0.0, *delays]):
        # A cable keeps the order; the vehicle's clock passes 2^24 ms somewhere.
        arrived = max(arrived, 1.0 + 0.01 * k + delay)
        clock.sleep_until(arrived)
        source.told("cf1", told(), (first + 10 * k) % (1 << 24))
    frames = source.frames()
    assert len(frames) == len(delays) + 1
    times = np.array([frame.timestamp for frame in frames])
    np.testing.assert_allclose(times, 1.0 + 0.01 * np.arange(len(times)), atol=1e-3)
    assert all(frame.timestamp <= frame.received for frame in frames)


def test_a_vehicle_that_was_restarted_begins_a_new_clock():
    clock = VirtualClock()
    source = OnboardSource(clock)
    for stamp in (500_000, 500_010):
        clock.sleep_until(clock.now() + 0.01)
        source.told("cf1", told(), stamp)
    clock.sleep_until(5.0)
    source.told("cf1", told(), 900)
    assert source.frames()[-1].timestamp == pytest.approx(5.0, abs=1e-3)


def test_an_estimate_that_is_not_sure_counts_as_a_body_that_is_not_seen():
    clock = VirtualClock()
    source = OnboardSource(clock)
    source.told("cf1", told(), 0)
    source.told("cf1", told(position_std=0.4), 10)
    source.told("cf1", told(velocity_std=0.9), 20)
    source.told("cf1", told(position_std=None), 30)
    bodies = [set(frame.bodies) for frame in source.frames()]
    assert bodies == [{"cf1"}, set(), set(), set()]
    assert "does not tell how sure" in source.status.error
    source.told("cf1", told(), 40)
    assert source.status.error is None
    source.close()
    assert source.status.state is SourceState.CLOSED


def test_a_place_that_is_only_counted_is_asked_for_its_speed_alone():
    assert Certainty(relative=True).doubt(told(position_std=10.0)) is None
    assert "0.90 m/s" in Certainty(relative=True).doubt(told(velocity_std=0.9))
    assert "0.40 m only" in Certainty().doubt(told(position_std=0.4))
    assert Certainty().doubt(told(position_std=float("nan"))) is not None


@pytest.mark.parametrize(
    ("options", "words"),
    [({"rate": 3.0}, "unknown option 'rate'"), ({"position_std": 0.0}, "position_std: found 0")],
)
def test_wrong_options_are_named(options, words):
    with pytest.raises(InputError, match=words):
        certainty(False, options)


def test_where_cameras_are_needed_it_says_so():
    with pytest.raises(InputError, match="here cameras are needed"):
        open_source("onboard", clock=VirtualClock())


def test_a_track_that_was_measured_by_hand(tmp_path):
    file = tmp_path / "track.json"
    yaw = 0.3
    turned = np.array([0.0, 0.0, np.sin(0.5 * yaw), np.cos(0.5 * yaw)])
    write_taped(file, {"gate1": Pose(np.array([1.0, -2.0, 0.0]), turned)}, "level2")
    ((name, pose),) = read_track(file).items()
    assert name == "gate1"
    np.testing.assert_allclose(pose.position, [1.0, -2.0, 0.0])
    np.testing.assert_allclose(pose.quaternion, turned, atol=1e-5)
    document = json.loads(file.read_text())
    document["bodies"]["gate1"]["yaw"] = "left"
    file.write_text(json.dumps(document))
    with pytest.raises(InputError, match=r"track\.json: body gate1"):
        read_track(file)
