"""Poses of ROS 2 over rmw_zenoh, against payloads that an independent CDR library built."""

from __future__ import annotations

import struct
from contextlib import closing

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.mocap_latency import free_port
from crazyarena.clock import WallClock
from crazyarena.errors import InputError
from crazyarena.mocap import ros2_wire
from crazyarena.mocap.opening import open_source
from crazyarena.mocap.source import SourceState
from crazyarena.mocap.wire import PayloadError
from crazyarena.mocap.zenoh_session import open_session
from crazyarena.types import Pose
from tests.waiting import eventually

rosbags = pytest.importorskip("rosbags.typesys")
PACKAGE = "motion_capture_tracking_interfaces/msg"
HASH = "RIHS01_d4c89ff7e0670d5f83b0322513e1c8dc2c3b279a68495daa026c352f0027e5f2"
KEY = f"0/poses/motion_capture_tracking_interfaces::msg::dds_::NamedPoseArray_/{HASH}"


def store():
    types = rosbags.get_typestore(rosbags.Stores.ROS2_JAZZY)
    for name, text in (
        ("NamedPose", "string name\ngeometry_msgs/Pose pose"),
        ("LatencyInfo", "string source\nuint32 latency"),
        ("NamedPoseArray", f"std_msgs/Header header\n{PACKAGE[:-4]}/NamedPose[] poses"),
        (
            "NamedPoseArrayV2",
            f"std_msgs/Header header\nuint64 timestamp\n{PACKAGE[:-4]}/LatencyInfo[] latencies\n"
            f"{PACKAGE[:-4]}/NamedPose[] poses",
        ),
    ):
        types.register(rosbags.get_types_from_msg(text, f"{PACKAGE}/{name}"))
    return types


TYPES = store()


def message(
    bodies: dict[str, Pose], stamp: float = 0.0, frame: str = "world", kind: str = "NamedPoseArray",
    little: bool = True, latencies: int = 0,
) -> bytes:  # fmt: skip
    t = TYPES.types
    poses = [
        t[f"{PACKAGE}/NamedPose"](
            name=name,
            pose=t["geometry_msgs/msg/Pose"](
                position=t["geometry_msgs/msg/Point"](*pose.position.tolist()),
                orientation=t["geometry_msgs/msg/Quaternion"](*pose.quaternion.tolist()),
            ),
        )
        for name, pose in bodies.items()
    ]
    whole = int(stamp // 1)
    time = t["builtin_interfaces/msg/Time"](sec=whole, nanosec=round((stamp - whole) * 1e9))
    header = t["std_msgs/msg/Header"](stamp=time, frame_id=frame)
    more = {}
    if kind == "NamedPoseArrayV2":
        info = t[f"{PACKAGE}/LatencyInfo"]
        more = {
            "timestamp": 17,
            "latencies": [info(source=f"l{i}", latency=i) for i in range(latencies)],
        }
    built = t[f"{PACKAGE}/{kind}"](header=header, poses=poses, **more)
    return bytes(TYPES.serialize_cdr(built, f"{PACKAGE}/{kind}", little_endian=little))


def attachment(number: int, sent: float, gid: int = 7) -> bytes:
    return struct.pack("<qqB", number, round(sent * 1e9), 16) + bytes([gid] * 16)


numbers = st.floats(-50, 50)
poses = st.tuples(numbers, numbers, numbers, st.floats(-1, 1), st.floats(-1, 1), st.floats(0.6, 1))


def pose_of(values) -> Pose:
    q = np.array([values[3], values[4], 0.1, values[5]])
    return Pose(np.array(values[:3]), q / np.linalg.norm(q))


@given(
    st.dictionaries(st.text("abcdefgä1_", min_size=1, max_size=9), poses, max_size=9),
    st.integers(0, 2**31 - 2),
    st.text("/world", max_size=9),
    st.booleans(),
    st.sampled_from(ros2_wire.TYPES),
    st.integers(0, 3),
)
def test_what_an_independent_library_writes_is_read(given_, stamp, frame, little, kind, latencies):
    bodies = {name: pose_of(values) for name, values in given_.items()}
    data = message(bodies, stamp + 0.25, frame, kind, little, latencies)
    found = ros2_wire.decode(data, kind)
    assert found.stamp == pytest.approx(stamp + 0.25, abs=1e-6)
    assert list(found.bodies) == list(bodies)
    for name, pose in found.bodies.items():
        np.testing.assert_array_equal(pose.position, bodies[name].position)
        np.testing.assert_allclose(pose.quaternion, bodies[name].quaternion, atol=1e-15)


def test_unseen_bodies_are_left_out():
    nan = Pose(np.full(3, np.nan))
    blank = Pose(np.zeros(3), np.zeros(4))
    found = ros2_wire.decode(message({"a": nan, "b": blank, "c": Pose(np.ones(3))}))
    assert list(found.bodies) == ["c"]


@given(st.binary(max_size=200))
def test_anything_is_a_message_or_an_error(data):
    for kind in ros2_wire.TYPES:
        try:
            ros2_wire.decode(data, kind)
        except PayloadError:
            continue
    ros2_wire.sending(data)


@given(st.data())
def test_a_cut_or_spoilt_message_is_a_message_or_an_error(data):
    good = message({"cf1": Pose(np.ones(3)), "cf2": Pose(np.zeros(3))})
    at = data.draw(st.integers(0, len(good) - 1))
    with pytest.raises(PayloadError):
        ros2_wire.decode(good[:at])
    spoilt = good[:at] + bytes([data.draw(st.integers(0, 255))]) + good[at + 1 :]
    try:
        found = ros2_wire.decode(spoilt)
    except PayloadError:
        return
    for pose in found.bodies.values():
        assert np.isfinite(pose.position).all()


def test_a_name_twice_and_a_count_that_lies_are_errors():
    one = message({"cf1": Pose(np.ones(3))})
    two = bytearray(message({"cf1": Pose(np.ones(3)), "cf2": Pose(np.ones(3))}))
    two[two.index(b"cf2") + 2] = ord("1")
    with pytest.raises(PayloadError, match="twice"):
        ros2_wire.decode(bytes(two))
    at = one.index(struct.pack("<I", 4) + b"cf1") - 4
    with pytest.raises(PayloadError, match="4294967295 poses"):
        ros2_wire.decode(one[:at] + b"\xff\xff\xff\xff" + one[at + 4 :])


def test_attachments_of_early_and_late_releases_are_read():
    late = attachment(5, 2.5)
    bare = late[:16] + late[17:]
    named = b"".join(
        bytes([len(name)]) + name.encode() + value
        for name, value in (
            ("sequence_number", late[:8]), ("source_timestamp", late[8:16]),
            ("source_gid", late[16:]),
        )
    )  # fmt: skip
    found = [ros2_wire.sending(data) for data in (late, bare, named)]
    assert found[0] is not None
    assert (found[0].number, found[0].sent) == (5, 2.5)
    assert found[1] == found[2] == found[0]
    assert ros2_wire.sending(None) is None
    assert ros2_wire.sending(b"x") is None
    assert ros2_wire.sending(attachment(-1, 0.0)) is None


class Ros:
    """The other side: publishes as rmw_zenoh does."""

    def __init__(self) -> None:
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        self.session = open_session(listen=[self.endpoint])
        self.count = 0

    def send(self, bodies, key: str = KEY, gid: int = 7, step: int = 1, **kwargs) -> None:
        self.count += step
        stamp = 1.8e9 + 0.01 * self.count
        self.session.put(
            key,
            message(bodies, stamp, **kwargs),
            attachment=attachment(self.count, stamp + 0.001, gid),
        )

    def close(self) -> None:
        self.session.close()


@pytest.mark.parametrize("kind", ros2_wire.TYPES)
def test_frames_come_through_with_losses_and_strangers_told(kind):
    key = KEY.replace("NamedPoseArray_", f"{kind}_")
    here = {"cf1": Pose(np.array([1.0, 2.0, 3.0])), "cf2": Pose(np.zeros(3))}
    with closing(Ros()) as ros:
        source = open_source(
            "ros2", clock=WallClock(), topic="/poses", connect=[ros.endpoint], release_after=60.0
        )
        frames = []

        def came() -> bool:
            ros.send(here, key, kind=kind)
            frames.extend(source.frames(0.02))
            return bool(frames)

        eventually(came)
        assert set(frames[-1].bodies) == {"cf1", "cf2"}
        np.testing.assert_array_equal(frames[-1].bodies["cf1"].position, [1.0, 2.0, 3.0])
        assert frames[-1].timestamp <= frames[-1].received
        eventually(lambda: not source.frames(0.05))
        ros.send(here, key, step=5, kind=kind)
        eventually(lambda: source.status.lost == 4)
        ros.send(here, key, gid=9, kind=kind)
        eventually(lambda: source.status.foreign == 1)
        ros.session.put(key, b"\0\1\0\0rubbish")
        eventually(lambda: source.status.malformed == 1)
        assert source.status.state is SourceState.LIVE
        # Another topic or domain is none of ours.
        ros.send({"x": here["cf1"]}, key.replace("/poses", "/other"), kind=kind)
        ros.send({"x": here["cf1"]}, "1" + key[1:], kind=kind)
        ros.send(here, key, kind=kind)
        seen = []
        eventually(lambda: seen.extend(source.frames(0.05)) or len(seen) >= 2)
        assert not any("x" in frame.bodies for frame in seen)
        source.close()
        source.close()
        assert source.frames(1.0) == []


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"topic": ""}, "topic"),
        ({"topic": "po*ses"}, "topic"),
        ({"domain": "x"}, "domain"),
        ({"domain": 500}, "domain"),
        ({"connect": ["nonsense"]}, "endpoints"),
        ({"axes": "x-up"}, "axes"),
        ({"config": "missing.json5"}, "missing.json5"),
        ({"release_after": 0.0}, "release_after"),
    ],
)
def test_wrong_options_are_named(options, word):
    with pytest.raises(InputError, match=word):
        open_source("ros2", clock=WallClock(), **options)


def test_the_domain_is_the_environments(monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", "seven")
    with pytest.raises(InputError, match="ROS_DOMAIN_ID"):
        open_source("ros2", clock=WallClock())
