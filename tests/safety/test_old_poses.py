"""A vehicle takes whatever it is given for the present, so old poses are not given."""

from __future__ import annotations

import numpy as np
import pytest

from crazyarena.clock import VirtualClock
from crazyarena.errors import InputError
from crazyarena.mocap.forwarder import PoseForwarder
from crazyarena.safety.frame_rate import FrameRate
from crazyarena.safety.old_poses import repeats
from crazyarena.types import Pose


def test_poses_that_took_too_long_are_dropped():
    sent = []
    forwarder = PoseForwarder({"cf1": 1}, sent.append, VirtualClock(), rate=1000.0, max_age=0.1)
    for captured, received in ((1.0, 1.01), (1.1, 1.21), (1.2, 1.29)):
        forwarder.submit(captured, {"cf1": Pose(np.array([captured, 0.0, 0.0]))}, received)
        forwarder.flush()
    assert [poses[1].position[0] for poses in sent] == [1.0, 1.2]
    assert forwarder.too_old == 1


def test_a_limit_of_nothing_is_refused():
    with pytest.raises(InputError, match="max_age"):
        PoseForwarder({}, print, VirtualClock(), max_age=0.0)


def pose(*place, turn=0.0):
    return Pose(np.array(place), np.array([0.0, 0.0, turn, 1.0]))


def test_a_frozen_pose_with_a_jitter_of_micrometres_is_an_old_one_in_flight():
    last = pose(1.0, 2.0, 1.0)
    for jitter in (0.0, 1e-9, 5e-6, 1.5e-5):
        assert repeats(last, pose(1.0 + jitter, 2.0 - jitter, 1.0, turn=jitter), flying=True)
    # On the ground nothing has to move.
    assert not repeats(last, pose(1.0 + 1e-9, 2.0, 1.0), flying=False)
    assert repeats(last, pose(1.0, 2.0, 1.0), flying=False)


def test_what_moves_or_turns_is_new():
    last = pose(1.0, 2.0, 1.0)
    assert not repeats(last, pose(1.0, 2.0, 1.0001), flying=True)
    assert not repeats(last, pose(1.0, 2.0, 1.0, turn=1e-3), flying=True)
    without = Pose(last.position, np.full(4, np.nan))
    assert repeats(without, Pose(last.position.copy(), np.full(4, np.nan)), flying=True)
    assert not repeats(without, Pose(last.position + 1e-3, np.full(4, np.nan)), flying=True)


@pytest.mark.parametrize("hz", [10.0, 30.0, 120.0])
def test_frames_are_counted_by_their_capture(hz):
    counted = FrameRate()
    assert counted.rate is None
    for k in range(int(2 * hz)):
        counted.note(k / hz)
        counted.note(k / hz)  # twice is once
    assert counted.rate == pytest.approx(hz)


def test_a_clock_that_was_set_back_begins_anew():
    counted = FrameRate()
    for k in range(100):
        counted.note(100.0 + k / 100)
    for k in range(100):
        counted.note(k / 50)
    assert counted.rate == pytest.approx(50.0)
