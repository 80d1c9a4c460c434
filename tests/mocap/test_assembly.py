"""What belongs to one instant becomes one frame, and nobody waits longer than stated."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyarena.clock import VirtualClock
from crazyarena.errors import InputError
from crazyarena.mocap.assembly import DEFAULT_WAIT, SAME, Assembler, take_assembled
from crazyarena.mocap.check import MocapCheck
from crazyarena.mocap.estimator import Freshness, PoseEstimator
from crazyarena.mocap.source import FrameQueue, SourceState, SourceStatus
from crazyarena.mocap.survey import SurveyConfig, survey
from crazyarena.types import Pose, PoseFrame

STAMPS = [SAME, None]


def piece(number: int, time: float, names, received: float | None = None) -> PoseFrame:
    bodies = {name: Pose(np.array([time, 0.0, 1.0])) for name in names}
    return PoseFrame(time, time if received is None else received, number, bodies)


def assemble(assembler: Assembler, pieces: list[PoseFrame]) -> list[PoseFrame]:
    frames = []
    for one in pieces:
        if assembler.due <= one.received:
            frames += assembler.flush(assembler.due)
        frames += assembler.add(one)
    return frames + assembler.flush(1e9)


def singly(count: int, names, gap: float = 1e-4, skip=()) -> list[PoseFrame]:
    """Bodies at 100 Hz, one message each, ``gap`` s apart on the wire."""
    numbers = itertools.count()
    return [
        piece(next(numbers), 0.01 * k, [name], 0.01 * k + gap * (i + 1))
        for k in range(count)
        for i, name in enumerate(names)
        if (k, name) not in skip
    ]


def unstamped(pieces: list[PoseFrame]) -> list[PoseFrame]:
    return [PoseFrame(p.received, p.received, p.frame_id, p.bodies) for p in pieces]


@pytest.mark.parametrize("same", STAMPS)
def test_nine_bodies_of_an_instant_are_one_frame_at_the_last_arrival(same):
    names = [f"cf{i}" for i in range(9)]
    pieces = singly(50, names)
    frames = assemble(Assembler(same=same), pieces if same else unstamped(pieces))
    assert [set(f.bodies) for f in frames] == [set(names)] * 50
    assert [f.frame_id for f in frames] == list(range(50))
    for k, frame in enumerate(frames):
        assert frame.timestamp == pytest.approx(0.01 * k, abs=1e-9 if same else 2e-4)
        if k > 2:
            assert frame.received == pytest.approx(0.01 * k + 9e-4)


@pytest.mark.parametrize("same", STAMPS)
def test_a_hidden_body_holds_the_others_up_for_a_bounded_time_and_not_for_ever(same):
    gone = {(k, "b") for k in range(20, 40)}
    pieces = singly(60, "abc", skip=gone)
    frames = assemble(Assembler(same=same), pieces if same else unstamped(pieces))
    assert len(frames) == 60
    late = [f.received - 0.01 * k for k, f in enumerate(frames)]
    assert max(late[20:40]) <= DEFAULT_WAIT + 2e-4
    assert sum(value > 5e-4 for value in late[20:40]) <= 3
    assert all("b" not in f.bodies for f in frames[20:40])
    assert all("b" in f.bodies for f in frames[41:])


def test_trackers_out_of_step_keep_frames_and_stamps_of_their_own():
    pieces = sorted(
        [piece(0, 0.01 * k, "a") for k in range(100)]
        + [piece(0, 0.01 * k + 0.005, "b") for k in range(100)],
        key=lambda p: p.received,
    )
    pieces = [PoseFrame(p.timestamp, p.received, i, p.bodies) for i, p in enumerate(pieces)]
    frames = assemble(Assembler(same=SAME), pieces)
    assert [f.timestamp for f in frames] == [p.timestamp for p in pieces]


def test_a_slower_tracker_is_not_awaited_between_its_poses_and_misses_nothing():
    names = {k: "ab" if k % 2 == 0 else "a" for k in range(200)}
    numbers = itertools.count()
    pieces = [
        piece(next(numbers), 0.01 * k, [name], 0.01 * k + 1e-4 * (i + 1))
        for k, due in names.items()
        for i, name in enumerate(due)
    ]
    frames = assemble(Assembler(same=SAME), pieces)
    assert len(frames) == 200
    assert all(f.received - f.timestamp < 3e-4 for f in frames[6:])
    check = MocapCheck("ab")
    for frame in frames:
        check.add(frame)
    report = check.report(SourceStatus(SourceState.LIVE), 2.0)
    assert [report.bodies[n].missing for n in "ab"] == [0, 0]
    assert report.bodies["b"].rate == pytest.approx(50.0)
    (problem,) = report.problems
    assert "b comes only 50 times per second, others 100" in problem


def test_frames_that_come_whole_pass_untouched_until_pieces_are_seen():
    assembler = Assembler(same=SAME, learn=True)
    whole = [piece(k, 0.01 * k, "ab") for k in range(10)]
    hidden = [piece(10 + k, 0.1 + 0.01 * k, "a" if k % 3 else "ab") for k in range(10)]
    for one in whole + hidden:
        (out,) = assembler.add(one)
        assert out is one
    assert not assembler.singly
    later = [
        piece(20 + 2 * k + i, 0.2 + 0.01 * k, [n]) for k in range(10) for i, n in enumerate("ab")
    ]
    frames = [f for one in later for f in assembler.add(one)]
    assert assembler.singly
    assert all(set(f.bodies) == {"a", "b"} for f in frames[3:])
    ids = [f.frame_id for f in frames]
    assert ids == sorted(set(ids))


def test_lost_pieces_leave_a_gap_in_the_ids_and_empty_ones_do_not():
    assembler = Assembler(same=SAME)
    first = assemble(assembler, singly(5, "ab"))
    assert assembler.add(PoseFrame(0.06, 0.06, 10, {})) == []
    lost = assemble(assembler, [piece(15, 0.07, "a"), piece(16, 0.07, "b")])
    assert lost[0].frame_id - first[-1].frame_id == 1 + 4


@pytest.mark.parametrize("wait", [0.0, -1.0, 0.2, float("nan")])
def test_a_wait_that_cannot_be_is_refused(wait):
    with pytest.raises(InputError, match="assemble"):
        Assembler(wait)


@given(
    st.lists(
        st.tuples(st.floats(0.0, 0.02), st.sampled_from("abcd"), st.floats(0.0, 0.01)), max_size=60
    ),
    st.sampled_from(STAMPS),
)
def test_every_pose_comes_out_once_in_order_and_never_later_than_the_wait(steps, same):
    assembler = Assembler(same=same)
    time, pieces = 0.0, []
    for number, (step, name, delay) in enumerate(steps):
        time += step
        pieces.append(piece(number, time, [name], time + delay))
    pieces.sort(key=lambda p: p.received)
    pieces = [PoseFrame(p.timestamp, p.received, i, p.bodies) for i, p in enumerate(pieces)]
    frames = assemble(assembler, pieces)
    given_ = [(n, p.bodies[n].position[0]) for p in pieces for n in p.bodies]
    got = [(n, pose.position[0]) for f in frames for n, pose in f.bodies.items()]
    assert sorted(given_) == sorted(got)
    for name in "abcd":
        assert [v for n, v in given_ if n == name] == [v for n, v in got if n == name]
    assert [f.frame_id for f in frames] == list(range(len(frames)))


def test_what_waits_comes_out_without_a_next_piece():
    clock = VirtualClock()
    queue = FrameQueue()
    assembler = Assembler(same=SAME)
    queue.put(piece(0, 0.0, "a"), 1)
    assert take_assembled(queue, assembler, clock, 0.0) == []
    clock.sleep_until(0.01)
    (frame,) = take_assembled(queue, assembler, clock, 0.0)
    assert frame.received == 0.01
    queue.close()
    assert take_assembled(queue, assembler, clock, 5.0) == []


def test_estimator_check_and_survey_work_on_pieces_as_on_whole_frames():
    names = [f"gate{i}" for i in range(1, 9)]
    rng = np.random.default_rng(1)
    nominal = {name: Pose(np.array([float(i), 0.0, 0.0])) for i, name in enumerate(names)}
    pieces = []
    for k in range(250):
        for i, name in enumerate(names):
            pose = Pose(nominal[name].position + rng.normal(0, 3e-4, 3))
            pieces.append(PoseFrame(0.01 * k, 0.01 * k + 2e-4 * i, len(pieces), {name: pose}))
    frames = assemble(Assembler(same=SAME), pieces)
    report = survey(iter(frames), nominal, SurveyConfig(frames=200))
    assert report.accepted, report.problems
    assert [body.seen for body in report.bodies] == [200] * 8
    check = MocapCheck(names)
    estimator = PoseEstimator(names)
    for frame in frames:
        check.add(frame)
        estimator.update(frame)
    assert check.report(SourceStatus(SourceState.LIVE), 2.5).healthy
    now = frames[-1].received
    estimates = estimator.estimates(now)
    assert all(e.freshness is Freshness.FRESH and e.age < 0.01 for e in estimates.values())


def test_a_survey_takes_a_slower_tracker_and_refuses_one_that_is_seen_by_chance():
    rng = np.random.default_rng(0)
    nominal = {name: Pose(np.zeros(3)) for name in ("quick", "slow", "chance")}

    def frames():
        for k in range(200):
            names = {"quick"} | ({"slow"} if k % 2 == 0 else set())
            names |= {"chance"} if rng.random() < 0.5 else set()
            yield PoseFrame(0.01 * k, 0.01 * k, k, {n: Pose(rng.normal(0, 1e-4, 3)) for n in names})

    report = survey(frames(), nominal, SurveyConfig(frames=200))
    problems = {body.name: body.problem for body in report.bodies}
    assert problems["quick"] is problems["slow"] is None
    assert "seen well" in (problems["chance"] or "")


def test_a_body_that_spins_in_place_is_not_frozen():
    spinning, still = MocapCheck(["cf1"]), MocapCheck(["cf1"])
    for k in range(200):
        turn = np.array([0.0, 0.0, np.sin(0.05 * k), np.cos(0.05 * k)])
        for check, q in ((spinning, turn), (still, turn * 0 + [0, 0, 0, 1.0])):
            check.add(PoseFrame(k / 100, k / 100, k, {"cf1": Pose(np.ones(3), q)}))
    status = SourceStatus(SourceState.LIVE)
    assert not any("frozen" in p for p in spinning.report(status, 2.0).problems)
    assert any("frozen" in p for p in still.report(status, 2.0).problems)
