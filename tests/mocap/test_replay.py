from __future__ import annotations

import hashlib
import threading
import time as stopwatch

import numpy as np
import pytest

from crazyarena.clock import VirtualClock, WallClock
from crazyarena.errors import InputError
from crazyarena.mocap.camera_model import CameraModel
from crazyarena.mocap.estimator import PoseEstimator
from crazyarena.mocap.poselog import CSV_COLUMNS, PoseLogWriter, read_pose_log
from crazyarena.mocap.replay import ReplaySource
from crazyarena.mocap.sim_source import SimSource
from crazyarena.mocap.source import PoseSource, SourceState
from crazyarena.types import PoseFrame
from tests.mocap.flights import Flights

TROUBLE = CameraModel(rate=100.0, jump=0.002, flip=0.002, name_swap=0.002, dropout=0.002)


def record(path, seconds: float, bodies: int = 4, model: CameraModel = TROUBLE) -> None:
    flights = Flights(bodies, seed=1, spacing=2.0)
    clock = VirtualClock()
    source = SimSource(clock, flights, model, seed=2)
    with PoseLogWriter(path) as log:
        for k in range(round(seconds * 20)):
            clock.sleep_until((k + 1) / 20)
            for frame in source.frames():
                log.write(frame)


def digest_of(source: PoseSource, bodies: int = 4) -> tuple[str, int]:
    """Digest of every estimate, event and accepted pose while the source lasts."""
    estimator = PoseEstimator([f"cf{i + 1}" for i in range(bodies)])
    digest = hashlib.sha256()
    count = 0
    while source.status.state is SourceState.LIVE:
        for frame in source.frames(0.1):
            count += 1
            result = estimator.update(frame)
            digest.update(repr([(e.time, e.kind, e.body) for e in result.events]).encode())
            digest.update(repr(sorted(result.accepted)).encode())
            if count % 5:
                continue
            for estimate in estimator.estimates(frame.received).values():
                state = estimate.state
                for values in (
                    state.position, state.velocity, state.quaternion, state.angular_velocity,
                ):  # fmt: skip
                    digest.update(values.tobytes())
                digest.update(estimate.freshness.encode())
    return digest.hexdigest(), count


def same(a: PoseFrame, b: PoseFrame) -> bool:
    return (
        (a.timestamp, a.received, a.frame_id) == (b.timestamp, b.received, b.frame_id)
        and list(a.bodies) == list(b.bodies)
        and all(
            p.position.tobytes() == b.bodies[n].position.tobytes()
            and p.quaternion.tobytes() == b.bodies[n].quaternion.tobytes()
            for n, p in a.bodies.items()
        )
        and a.markers.tobytes() == b.markers.tobytes()
    )


@pytest.mark.parametrize("suffix", ["mcap", "csv"])
@pytest.mark.parametrize("output", ["bodies", "markers", "both"])
def test_logs_give_back_every_bit(tmp_path, suffix, output):
    flights = Flights(3, seed=4)
    clock = VirtualClock()
    source = SimSource(clock, flights, CameraModel(output=output, dropout=0.2), seed=5)
    clock.sleep_until(0.5)
    frames = [*source.frames(), PoseFrame(0.6, 0.61, 99, {})]
    with PoseLogWriter(tmp_path / f"log.{suffix}") as log:
        for frame in frames:
            log.write(frame)
    again = list(read_pose_log(tmp_path / f"log.{suffix}"))
    assert len(again) == len(frames) > 30
    assert all(same(a, b) for a, b in zip(frames, again, strict=True))


def check_determinism(tmp_path, seconds: float) -> None:
    record(tmp_path / "run.mcap", seconds)
    live = ReplaySource(VirtualClock(), tmp_path / "run.mcap", speed=float("inf"))
    first, count = digest_of(live)
    with PoseLogWriter(tmp_path / "copy.csv") as log:
        for frame in read_pose_log(tmp_path / "run.mcap"):
            log.write(frame)
    for path in ("run.mcap", "copy.csv"):
        again = ReplaySource(VirtualClock(), tmp_path / path, speed=float("inf"))
        assert digest_of(again) == (first, count)
    print(f"{count} frames of {seconds:g} s: sha256 {first[:16]}, twice from mcap and from csv")
    assert count > 99 * seconds


def test_a_replay_reproduces_the_same_estimates(tmp_path):
    check_determinism(tmp_path, 20.0)


@pytest.mark.slow
def test_ten_minutes_replayed_reproduce_the_same_estimates(tmp_path):
    check_determinism(tmp_path, 600.0)


def test_real_time_replay_gives_the_same_estimates_as_a_fast_one(tmp_path):
    record(tmp_path / "run.mcap", 1.0)
    fast = digest_of(ReplaySource(VirtualClock(), tmp_path / "run.mcap", speed=float("inf")))
    before = stopwatch.monotonic()
    slow = digest_of(ReplaySource(WallClock(), tmp_path / "run.mcap", speed=2.0))
    assert stopwatch.monotonic() - before > 0.45
    assert slow == fast


def test_rebased_frames_stand_on_the_session_clock(tmp_path):
    record(tmp_path / "run.csv", 1.0)
    clock = VirtualClock()
    clock.sleep_until(50.0)
    source = ReplaySource(clock, tmp_path / "run.csv", rebase=True)
    frames = source.frames()
    clock.sleep_until(50.5)
    frames += source.frames()
    assert frames[0].received == 50.0
    assert 45 < len(frames) < 56
    assert all(50.0 <= f.received <= 50.5 and f.timestamp < f.received for f in frames)


def test_closing_wakes_a_replay_that_waits(tmp_path):
    flights = Flights(1, seed=1)
    with PoseLogWriter(tmp_path / "gap.mcap") as log:
        for k, at in enumerate((0.0, 100.0)):
            log.write(PoseFrame(at, at, k, dict(flights(at))))
    source = ReplaySource(WallClock(), tmp_path / "gap.mcap")
    assert len(source.frames()) == 1
    threading.Timer(0.1, source.close).start()
    before = stopwatch.monotonic()
    assert source.frames(60.0) == []
    assert stopwatch.monotonic() - before < 1.0
    assert source.status.state is SourceState.CLOSED


def test_a_log_cut_by_a_crash_is_readable_up_to_the_cut(tmp_path):
    record(tmp_path / "run.mcap", 30.0, model=CameraModel(rate=100.0))
    whole = (tmp_path / "run.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[: len(whole) * 2 // 3])
    source = ReplaySource(VirtualClock(), tmp_path / "cut.mcap", speed=float("inf"))
    frames = []
    while source.status.state is SourceState.LIVE:
        frames += source.frames()
    assert len(frames) > 1000
    assert [f.frame_id for f in frames] == list(range(len(frames)))
    assert "cut.mcap" in (source.status.error or "")


@pytest.mark.parametrize(
    ("name", "text", "match"),
    [
        ("a.csv", "time,x\n1,2\n", "line 1"),
        ("b.csv", ",".join(CSV_COLUMNS) + "\n1,1,0,cf1,0,0,zero,0,0,0,1\n", "line 2.*zero"),
        ("c.csv", ",".join(CSV_COLUMNS) + "\n1,1,0,cf1\n", "line 2: 4 columns"),
        ("d.mcap", "nonsense", "not a readable pose log"),
        ("e.txt", "", ".mcap or .csv"),
    ],
)
def test_damaged_logs_are_input_errors(tmp_path, name, text, match):
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=match):
        list(read_pose_log(tmp_path / name))
    with pytest.raises(InputError, match="no such"):
        list(read_pose_log(tmp_path / "missing.csv"))


def test_numbers_in_logs_are_whole(tmp_path):
    record(tmp_path / "run.csv", 0.5)
    frames = list(read_pose_log(tmp_path / "run.csv"))
    assert all(np.isfinite(p.position).all() for f in frames for p in f.bodies.values())
    with pytest.raises(InputError, match="speed"):
        ReplaySource(VirtualClock(), tmp_path / "run.csv", speed=0.0)
