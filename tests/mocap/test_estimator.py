from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crazyarena.clock import VirtualClock
from crazyarena.errors import InputError
from crazyarena.mocap.camera_model import CameraModel
from crazyarena.mocap.estimator import EstimatorConfig, Freshness, PoseEstimator
from crazyarena.mocap.events import EventKind
from crazyarena.mocap.forwarder import PoseForwarder
from crazyarena.mocap.pipeline import PosePipeline
from crazyarena.mocap.rotations import angle_between, multiply
from crazyarena.mocap.sim_source import SimSource
from crazyarena.types import Pose, PoseFrame
from tests.mocap.flights import Flights

RATE = 100.0
LATENCY = 0.008


def frames_of(flights: Flights, count: int, start: int = 0) -> list[PoseFrame]:
    return [
        PoseFrame(k / RATE, k / RATE + LATENCY, k, dict(flights(k / RATE)))
        for k in range(start, start + count)
    ]


def tracked(flights: Flights, count: int = 100, config: EstimatorConfig | None = None):
    estimator = PoseEstimator(flights.names, config)
    for frame in frames_of(flights, count):
        estimator.update(frame)
    return estimator


def worst_error(estimator: PoseEstimator, flights: Flights, now: float) -> float:
    truth = flights(now)
    return max(
        float(np.linalg.norm(e.state.position - truth[n].position))
        for n, e in estimator.estimates(now).items()
    )


def test_velocity_attitude_and_rates_follow_the_truth_under_the_default_cameras():
    flights = Flights(10, seed=3)
    clock = VirtualClock()
    source = SimSource(clock, flights, seed=3)
    estimator = PoseEstimator(flights.names)
    position, velocity, attitude, rates = [], [], [], []
    for k in range(20 * 60):
        clock.sleep_until(k / 60)
        for frame in source.frames():
            estimator.update(frame)
        if k < 60:
            continue
        now = clock.now()
        truth, true_velocity, true_rates = flights(now), flights.velocity(now), flights.rates(now)
        for i, (name, estimate) in enumerate(estimator.estimates(now).items()):
            position.append(estimate.state.position - truth[name].position)
            velocity.append(estimate.state.velocity - true_velocity[i])
            attitude.append(angle_between(estimate.state.quaternion, truth[name].quaternion))
            rates.append(estimate.state.angular_velocity - true_rates[i])

    def rms(values: list) -> float:
        return float(np.sqrt(np.mean(np.square(values))))

    figures = (rms(position) * 1e3, rms(velocity), rms(attitude), rms(rates))
    print("rms error: position {:.2f} mm, velocity {:.4f} m/s, attitude {:.4f} rad, "
          "rates {:.3f} rad/s".format(*figures))  # fmt: skip
    assert figures[0] < 1.5
    assert figures[1] < 0.05
    assert figures[2] < 0.02
    assert figures[3] < 0.3


def test_estimates_are_carried_forward_to_now():
    flights = Flights(3, seed=1)
    estimator = tracked(flights)
    last = 0.99
    for ahead in (0.0, 0.008, 0.02):
        assert worst_error(estimator, flights, last + ahead) < 0.002
    moved = [
        np.linalg.norm(
            estimator.estimate(n, last + 0.02).state.position
            - estimator.estimate(n, last).state.position
        )
        for n in flights.names
    ]
    expected = np.linalg.norm(flights.position(last + 0.02) - flights.position(last), axis=1)
    np.testing.assert_allclose(moved, expected, atol=1e-3)


@pytest.mark.parametrize("distance", [0.5, 0.12])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_jump_of_one_frame_reaches_nobody(distance, axis):
    flights = Flights(2, seed=2)
    estimator = tracked(flights)
    (frame,) = frames_of(flights, 1, 100)
    true = frame.bodies["cf1"]
    shifted = true.position.copy()
    shifted[axis] += distance
    frame = replace(frame, bodies={**frame.bodies, "cf1": Pose(shifted, true.quaternion)})
    result = estimator.update(frame)
    assert set(result.accepted) == {"cf2"}
    assert [(e.kind, e.body) for e in result.events] == [(EventKind.JUMP_REJECTED, "cf1")]
    assert worst_error(estimator, flights, 1.0) < 0.003
    assert estimator.estimate("cf1", 1.0 + LATENCY).freshness is Freshness.FRESH
    (after,) = frames_of(flights, 1, 101)
    assert set(estimator.update(after).accepted) == {"cf1", "cf2"}


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_flip_reaches_nobody_however_long_it_lasts(axis):
    flights = Flights(2, seed=2)
    estimator = tracked(flights)
    half_turn = np.zeros(4)
    half_turn[axis] = 1.0
    kinds = []
    for k, frame in enumerate(frames_of(flights, 40, 100)):
        true = frame.bodies["cf1"]
        flipped = Pose(true.position, multiply(true.quaternion, half_turn))
        result = estimator.update(replace(frame, bodies={**frame.bodies, "cf1": flipped}))
        kinds += [e.kind for e in result.events]
        kinds += [e.kind for e in estimator.check(frame.received)]
        assert "cf1" not in result.accepted
        attitude = estimator.estimate("cf1", frame.timestamp).state.quaternion
        if k < 10:
            assert angle_between(attitude, true.quaternion) < 0.1
        else:
            assert angle_between(attitude, true.quaternion) < 1.5
    assert kinds == [EventKind.FLIP_REJECTED, EventKind.BODY_STALE]
    (after,) = frames_of(flights, 1, 140)
    assert "cf1" in estimator.update(after).accepted


def test_exchanged_names_are_given_back_to_their_bodies():
    flights = Flights(3, seed=5, spacing=3.0)
    estimator = tracked(flights)
    for k, frame in enumerate(frames_of(flights, 50, 100)):
        bodies = dict(frame.bodies)
        bodies["cf1"], bodies["cf3"] = bodies["cf3"], bodies["cf1"]
        result = estimator.update(replace(frame, bodies=bodies))
        kinds = {e.kind for e in result.events}
        assert kinds == ({EventKind.SWAP_CORRECTED} if k == 0 else set())
        for name, pose in result.accepted.items():
            assert pose is frame.bodies[name]
        assert worst_error(estimator, flights, frame.timestamp) < 0.002


def test_without_correction_exchanged_names_are_rejected():
    flights = Flights(3, seed=5, spacing=3.0)
    estimator = tracked(flights, config=EstimatorConfig(correct_swaps=False))
    (frame,) = frames_of(flights, 1, 100)
    bodies = dict(frame.bodies)
    bodies["cf1"], bodies["cf3"] = bodies["cf3"], bodies["cf1"]
    result = estimator.update(replace(frame, bodies=bodies))
    assert set(result.accepted) == {"cf2"}


def test_a_dropout_of_100_ms_is_bridged_and_a_longer_one_stale_on_time():
    flights = Flights(2, seed=7)
    config = EstimatorConfig(stale_after=0.15)
    estimator = tracked(flights, config=config)
    last = 0.99
    for age in np.arange(0.0005, 0.15, 0.001):
        now = last + age
        events = estimator.check(now)
        estimate = estimator.estimate("cf1", now)
        assert not events
        assert estimate.freshness is (Freshness.FRESH if age <= 0.03 else Freshness.BRIDGED)
    assert worst_error(estimator, flights, last + 0.1) < 0.05
    (event, _) = estimator.check(last + 0.151)
    assert event.kind is EventKind.BODY_STALE
    assert estimator.check(last + 0.2) == ()
    assert estimator.estimate("cf1", last + 0.151).freshness is Freshness.STALE
    assert estimator.poses(last + 0.151) == {}
    assert set(estimator.poses(last + 0.149)) == {"cf1", "cf2"}


def test_after_a_bridged_dropout_the_track_goes_on_at_once():
    flights = Flights(4, seed=7)
    estimator = tracked(flights)
    for frame in frames_of(flights, 20, 110):
        assert set(estimator.update(frame).accepted) == set(flights.names)


def test_a_body_that_was_lost_is_taken_again_after_a_run_that_agrees():
    flights = Flights(1, seed=8)
    estimator = tracked(flights)
    estimator.check(2.0)
    accepted = [bool(estimator.update(f).accepted) for f in frames_of(flights, 5, 200)]
    assert accepted == [False, False, True, True, True]


def test_a_track_never_starts_from_poses_that_disagree_or_hang_upside_down():
    rng = np.random.default_rng(0)
    estimator = PoseEstimator(["cf1"])
    for k in range(100):
        wild = Pose(rng.uniform(-3, 3, 3))
        assert not estimator.update(PoseFrame(k / RATE, k / RATE, k, {"cf1": wild})).accepted
    for k in range(100, 200):
        upside_down = Pose(np.ones(3), np.array([1.0, 0.0, 0.0, 0.0]))
        frame = PoseFrame(k / RATE, k / RATE, k, {"cf1": upside_down})
        assert not estimator.update(frame).accepted


def test_a_frame_sent_twice_does_not_make_a_body_fresh():
    flights = Flights(1, seed=8)
    estimator = tracked(flights)
    (frame,) = frames_of(flights, 1, 99)
    for _ in range(50):
        assert not estimator.update(frame).accepted
    assert estimator.estimate("cf1", 1.5).freshness is Freshness.STALE


def test_a_frozen_pose_becomes_stale_and_a_living_one_does_not():
    flights = Flights(2, seed=8)
    estimator = tracked(flights, config=EstimatorConfig(frozen_after=0.25))
    frozen = flights(0.99)["cf1"]
    kinds = []
    for frame in frames_of(flights, 60, 100):
        frame = replace(frame, bodies={"cf1": frozen, "cf2": Pose(np.ones(3) * frame.timestamp)})
        result = estimator.update(frame)
        kinds += [e.kind for e in (*result.events, *estimator.check(frame.received))
                  if e.body == "cf1"]  # fmt: skip
    assert EventKind.BODY_FROZEN in kinds
    assert kinds[-1] is EventKind.BODY_STALE
    assert estimator.estimate("cf1", 1.6).freshness is Freshness.STALE
    still = PoseEstimator(["cf1"])
    for k in range(100):
        still.update(PoseFrame(k / RATE, k / RATE, k, {"cf1": frozen}))
    assert still.estimate("cf1", 1.0).freshness is Freshness.FRESH


def test_outliers_of_the_camera_model_never_reach_vehicle_or_referee():
    flights = Flights(6, seed=11, spacing=2.0)
    model = CameraModel(
        jump=0.01, flip=0.01, name_swap=0.02, swap_frames=5, dropout=0.005, frame_loss=0.005
    )
    clock = VirtualClock()
    sent: list[tuple[float, dict]] = []
    forwarder = PoseForwarder(
        {n: i for i, n in enumerate(flights.names)},
        lambda poses: sent.append((clock.now(), dict(poses))),
        clock,
    )
    captured = []
    pipeline = PosePipeline(
        SimSource(clock, flights, model, seed=4),
        PoseEstimator(flights.names),
        clock,
        forwarder=forwarder,
        on_frame=[lambda frame, result: captured.append((frame.timestamp, result.accepted))],
    )
    worst_position = worst_attitude = 0.0
    for k in range(30 * 120):
        clock.sleep_until(k / 120)
        pipeline.poll()
        truth = flights(clock.now())
        for name, pose in pipeline.poses().items():
            error = float(np.linalg.norm(pose.position - truth[name].position))
            worst_position = max(worst_position, error)
            angle = angle_between(pose.quaternion, truth[name].quaternion)
            worst_attitude = max(worst_attitude, angle)
    assert worst_position < 0.1
    assert worst_attitude < 0.6
    assert pipeline.estimator.rejected > 100
    assert pipeline.estimator.swaps > 50
    for time, accepted in captured:
        truth = flights(time)
        for name, pose in accepted.items():
            assert np.linalg.norm(pose.position - truth[name].position) < 0.09
            assert angle_between(pose.quaternion, truth[name].quaternion) < 0.7
    offered = {id(pose) for _, accepted in captured for pose in accepted.values()}
    assert len(sent) > 2000
    assert all(id(pose) in offered for _, poses in sent for pose in poses.values())


numbers = st.one_of(
    st.floats(-3, 3), st.sampled_from([0.0, 1.0, float("nan"), float("inf"), 1e300, 1e-300])
)


@settings(max_examples=200, deadline=None)
@given(
    st.lists(numbers, min_size=7, max_size=7),
    st.one_of(st.floats(-1, 3), st.sampled_from([float("nan"), float("inf"), 1e12])),
)
def test_garbage_in_one_frame_neither_passes_nor_stays(values, time):
    flights = Flights(2, seed=2)
    estimator = tracked(flights)
    garbage = Pose(np.array(values[:3]), np.array(values[3:]))
    truth = flights(1.0)["cf1"]
    result = estimator.update(PoseFrame(time, 1.0, 100, {"cf1": garbage}))
    if "cf1" in result.accepted:
        assert np.linalg.norm(garbage.position - truth.position) < 0.5
        assert abs(np.linalg.norm(garbage.quaternion) - 1) < 0.01
        assert angle_between(garbage.quaternion, truth.quaternion) < 2.3
    else:
        for frame in frames_of(flights, 2, 101):
            assert set(estimator.update(frame).accepted) == {"cf1", "cf2"}
        assert worst_error(estimator, flights, 1.02) < 0.01
    state = estimator.estimate("cf1", 1.05).state
    for numbers_out in (state.position, state.velocity, state.quaternion, state.angular_velocity):
        assert np.isfinite(numbers_out).all()


@pytest.mark.parametrize(
    "changes", [{"stale_after": 0.0}, {"jerk": float("nan")}, {"confirm_frames": 1}]
)
def test_bad_settings_name_the_field(changes):
    with pytest.raises(InputError, match=next(iter(changes))):
        EstimatorConfig(**changes)


def test_unknown_and_doubled_names_are_refused():
    with pytest.raises(InputError, match="twice"):
        PoseEstimator(["cf1", "cf1"])
    with pytest.raises(InputError, match="cf9"):
        PoseEstimator(["cf1"]).estimate("cf9", 0.0)
