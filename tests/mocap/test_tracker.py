from __future__ import annotations

import time as stopwatch

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crazyarena.errors import InputError
from crazyarena.mocap.camera_model import Camera, CameraModel
from crazyarena.mocap.rotations import angle_between
from crazyarena.mocap.tracker import (
    ConstellationTracker,
    SingleMarkerTracker,
    TrackerConfig,
    TrackState,
    tracked_frame,
)
from crazyarena.mocap.tracker_kernels import greedy_match
from crazyarena.types import Pose, PoseFrame
from tests.mocap.flights import Flights


def crossing(count: int, seed: int, seconds: float):
    """Paths of ``count`` vehicles through one small volume, apart when they start."""
    rng = np.random.default_rng(seed)
    amplitude = rng.uniform(0.5, 1.6, (count, 3)) * [1.0, 1.0, 0.5]
    frequency = rng.uniform(0.3, 1.2, (count, 3))
    phase = rng.uniform(0, 2 * np.pi, (count, 3))

    def position(time: float) -> np.ndarray:
        return amplitude * np.sin(frequency * time + phase) + [0.0, 0.0, 1.3]

    def apart(time: float) -> float:
        p = position(time)
        return float((np.linalg.norm(p[:, None] - p[None], axis=2) + 9 * np.eye(count)).min())

    start = next(t for t in np.arange(0.0, 500.0, 0.05) if apart(t) > 0.1)
    return lambda time: position(start + time)


def follow(count: int, seconds: float, seed: int, dropout: float = 0.02, noise: float = 0.001):
    path = crossing(count, seed, seconds)
    rng = np.random.default_rng(seed)
    names = [f"cf{i + 1}" for i in range(count)]
    tracker = SingleMarkerTracker(dict(zip(names, path(0.0), strict=True)))
    run = np.zeros(count, dtype=int)
    longest, wrong, reported, closest, cost = 0, 0, 0, 9.0, []
    for k in range(round(seconds * 100)):
        truth = path(k / 100)
        gaps = np.linalg.norm(truth[:, None] - truth[None], axis=2) + 9 * np.eye(count)
        closest = min(closest, float(gaps.min()))
        cloud = (truth + rng.normal(0, noise, truth.shape))[rng.random(count) >= dropout]
        before = stopwatch.process_time()
        result = tracker.update(k / 100, rng.permutation(cloud))
        cost.append(stopwatch.process_time() - before)
        for i, name in enumerate(names):
            pose = result.poses.get(name)
            if pose is None:
                continue
            reported += 1
            owner = int(np.linalg.norm(truth - pose.position, axis=1).argmin())
            run[i] = run[i] + 1 if owner != i else 0
            wrong += owner != i
            longest = max(longest, int(run[i]))
    return longest, wrong, reported, closest, np.array(cost)


def test_crossing_vehicles_keep_their_names():
    longest, _, reported, closest, cost = follow(30, 8.0, seed=1)
    assert longest <= 3
    assert reported > 0.96 * 30 * 800
    assert closest < 0.08
    print(f"cost per frame p50 {np.median(cost) * 1e3:.2f} ms")


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_thirty_crossing_vehicles_for_a_minute(seed):
    longest, wrong, reported, closest, cost = follow(30, 60.0, seed)
    print(
        f"longest swap {longest} frames, wrong {wrong} of {reported}, closest approach "
        f"{closest * 1e2:.1f} cm, cost per frame p50 {np.median(cost) * 1e3:.2f} ms "
        f"p99 {np.percentile(cost, 99) * 1e3:.2f} ms (process time)"
    )
    assert longest <= 3
    assert reported > 0.97 * 30 * 6000


def test_loss_and_recovery_are_explicit():
    tracker = SingleMarkerTracker({"cf1": np.zeros(3), "cf2": np.ones(3)})
    both, one = np.array([[0.0, 0, 0], [1.0, 1, 1]]), np.array([[1.0, 1, 1]])
    seen = []
    for k in range(120):
        hidden = 20 <= k < 80
        result = tracker.update(k / 100, one if hidden else both)
        seen += [(k, *change) for change in result.changes if change[0] == "cf1"]
        assert ("cf1" in result.poses) == (result.states["cf1"] is TrackState.TRACKED)
        assert result.states["cf2"] is TrackState.TRACKED or k < 2
    assert [(k, after) for k, _, _, after in seen] == [
        (0, TrackState.TENTATIVE),
        (2, TrackState.TRACKED),
        (20, TrackState.COASTING),
        (45, TrackState.LOST),
        (80, TrackState.TENTATIVE),
        (82, TrackState.TRACKED),
    ]


def test_markers_of_nobody_stay_unassigned():
    tracker = SingleMarkerTracker({"cf1": np.zeros(3)})
    cloud = np.array([[2.0, 0, 0], [0.001, 0, 0], [0.0, 3.0, 0]])
    result = tracker.update(0.0, cloud)
    np.testing.assert_array_equal(result.unassigned, cloud[[0, 2]])
    frame = PoseFrame(0.01, 0.02, 1, {}, cloud)
    assert len(tracked_frame(frame, tracker)[0].markers) == 2


def test_start_positions_too_close_and_time_standing_still_are_refused():
    with pytest.raises(InputError, match="cf1 and cf2"):
        SingleMarkerTracker({"cf1": np.zeros(3), "cf2": np.full(3, 0.01)})
    tracker = SingleMarkerTracker({"cf1": np.zeros(3)})
    tracker.update(1.0, np.zeros((0, 3)))
    with pytest.raises(InputError, match="after one at"):
        tracker.update(1.0, np.zeros((0, 3)))


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_matching_is_one_to_one_stable_and_within_reach(seed):
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, 0.3, (4, 3, 3))
    real = rng.random((4, 3)) < 0.8
    cloud = rng.uniform(0, 0.3, (rng.integers(0, 15), 3))
    reach = rng.uniform(0.02, 0.2, 4)
    match = greedy_match(points, real, cloud, reach)
    used = match[match >= 0]
    assert len(set(used.tolist())) == len(used)
    assert (match[~real] == -1).all()
    if not len(cloud):
        return
    distance = np.linalg.norm(points[:, :, None] - cloud, axis=3)
    holder = {int(m): (b, k) for (b, k), m in np.ndenumerate(match) if m >= 0}
    for (b, k), m in np.ndenumerate(match):
        if not real[b, k]:
            continue
        mine = distance[b, k, m] if m >= 0 else reach[b]
        assert mine <= reach[b]
        for other in np.flatnonzero(distance[b, k] < mine - 1e-12):
            assert distance[holder[int(other)]][other] <= distance[b, k, other]


def arrangements(count: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(5)
    base = np.array(
        [[0.03, 0.0, 0.02], [-0.03, 0.02, 0.02], [0.0, -0.035, 0.03], [0.01, 0.03, 0.045]]
    )
    return {f"cf{i + 1}": base + rng.normal(0, 0.003, (4, 3)) for i in range(count)}


def test_constellations_give_position_and_attitude_of_many_bodies():
    count = 40
    flights = Flights(count, seed=6, spacing=2.5)
    constellations = arrangements(count)
    camera = Camera(
        CameraModel(output="markers", constellations=constellations, dropout=0.01),
        np.random.default_rng(1),
    )
    tracker = ConstellationTracker(constellations, flights(0.0))
    position, attitude, cost, reported = [], [], [], 0
    for k in range(200):
        truth = flights(k / 100)
        _, markers = camera.see(truth)
        before = stopwatch.process_time()
        result = tracker.update(k / 100, markers)
        cost.append(stopwatch.process_time() - before)
        for name, pose in result.poses.items():
            reported += 1
            position.append(np.linalg.norm(pose.position - truth[name].position))
            attitude.append(angle_between(pose.quaternion, truth[name].quaternion))
    print(f"{len(markers)} markers: cost p50 {np.median(cost) * 1e3:.1f} ms")
    assert reported > 0.97 * 200 * count
    assert np.percentile(position, 99) < 0.002
    assert np.percentile(attitude, 99) < 0.08
    assert max(attitude) < 0.3


def test_a_constellation_is_found_at_any_heading_and_after_a_loss():
    constellations = arrangements(1)
    camera = Camera(
        CameraModel(output="markers", constellations=constellations, dropout=0.0),
        np.random.default_rng(1),
    )
    for heading in np.linspace(0, 2 * np.pi, 9):
        quaternion = np.array([0.0, 0.0, np.sin(heading / 2), np.cos(heading / 2)])
        tracker = ConstellationTracker(constellations, {"cf1": Pose(np.zeros(3))})
        for k in range(100):
            hidden = 20 <= k < 60
            pose = Pose(np.array([0.02, 0.0, 0.1 if k >= 60 else 0.0]), quaternion)
            _, markers = camera.see({} if hidden else {"cf1": pose})
            result = tracker.update(k / 100, markers)
            if k == 59:
                assert result.states["cf1"] is TrackState.LOST
        assert angle_between(result.poses["cf1"].quaternion, quaternion) < 0.1
        assert np.linalg.norm(result.poses["cf1"].position - pose.position) < 0.003


def test_symmetric_and_degenerate_constellations_are_named():
    square = np.array([[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]]) * 0.03
    start = {"cf1": Pose(np.zeros(3))}
    assert ConstellationTracker({"cf1": square}, start).ambiguous() == ("cf1",)
    assert ConstellationTracker(arrangements(1), start).ambiguous() == ()
    with pytest.raises(InputError, match="cf1"):
        ConstellationTracker({"cf1": np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0]]) * 0.03}, start)
    with pytest.raises(InputError, match="initial"):
        ConstellationTracker(arrangements(1), {})


@pytest.mark.parametrize("field", ["gate", "max_fitness", "lost_after"])
def test_bad_settings_name_the_field(field):
    with pytest.raises(InputError, match=field):
        TrackerConfig(**{field: -1.0})
