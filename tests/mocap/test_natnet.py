"""NatNet: our server against two clients that we have not written."""

from __future__ import annotations

import socket
import struct
import threading
from contextlib import closing

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyarena.clock import WallClock
from crazyarena.errors import InputError
from crazyarena.mocap import natnet_wire as wire
from crazyarena.mocap.frames import (
    Convention,
    points_from_y_up,
    points_to_y_up,
    pose_from_y_up,
    pose_to_y_up,
)
from crazyarena.mocap.natnet_server import NatNetServer
from crazyarena.mocap.opening import open_source
from crazyarena.mocap.rotations import angle_between, rotate
from crazyarena.mocap.source import PoseSource, SourceState
from crazyarena.types import Pose, PoseFrame
from tests.waiting import eventually

natnet = pytest.importorskip("natnet")

# The package's client cannot read the models of 4.2.
VERSIONS = ["3.1", "4.0", "4.1"]


def some_bodies(count: int = 5) -> dict[str, Pose]:
    rng = np.random.default_rng(7)
    bodies = {}
    for i in range(count):
        q = rng.normal(size=4)
        bodies[f"cf{i}"] = Pose(rng.uniform(-3, 3, 3), q / np.linalg.norm(q))
    return bodies


def opened(server: NatNetServer, **options) -> PoseSource:
    return open_source(
        "optitrack", clock=WallClock(), hostname="127.0.0.1", port_command=server.port,
        interface_ip="127.0.0.1", stall_after=0.5, retry_after=0.05, **options,
    )  # fmt: skip


class Feeder(threading.Thread):
    def __init__(self, server: NatNetServer, bodies, markers=None) -> None:
        super().__init__(daemon=True)
        self.server, self.bodies = server, bodies
        self.markers = np.empty((0, 3)) if markers is None else markers
        self.done = threading.Event()
        self.count = 0
        self.start()

    def run(self) -> None:
        while not self.done.wait(0.01):
            time = 0.01 * self.count
            self.server.publish(PoseFrame(time, time, self.count, self.bodies, self.markers))
            self.count += 1

    def close(self) -> None:
        self.done.set()
        self.join(2.0)


def first_frame(source: PoseSource, names) -> PoseFrame:
    frames: list[PoseFrame] = []

    def arrived() -> bool:
        frames.extend(source.frames(0.05))
        return bool(frames) and set(frames[-1].bodies) == set(names)

    eventually(arrived, 20.0)
    return frames[-1]


@pytest.mark.parametrize("multicast", [True, False])
@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("y_up", [False, True])
def test_poses_survive_the_wire_and_hidden_bodies_are_absent(version, multicast, y_up):
    bodies = some_bodies()
    server = NatNetServer([*bodies, "hidden"], 0, version=version, multicast=multicast, y_up=y_up)
    with server, closing(Feeder(server, bodies, np.ones((3, 3)))):
        source = opened(server, axes="y-up" if y_up else "z-up")
        frame = first_frame(source, bodies)
        source.close()
    for name, pose in frame.bodies.items():
        np.testing.assert_allclose(pose.position, bodies[name].position, atol=2e-6)
        assert angle_between(pose.quaternion, bodies[name].quaternion) < 1e-3


@pytest.mark.parametrize("multicast", [True, False])
def test_a_server_that_is_restarted_is_found_again(multicast):
    bodies = some_bodies(2)

    def server(port: int, data_port: int) -> NatNetServer:
        return NatNetServer(list(bodies), port, multicast=multicast, data_port=data_port)

    with server(0, 0) as first:
        ports = first.port, first.data_port
        feeder = Feeder(first, bodies)
        source = opened(first)
        first_frame(source, bodies)
        feeder.close()
    eventually(lambda: source.status.state is SourceState.LOST, 10.0)
    source.frames()
    with server(*ports) as second, closing(Feeder(second, bodies)):
        first_frame(source, bodies)
        assert source.status.state is SourceState.LIVE
        source.close()


@pytest.mark.parametrize("version", [*VERSIONS, "4.2"])
@pytest.mark.parametrize("multicast", [True, False])
def test_an_independent_client_reads_models_markers_and_stamps(version, multicast):
    bodies = some_bodies(3)
    own = {"cf0": np.array([[0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1], [0.02, 0.03, 0.04]])}
    loose = np.array([[1.0, 2.0, 3.0], [-1.0, 0.5, 0.25]])
    names = [*bodies, "hidden"]
    with NatNetServer(names, 0, version=version, multicast=multicast, markers=own) as server:
        client = natnet.NatNetClient(
            "127.0.0.1", "127.0.0.1", command_port=server.port, data_port=server.data_port,
            use_multicast=multicast,
        )  # fmt: skip
        frames, models = [], []
        client.on_data_frame_received_event.handlers.append(frames.append)
        client.on_data_description_received_event.handlers.append(models.append)
        with client:
            client.request_modeldef()
            with closing(Feeder(server, bodies, loose)):

                def arrived() -> bool:
                    client.update_sync()
                    return bool(frames and models)

                eventually(arrived, 20.0)
            assert str(client.server_info.nat_net_protocol_version).startswith(version)
    described = models[0].rigid_bodies
    assert [(d.name, d.id_num) for d in described] == [(n, i + 1) for i, n in enumerate(names)]
    np.testing.assert_allclose([m.pos for m in described[0].markers], own["cf0"], atol=1e-7)
    frame = frames[-1]
    assert [b.tracking_valid for b in frame.rigid_bodies] == [True, True, True, False]
    for body, pose in zip(frame.rigid_bodies, bodies.values(), strict=False):
        np.testing.assert_allclose(body.pos, pose.position, atol=1e-6)
        np.testing.assert_allclose(body.rot, pose.quaternion, atol=1e-6)
    labelled = [m for m in frame.labeled_markers if m.model_id == 1]
    placed = bodies["cf0"].position + rotate(bodies["cf0"].quaternion, own["cf0"])
    np.testing.assert_allclose([m.pos for m in labelled], placed, atol=1e-6)
    alone = [m.pos for m in frame.labeled_markers if m.model_id == 0]
    np.testing.assert_allclose(alone, loose, atol=1e-6)
    np.testing.assert_allclose(frame.unlabeled_marker_pos, loose, atol=1e-6)
    assert len(frame.marker_sets) == 4
    stamp = frame.suffix.stamp_camera_mid_exposure / wire.TICKS
    assert not frame.suffix.is_recording
    assert not frame.suffix.tracked_models_changed
    assert stamp == pytest.approx(0.01 * frame.prefix.frame_number, abs=1e-6)


def test_y_up_and_back_is_what_it_was():
    pose = some_bodies(1)["cf0"]
    there = pose_to_y_up(pose)
    assert there.position[1] == pytest.approx(pose.position[2])
    back = pose_from_y_up(there)
    np.testing.assert_allclose(back.position, pose.position, atol=1e-12)
    assert angle_between(back.quaternion, pose.quaternion) < 1e-7
    points = np.random.default_rng(0).normal(size=(5, 3))
    np.testing.assert_allclose(points_from_y_up(points_to_y_up(points)), points, atol=1e-12)
    assert Convention("y-up").body("x", there).position == pytest.approx(pose.position)


def test_wrong_options_are_named():
    with pytest.raises(InputError, match="NatNet version"):
        NatNetServer(["cf1"], 0, version="2.7")
    with NatNetServer(["cf1"], 0) as server, pytest.raises(InputError, match="port"):
        NatNetServer(["cf1"], server.port)
    with pytest.raises(InputError, match="axes"):
        open_source("optitrack", clock=WallClock(), axes="x-up")


def test_server_answers_nonsense_and_goes_on():
    with (
        NatNetServer(["cf1"], 0) as server,
        closing(Feeder(server, some_bodies(1))),
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client,
    ):
        client.settimeout(5.0)
        for data in (b"", b"\0", b"\xff" * 4000, struct.pack("<HH", 10, 0)):
            client.sendto(data, ("127.0.0.1", server.port))
        client.sendto(struct.pack("<HH", 0, 0), ("127.0.0.1", server.port))
        answers = set()
        while wire.SERVER_INFO not in answers:
            answers.add(wire.message_of(client.recv(65536)))
        assert wire.UNRECOGNISED in answers


@given(
    st.sampled_from(wire.VERSIONS), st.integers(0, 6), st.integers(0, 6), st.integers(0, 2**31 - 1)
)
def test_sizes_announced_are_those_sent(version, bodies, loose, number):
    poses = some_bodies(bodies)
    places = {name: np.zeros((3, 3)) for name in poses}
    data = wire.frame(version, number, 1.0, poses, places, np.zeros((loose, 3)))
    assert struct.unpack_from("<HH", data) == (wire.FRAME, len(data) - 4)
    from natnet.data_frame import DataFrame
    from natnet.packet_buffer import PacketBuffer
    from natnet.version import Version

    buffer = PacketBuffer(data[4:])
    frame = DataFrame.read_from_buffer(buffer, Version(*version))
    assert frame.prefix.frame_number == number
    assert len(frame.rigid_bodies) == bodies
    assert len(frame.labeled_markers) == 3 * bodies + loose


def test_what_does_not_fit_a_datagram_is_refused():
    with pytest.raises(ValueError, match="fit"):
        wire.frame((3, 1), 0, 0.0, {}, {}, np.zeros((3000, 3)))
