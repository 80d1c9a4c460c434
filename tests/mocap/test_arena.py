"""Conventions, simulated cameras, forwarding, survey and the health check."""

from __future__ import annotations

import json
import threading
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyarena.clock import VirtualClock, WallClock
from crazyarena.errors import InputError
from crazyarena.mocap.camera_model import CameraModel
from crazyarena.mocap.check import CheckLimits, MocapCheck, report_lines
from crazyarena.mocap.forwarder import PoseForwarder
from crazyarena.mocap.frames import Convention, points_from_y_up, pose_from_y_up, xyzw_from_wxyz
from crazyarena.mocap.rotations import (
    angle_between,
    conjugate,
    euler_xyz,
    matrix_of,
    multiply,
    quaternion_of,
    rotate,
)
from crazyarena.mocap.serve import relay
from crazyarena.mocap.sim_source import SimSource
from crazyarena.mocap.source import FrameQueue, SourceState, SourceStatus
from crazyarena.mocap.stamps import StampReader, host_id, host_time
from crazyarena.mocap.survey import SurveyConfig, read_track, survey, write_track
from crazyarena.types import Pose, PoseFrame
from tests.mocap.flights import Flights, standing

quaternions = st.lists(st.floats(-1, 1), min_size=4, max_size=4).map(np.array).filter(
    lambda q: np.linalg.norm(q) > 0.1
).map(lambda q: q / np.linalg.norm(q))  # fmt: skip
vectors = st.lists(st.floats(-5, 5), min_size=3, max_size=3).map(np.array)


@given(quaternions, quaternions, vectors)
def test_rotations_agree_with_each_other(a, b, v):
    np.testing.assert_allclose(rotate(multiply(a, b), v), rotate(a, rotate(b, v)), atol=1e-9)
    np.testing.assert_allclose(rotate(conjugate(a), rotate(a, v)), v, atol=1e-9)
    assert angle_between(a, quaternion_of(matrix_of(a))) < 1e-6
    x, y, z = euler_xyz(a)
    turns = [
        np.eye(4)[i] * np.sin(t / 2) + [0, 0, 0, np.cos(t / 2)] for i, t in enumerate((x, y, z))
    ]
    assert angle_between(a, multiply(multiply(turns[0], turns[1]), turns[2])) < 1e-5  # fmt: skip


@given(st.floats(-4, 4), st.sampled_from((-1.0, 1.0)), st.floats(0.0, 1e-5), st.floats(-4, 4))
def test_angles_are_right_where_two_axes_become_one(a, side, short, c):
    turns = (a, side * (np.pi / 2 - short), c)
    rolls = [np.eye(4)[i] * np.sin(t / 2) + [0, 0, 0, np.cos(t / 2)] for i, t in enumerate(turns)]
    wanted = multiply(multiply(rolls[0], rolls[1]), rolls[2])
    again = [
        np.eye(4)[i] * np.sin(t / 2) + [0, 0, 0, np.cos(t / 2)]
        for i, t in enumerate(euler_xyz(wanted))
    ]
    assert angle_between(wanted, multiply(multiply(again[0], again[1]), again[2])) < 1e-6


def test_y_up_worlds_stand_up():
    np.testing.assert_allclose(points_from_y_up(np.array([[1.0, 2.0, 3.0]])), [[1, -3, 2]])
    level = pose_from_y_up(Pose(np.array([1.0, 2.0, 3.0])))
    np.testing.assert_allclose(level.position, [1, -3, 2], atol=1e-12)
    assert angle_between(level.quaternion, np.array([0.0, 0, 0, 1])) < 1e-9
    heading = np.array([0.0, np.sin(0.3), 0.0, np.cos(0.3)])
    turned = pose_from_y_up(Pose(np.zeros(3), heading))
    assert angle_between(turned.quaternion, np.array([0, 0, np.sin(0.3), np.cos(0.3)])) < 1e-9
    np.testing.assert_array_equal(xyzw_from_wxyz(np.array([1, 2, 3, 4])), [2, 3, 4, 1])


@given(quaternions, vectors, quaternions, vectors)
def test_conventions_keep_bodies_rigid(q, p, world_q, world_p):
    convention = Convention(axes="y-up", scale=1e-3, world=Pose(world_p, world_q))
    pose = Pose(p, q)
    point = np.array([0.1, -0.2, 0.3])
    marker = (p + rotate(q, point * 1e3))[None]
    ours = convention.body("cf1", pose)
    seen = convention.points(marker)[0]
    assert np.linalg.norm(seen - ours.position) == pytest.approx(np.linalg.norm(point), abs=1e-9)


def test_offsets_and_names_are_applied_in_the_body_frame():
    quarter = np.array([0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)])
    convention = Convention(offsets={"Drone 1": Pose(np.array([0.1, 0, 0]), quarter)},
                            rename={"Drone 1": "cf1"})  # fmt: skip
    frame = PoseFrame(0.0, 0.0, 0, {"Drone 1": Pose(np.array([1.0, 2, 3]), quarter)})
    pose = convention.frame(frame).bodies["cf1"]
    np.testing.assert_allclose(pose.position, [1.0, 2.1, 3.0], atol=1e-12)
    assert angle_between(pose.quaternion, np.array([0, 0, 1.0, 0])) < 1e-9
    for bad in ({"axes": "x-up"}, {"scale": 0.0}):
        with pytest.raises(InputError, match=next(iter(bad))):
            Convention(**bad)


def sim_frames(model: CameraModel, seconds: float, seed: int = 0, bodies: int = 3):
    clock = VirtualClock()
    source = SimSource(clock, Flights(bodies, seed=1), model, seed)
    frames = []
    for k in range(round(seconds * 50)):
        clock.sleep_until((k + 1) / 50)
        frames += source.frames(1.0)
    return frames, source


def test_simulated_cameras_keep_rate_latency_noise_and_loss():
    model = CameraModel(rate=200.0, latency=0.01, latency_jitter=0.001, position_noise=0.001,
                        dropout=0.02, dropout_frames=3.0, frame_loss=0.01)  # fmt: skip
    frames, source = sim_frames(model, 20.0)
    truth = Flights(3, seed=1)
    ids = np.array([f.frame_id for f in frames])
    assert (np.diff(ids) > 0).all()
    np.testing.assert_allclose([f.timestamp for f in frames], ids / 200.0, atol=1e-12)
    lost = 4000 - len(frames)
    assert 15 < source.status.lost < 80
    assert abs(lost - source.status.lost) <= 3
    delay = np.array([f.received - f.timestamp for f in frames])
    assert delay.min() >= 0.01
    assert 0.0105 < delay.mean() < 0.0112
    assert (np.diff([f.received for f in frames]) >= 0).all()
    errors = [f.bodies[n].position - truth(f.timestamp)[n].position
              for f in frames[::20] for n in f.bodies]  # fmt: skip
    assert np.std(errors) == pytest.approx(0.001, rel=0.1)
    seen = sum(len(f.bodies) for f in frames) / (3 * len(frames))
    assert 0.91 < seen < 0.97


def test_equal_seeds_give_equal_frames_and_others_do_not():
    model = CameraModel(jump=0.05, flip=0.05, name_swap=0.05, output="both", dropout=0.05)

    def digest(seed: int) -> bytes:
        frames, _ = sim_frames(model, 2.0, seed)
        return b"".join(
            f.markers.tobytes() + b"".join(n.encode() + p.position.tobytes()
                                           for n, p in f.bodies.items())
            for f in frames
        )  # fmt: skip

    assert digest(1) == digest(1)
    assert digest(1) != digest(2)


def test_a_simulator_may_push_exposures_itself():
    clock = VirtualClock()
    source = SimSource(clock, model=CameraModel(rate=100.0, latency=0.005, latency_jitter=0.0))
    truth = Flights(2, seed=1)

    def advance(now: float) -> None:
        while source.next_exposure <= now:
            source.expose(source.next_exposure, truth(source.next_exposure))

    clock.on_advance(advance)
    clock.sleep_until(0.1)
    assert [f.frame_id for f in source.frames()] == list(range(10))
    source.close()
    assert source.frames() == []


def test_merged_markers_and_bad_camera_settings():
    two = {"a": Pose(np.zeros(3)), "b": Pose(np.array([0.005, 0, 0])), "c": Pose(np.ones(3))}
    model = CameraModel(output="markers", merge_distance=0.02, dropout=0.0)
    clock = VirtualClock()
    source = SimSource(clock, standing(two), model)
    clock.sleep_until(0.1)
    assert all(len(f.markers) == 2 and not f.bodies for f in source.frames())
    for bad in ({"dropout": 2.0}, {"rate": 0.0}, {"latency": -1.0}, {"output": "all"}):
        with pytest.raises(InputError, match=next(iter(bad))):
            CameraModel(**bad)


def test_forwarding_keeps_the_rate_and_counts_age():
    clock = VirtualClock()
    batches = []
    forwarder = PoseForwarder({"cf1": 7, "cf2": 9}, batches.append, clock, rate=100.0)
    for k in range(900):
        captured = k / 300
        clock.sleep_until(captured + 0.008)
        poses = {"cf1": Pose(np.full(3, float(k))), "gate": Pose(np.zeros(3))}
        if k % 2:
            poses["cf2"] = Pose(np.zeros(3))
        forwarder.submit(captured, poses, clock.now())
        forwarder.flush()
    statistics = forwarder.statistics()
    assert statistics[7].rate == pytest.approx(100.0, rel=0.02)
    assert statistics[9].rate == pytest.approx(75.0, rel=0.34)
    assert statistics[7].age_p50 == pytest.approx(0.008)
    assert statistics[7].overtaken == 0
    assert {vehicle for batch in batches for vehicle in batch} == {7, 9}
    values = [batch[7].position[0] for batch in batches if 7 in batch]
    assert values == sorted(set(values))


@pytest.mark.parametrize("rate", [60.0, 100.0, 1000.0])
def test_slower_cameras_are_forwarded_whole(rate):
    clock = VirtualClock()
    sent = []
    forwarder = PoseForwarder({"cf1": 1}, sent.append, clock, rate=rate)
    for k in range(100):
        clock.sleep_until(k / 50)
        forwarder.submit(k / 50, {"cf1": Pose(np.zeros(3))}, k / 50)
        forwarder.submit(k / 50, {"cf1": Pose(np.zeros(3))}, k / 50)
        forwarder.flush()
    assert len(sent) == 100


def test_a_slow_link_gets_the_newest_pose_and_holds_nobody_up():
    clock = WallClock()
    gate, started, sent = threading.Event(), threading.Event(), []

    def slow(poses) -> None:
        sent.append(poses[1].position[0])
        started.set()
        gate.wait(5.0)

    forwarder = PoseForwarder({"cf1": 1}, slow, clock, rate=1e6, threaded=True)
    forwarder.submit(0.0, {"cf1": Pose(np.zeros(3))}, 0.0)
    assert started.wait(5.0)
    for k in range(1, 100):
        forwarder.submit(k / 100, {"cf1": Pose(np.full(3, float(k)))}, k / 100)
    started.clear()
    gate.set()
    assert started.wait(5.0)
    forwarder.close()
    assert sent == [0.0, 99.0]
    assert forwarder.statistics()[1].overtaken == 98


def test_positions_alone_and_failing_links():
    clock = VirtualClock()
    positions = []

    def broken(_) -> None:
        raise OSError("radio unplugged")

    forwarder = PoseForwarder({"cf1": 1}, broken, clock, mode="position",
                              send_positions=positions.append)  # fmt: skip
    forwarder.submit(0.0, {"cf1": Pose(np.arange(3.0))}, 0.0)
    forwarder.flush()
    np.testing.assert_array_equal(positions[0][1], np.arange(3.0))
    forwarder = PoseForwarder({"cf1": 1}, broken, clock)
    forwarder.submit(0.0, {"cf1": Pose(np.zeros(3))}, 0.0)
    forwarder.flush()
    assert forwarder.failures == 1
    assert forwarder.statistics()[1].sent == 0
    assert "radio unplugged" in (forwarder.last_failure or "")
    for bad in ({"rate": 0.0}, {"mode": "velocity"}, {"mode": "position"}):
        with pytest.raises(InputError, match="external pose"):
            PoseForwarder({"cf1": 1}, broken, clock, **bad)


def gates() -> dict[str, Pose]:
    turned = np.array([0.0, 0.0, np.sin(0.4), np.cos(0.4)])
    return {"gate1": Pose(np.array([1.0, 2, 1]), turned), "gate2": Pose(np.array([-1.0, 0, 1]))}


def survey_of(actual: dict[str, Pose], model: CameraModel | None = None, **settings):
    clock = VirtualClock()
    source = SimSource(clock, standing(actual), model or CameraModel(rate=100.0, jump=0.02))
    clock.sleep_until(3.0)
    return survey(source.frames(), gates(), SurveyConfig(**settings))


def test_a_survey_averages_and_writes_the_track(tmp_path):
    actual = gates()
    actual["gate1"] = Pose(
        actual["gate1"].position + [0.05, -0.03, 0.0], actual["gate1"].quaternion
    )
    report = survey_of(actual)
    assert report.accepted
    write_track(tmp_path / "track.json", report, "level2")
    track = read_track(tmp_path / "track.json")
    assert list(track) == ["gate1", "gate2"]
    for name, pose in track.items():
        np.testing.assert_allclose(pose.position, actual[name].position, atol=3e-4)
        assert angle_between(pose.quaternion, actual[name].quaternion) < 3e-3
    assert report.bodies[0].deviation == pytest.approx(0.0583, abs=1e-3)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (([0.3, 0, 0], [0.0, 0, 0, 1]), "30.0 cm from its nominal"),
        (([0.0, 0, 0], [0.0, 0, 0.17, 0.9854]), "turned by"),
        (([0.0, 0, 0], [0.087, 0, 0, 0.9962]), "leans by"),
    ],
)
def test_a_survey_refuses_what_stands_wrong(tmp_path, change, words):
    actual = gates()
    moved, turned = (np.array(part) for part in change)
    gate = actual["gate1"]
    actual["gate1"] = Pose(gate.position + moved, multiply(gate.quaternion, turned))
    report = survey_of(actual)
    assert len(report.problems) == 1
    assert words in report.problems[0]
    with pytest.raises(InputError, match="gate1"):
        write_track(tmp_path / "track.json", report)
    assert not (tmp_path / "track.json").exists()


def test_a_survey_refuses_what_is_hidden_moves_or_is_too_short():
    (problem,) = survey_of({"gate1": gates()["gate1"]}).problems
    assert "gate2 was not seen" in problem
    assert "gate1 moves" in survey_of(gates(), CameraModel(position_noise=0.01)).problems[0]
    assert "needed" in survey_of(gates(), frames=1000).problems[0]
    symmetric = gates()
    symmetric["gate2"] = Pose(symmetric["gate2"].position, np.array([0.0, 0, 1, 0]))
    assert "turned" in survey_of(symmetric).problems[0]
    assert survey_of(symmetric, full_turn=False).accepted


def test_damaged_track_files_are_input_errors(tmp_path):
    path = tmp_path / "track.json"
    body = {"position": [0, 0], "quaternion": [0, 0, 0, 1]}
    for text in ("{", "[]", json.dumps({"format": "x"}),
                 json.dumps({"format": "crazyarena-measured-track", "version": 1,
                             "bodies": {"g": body}})):  # fmt: skip
        path.write_text(text)
        with pytest.raises(InputError, match="track"):
            read_track(path)


def check_of(model: CameraModel, expected=("cf1", "cf2", "cf3"), **status):
    frames, _ = sim_frames(model, 4.0)
    check = MocapCheck(expected)
    for frame in frames:
        check.add(frame)
    return check.report(SourceStatus(SourceState.LIVE, **status), 4.0)


def test_a_healthy_arena_is_called_healthy():
    report = check_of(CameraModel(dropout=0.0))
    assert report.healthy, report.problems
    assert report.rate == pytest.approx(120.0, rel=0.01)
    assert report.latency_p50 == pytest.approx(0.0083, abs=5e-4)
    assert report_lines(report)[-1] == "All is well."


@pytest.mark.parametrize(
    ("model", "words"),
    [
        (CameraModel(rate=50.0), "Only 50 frames per second"),
        (CameraModel(rate=500.0), "lower the camera rate"),
        (CameraModel(latency=0.05), "50 ms old"),
        (CameraModel(latency_jitter=0.02), "unevenly"),
        (CameraModel(dropout=0.02, dropout_frames=5), "is missing in"),
        (CameraModel(jump=0.02), "jumped"),
        (CameraModel(name_swap=0.05), "exchanging names"),
        (CameraModel(flip=0.02), "flipped"),
    ],
)
def test_what_is_wrong_is_said_in_plain_words(model, words):
    assert any(words in problem for problem in check_of(model).problems)


def test_missing_bodies_silence_losses_and_frozen_poses_are_told():
    report = check_of(CameraModel(dropout=0.0), expected=["cf1", "cf9"], lost=3, malformed=2)
    assert any("cf9 is not visible" in p and "cf2" in p for p in report.problems)
    assert any("3 frames were lost" in p for p in report.problems)
    assert any("2 payloads" in p for p in report.problems)
    silent = MocapCheck(["cf1"]).report(SourceStatus(error="no route to host"), 2.0)
    assert "no route to host" in silent.problems[0]
    check = MocapCheck(limits=CheckLimits())
    for k in range(200):
        check.add(PoseFrame(k / 100, k / 100 + 0.005, k, {"cf1": Pose(np.ones(3))}))
    report = check.report(SourceStatus(SourceState.LIVE), 2.0)
    assert any("frozen" in p for p in report.problems)


def test_stamps_of_other_hosts_follow_the_fastest_message():
    clock = VirtualClock()
    reader = StampReader(clock, window=100)
    rng = np.random.default_rng(0)
    worst = 0.0
    for k in range(1000):
        captured = k * 0.01
        sent = captured + 0.005
        received = sent + 2e-4 + rng.exponential(1e-3)
        found = reader.capture_time(host_id() ^ 1, captured + 5e5, sent + 5e5, received)
        assert found <= received
        if k > 100:
            worst = max(worst, abs(found - captured))
    assert worst < 5e-4
    near = StampReader(WallClock()).capture_time(host_id(), host_time() - 0.01, host_time(), 9.0)
    assert near == pytest.approx(-0.01, abs=5e-3)


def test_a_queue_nobody_reads_drops_the_oldest_and_says_so():
    queue = FrameQueue(capacity=10)
    for k in range(25):
        queue.put(PoseFrame(0.0, 0.0, k, {}), 1)
    assert queue.status.dropped == 15
    assert [f.frame_id for f in queue.take(0.0)] == list(range(15, 25))
    queue.put(PoseFrame(0.0, 0.0, 28, {}), 1)
    queue.put(PoseFrame(0.0, 0.0, 3, {}), 2)
    assert (queue.status.lost, queue.status.reconnects) == (3, 1)
    queue.close()
    assert len(queue.take(5.0)) == 2
    assert queue.take(5.0) == []


def test_relaying_stops_when_told():
    clock = WallClock()
    seen = []

    class Outlet:
        def publish(self, frame: PoseFrame) -> None:
            seen.append(replace(frame))

        def close(self) -> None: ...

    source = SimSource(clock, Flights(1, seed=1), CameraModel(rate=200.0))
    assert relay(source, [Outlet()], clock, duration=0.3) == len(seen) > 10
    stop = threading.Event()
    stop.set()
    assert relay(source, [Outlet()], clock, stop=stop) == 0
