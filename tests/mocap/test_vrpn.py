"""VRPN: our server against the client of ``motioncapture`` and our own, and what is no VRPN."""

from __future__ import annotations

import socket
import struct
import threading
from contextlib import closing, suppress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyarena.clock import WallClock
from crazyarena.errors import InputError
from crazyarena.mocap import vrpn_wire as wire
from crazyarena.mocap.check import MocapCheck
from crazyarena.mocap.opening import open_source
from crazyarena.mocap.rotations import angle_between
from crazyarena.mocap.serve import circling
from crazyarena.mocap.source import PoseSource, SourceState
from crazyarena.mocap.vrpn_server import VrpnServer
from crazyarena.types import Pose, PoseFrame
from tests.waiting import eventually

CLIENTS = [
    {"client": "motioncapture"},
    {"client": "motioncapture", "hostname": "udp"},
    {},
    {"transport": "udp"},
]
NINE = [f"cf{i}" for i in range(1, 10)]


def opened(server: VrpnServer, options: dict[str, str]) -> PoseSource:
    options = dict(options)
    # A bare host name has the package's client announce itself by UDP.
    scheme = "" if options.pop("hostname", "") == "udp" or "client" not in options else "tcp://"
    return open_source(
        "vrpn", clock=WallClock(), hostname=f"{scheme}localhost:{server.port}",
        retry_after=0.05, **options,
    )  # fmt: skip


class Feeder(threading.Thread):
    """100 frames a second of the bodies, each sent by itself, until stopped."""

    def __init__(self, server: VrpnServer) -> None:
        super().__init__(daemon=True)
        self.server = server
        self.done = threading.Event()
        self.count = 0
        self.start()

    def run(self) -> None:
        clock = WallClock()
        truth = circling(self.server.bodies)
        while not self.done.is_set():
            time = 0.01 * self.count
            self.server.publish(PoseFrame(1000.0 + time, time, self.count, truth(time)))
            self.count += 1
            clock.sleep_until(0.01 * self.count)

    def close(self) -> None:
        self.done.set()
        self.join(2.0)


def collect(source: PoseSource, count: int) -> list[PoseFrame]:
    frames: list[PoseFrame] = []
    eventually(lambda: frames.extend(source.frames(0.05)) or len(frames) >= count, 20.0)
    return frames


@pytest.mark.parametrize("options", CLIENTS)
def test_nine_bodies_at_100_hz_come_as_whole_frames(options):
    with VrpnServer(NINE, 0) as server, closing(Feeder(server)):
        source = opened(server, options)
        check = MocapCheck(NINE)
        frames = collect(source, 150)
        for frame in frames:
            check.add(frame)
        status = source.status
        source.close()
    report = check.report(status, 1.5)
    for name in NINE:
        body = report.bodies[name]
        assert body.missing <= 1, (name, body.missing)  # the instant that was just arriving
        assert body.jumps == body.flips == 0
    assert status.lost == status.dropped == status.malformed == 0
    if "client" not in options:
        # Every instant arrived, under its own stamp.
        first = frames[5].timestamp
        steps = sorted({round((f.timestamp - first) / 0.01) for f in frames[5:]})
        assert steps == list(range(steps[-1] + 1))


@pytest.mark.parametrize("options", CLIENTS)
def test_poses_survive_the_wire(options):
    rng = np.random.default_rng(3)
    truth = {}
    for name in NINE:
        q = rng.normal(size=4)
        truth[name] = Pose(rng.uniform(-3, 3, 3), q / np.linalg.norm(q))
    with VrpnServer([*NINE, "hidden"], 0) as server:
        source = opened(server, options)
        seen: dict[str, Pose] = {}
        count = 0

        def arrived() -> bool:
            nonlocal count
            count += 1
            server.publish(PoseFrame(1.0 + 0.01 * count, 0.0, count, truth))
            for frame in source.frames(0.02):
                seen.update(frame.bodies)
            return len(seen) == len(NINE)

        eventually(arrived, 20.0)
        source.close()
    for name, pose in seen.items():
        np.testing.assert_allclose(pose.position, truth[name].position, atol=1e-6)
        assert angle_between(pose.quaternion, truth[name].quaternion) < 1e-6 + 1e-3 * bool(options)


@pytest.mark.parametrize("options", [{"client": "motioncapture"}, {}])
def test_a_server_that_dies_and_returns(options):
    with VrpnServer(["cf1"], 0) as server:
        port = server.port
        feeder = Feeder(server)
        source = opened(server, options)
        collect(source, 5)
        feeder.close()
    eventually(lambda: source.status.state is SourceState.LOST, 10.0)
    assert source.status.error
    with VrpnServer(["cf1"], port) as server, closing(Feeder(server)):
        eventually(lambda: source.frames(0.05) and source.status.state is SourceState.LIVE, 20.0)
        assert source.status.reconnects >= 1
        source.close()
    assert source.frames(1.0) == []


def test_no_server_and_a_server_of_another_kind_are_said_in_words():
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        source = open_source("vrpn", clock=WallClock(), port=port, retry_after=0.05)
        connection, _ = other.accept()
        connection.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n")
        eventually(lambda: "VRPN 7" in (source.status.error or ""))
        connection.close()
    eventually(lambda: "refused" in (source.status.error or ""))
    source.close()


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"hostname": "a", "port": "x"}, "hostname"),
        ({"hostname": ""}, "hostname"),
        ({"hostname": "a:99999"}, "hostname"),
        ({"transport": "pigeon"}, "transport"),
        ({"stall_after": 0.0}, "stall_after"),
        ({"assemble": 3.0}, "assemble"),
        ({"client": "theirs"}, "client"),
        ({"hostnam": "x"}, "hostnam"),
    ],
)
def test_wrong_options_are_named(options, word):
    with pytest.raises(InputError, match=word):
        open_source("vrpn", clock=WallClock(), **options)


def test_server_survives_clients_that_talk_nonsense():
    bad = [
        b"\xff" * 64,
        b"GET / HTTP/1.1\r\n\r\n" * 3,
        wire.COOKIE + b"\xff" * 48,
        wire.COOKIE + struct.pack(">iiiiiI", 24 + 70000, 0, 0, 0, -2, 0),
    ]
    with VrpnServer(["cf1"], 0) as server:
        for data in bad:
            with socket.create_connection(("127.0.0.1", server.port)) as client:
                client.settimeout(5.0)
                client.sendall(data)
                while client.recv(4096):
                    pass
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
            for text in (b"", b"x" * 300, b"127.0.0.1 0", b"127.0.0.1 999999999999", b"\xff \xff"):
                client.sendto(text, ("127.0.0.1", server.port))
        with closing(Feeder(server)):
            source = opened(server, {})
            collect(source, 3)
            source.close()


def test_a_taken_port_is_an_input_error():
    with VrpnServer(["cf1"], 0) as server, pytest.raises(InputError, match="port"):
        VrpnServer(["cf1"], server.port)


@given(
    st.lists(
        st.tuples(
            st.integers(-5, 100), st.integers(0, 100), st.binary(max_size=80),
            st.integers(0, 2_000_000_000),
        ),
        max_size=8,
    ),
    st.integers(1, 50),
)  # fmt: skip
def test_messages_come_out_as_they_went_in_however_they_are_cut(messages, cut):
    data = wire.COOKIE + b"".join(
        wire.pack(kind, sender, body, time * 1e-3, 7) for kind, sender, body, time in messages
    )
    stream = wire.Stream()
    found = [m for i in range(0, len(data), cut) for m in stream.feed(data[i : i + cut])]
    assert [(m.kind, m.sender, m.body) for m in found] == [m[:3] for m in messages]
    for message, sent in zip(found, messages, strict=True):
        assert message.time == pytest.approx(sent[3] * 1e-3, abs=2e-6)


@given(st.binary(max_size=300))
def test_anything_is_messages_or_an_error(data):
    with suppress(wire.VrpnError):
        assert len(wire.unpack_datagram(data)) <= len(data) // 24
