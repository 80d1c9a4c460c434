"""A vehicle takes whatever it is given for the present, so old poses are not given."""

from __future__ import annotations

import numpy as np
import pytest

from crazyarena.clock import VirtualClock
from crazyarena.errors import InputError
from crazyarena.mocap.forwarder import PoseForwarder
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
