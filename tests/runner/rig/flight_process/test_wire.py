"""Messages between runner and flight process come back as they were."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyarena.crazyswarm_compat import commands as cs
from crazyarena.errors import BackendError, CommandError, DependencyMissing, InputError
from crazyarena.mocap.source import SourceState, SourceStatus
from crazyarena.runner.rig.flight_process import wire
from crazyarena.safety.gate import Refused
from crazyarena.types import Pose, PoseFrame, Telemetry, VehicleState

numbers = st.floats(width=64)
names = st.text(min_size=1, max_size=20)
triples = st.lists(numbers, min_size=3, max_size=3).map(np.array)
poses = st.builds(Pose, triples, st.lists(numbers, min_size=4, max_size=4).map(np.array))
frames = st.builds(
    PoseFrame,
    numbers,
    numbers,
    st.integers(-(2**63), 2**63 - 1),
    st.dictionaries(names, poses, max_size=6),
    st.lists(triples, max_size=5).map(lambda rows: np.array(rows).reshape(-1, 3)),
)


def same(a, b):
    return np.array_equal(np.asarray(a), np.asarray(b), equal_nan=True)


@given(frames)
def test_frames(frame):
    back = wire.decode(wire.encode(frame))
    assert same(
        [back.timestamp, back.received, back.frame_id],
        [frame.timestamp, frame.received, frame.frame_id],
    )
    assert back.frame_id == frame.frame_id
    assert list(back.bodies) == list(frame.bodies)
    for name, pose in frame.bodies.items():
        assert same(back.bodies[name].position, pose.position)
        assert same(back.bodies[name].quaternion, pose.quaternion)
    assert back.markers.shape == frame.markers.shape
    assert same(back.markers, frame.markers)


@given(
    st.integers(0, 2**40),
    st.builds(cs.FullState, triples, triples, triples, numbers, triples),
    st.one_of(st.none(), st.integers(0, 255)),
)
def test_calls(number, command, vehicle):
    back = wire.decode(wire.encode(wire.Call(number, "send", (command, vehicle))))
    assert (back.number, back.name, back.arguments[1]) == (number, "send", vehicle)
    for field in ("position", "velocity", "acceleration", "yaw", "omega"):
        assert same(getattr(back.arguments[0], field), getattr(command, field))


@given(
    st.one_of(st.none(), numbers),
    st.one_of(st.none(), st.integers(0, 2**16)),
    st.one_of(st.none(), triples),
    st.sampled_from(SourceState),
    st.one_of(st.none(), st.text()),
)
def test_status(battery, supervisor, position, state, verdict):
    own = None
    if position is not None:
        own = VehicleState(0.0, position, position, np.zeros(4), position)
    told = wire.Status(
        Telemetry(1.5, battery, supervisor=supervisor, state=own),
        SourceStatus(state, frames=3, error=verdict),
        verdict,
        True,
        "shell",
    )
    back = wire.decode(wire.encode(told))
    assert (back.verdict, back.over, back.stopped, back.held) == (verdict, True, "shell", -math.inf)
    assert back.source == told.source
    assert back.telemetry.supervisor == supervisor
    assert (back.telemetry.state is None) == (own is None)
    if own is not None:
        assert same(back.telemetry.state.position, position)


@pytest.mark.parametrize(
    "error",
    [
        Refused("cf1: FullState: the watchdog has taken over"),
        CommandError("cf1: position: found nan"),
        BackendError("no parameter"),
        InputError(""),
        DependencyMissing("eclipse-zenoh", "mocap", "motion capture over zenoh"),
    ],
)
def test_our_errors_keep_type_and_text(error):
    reply = wire.decode(wire.encode(wire.Reply(3, None, wire.failure(error))))
    back = wire.revive(reply.failure)
    assert type(back) is type(error)
    assert str(back) == str(error)


def test_other_errors_say_where_they_are_from():
    back = wire.revive(wire.failure(ZeroDivisionError("oh")))
    assert type(back) is RuntimeError
    assert "ZeroDivisionError: oh" in str(back)
