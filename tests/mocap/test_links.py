"""Sources against real peers: a zenoh session in another process, the vendors' client code."""

from __future__ import annotations

import multiprocessing
import socket
import threading
import time as stopwatch
from contextlib import closing

import numpy as np
import pytest

from benchmarks.mocap_latency import Measurement, free_port, measure
from crazyarena.clock import WallClock
from crazyarena.errors import InputError
from crazyarena.mocap.estimator import Freshness, PoseEstimator
from crazyarena.mocap.events import EventKind, MocapEvent
from crazyarena.mocap.frames import Convention
from crazyarena.mocap.motioncapture_source import MotionCaptureSource
from crazyarena.mocap.opening import open_source
from crazyarena.mocap.pipeline import PosePipeline
from crazyarena.mocap.rotations import angle_between
from crazyarena.mocap.serve import circling, relay
from crazyarena.mocap.sim_source import SimSource
from crazyarena.mocap.source import SourceState
from crazyarena.mocap.vendor_server import QualisysServer
from crazyarena.mocap.wire import encode
from crazyarena.mocap.zenoh_link import ZenohPublisher, ZenohSource
from crazyarena.mocap.zenoh_session import open_session
from crazyarena.types import Pose, PoseFrame
from tests.waiting import eventually

# The Qualisys client always listens on this UDP port, so one may run at a time per machine.
QUALISYS_UDP = 6734


@pytest.fixture
def qualisys_port_free():
    for _ in range(60):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind(("0.0.0.0", QUALISYS_UDP))
                return
            except OSError:
                stopwatch.sleep(0.5)
    pytest.skip(f"UDP port {QUALISYS_UDP} is taken by another Qualisys client")


def show(m: Measurement) -> None:
    print(
        f"{m.chain}: {m.received}/{m.published} frames, latency ms p50 {m.p50:.2f} "
        f"p99 {m.p99:.2f} max {m.maximum:.2f}, load average {m.load_average:.1f}"
    )


def complete(m: Measurement) -> bool:
    show(m)
    return m.received == m.published and m.in_order and m.malformed == 0


def test_zenoh_between_processes_loses_nothing():
    assert complete(measure("zenoh", 300.0, 2.0, 10))


def test_real_vendor_client_against_emulated_server_loses_nothing(qualisys_port_free):
    assert complete(measure("qualisys", 300.0, 2.0, 10))


def test_nine_trackers_of_vrpn_lose_nothing():
    assert complete(measure("vrpn", 100.0, 2.0, 9))


@pytest.mark.slow
def test_zenoh_for_twenty_seconds():
    assert complete(measure("zenoh", 300.0, 20.0, 10))


@pytest.mark.slow
def test_real_vendor_client_for_twenty_seconds(qualisys_port_free):
    assert complete(measure("qualisys", 300.0, 20.0, 10))


class Feeder:
    """Publishes the circling bodies at 100 Hz until stopped."""

    def __init__(self, outlet, names, first: int = 0) -> None:
        self.outlet = outlet
        self._truth = circling(names)
        self._clock = WallClock()
        self._stop = threading.Event()
        self._next = first
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.is_set():
            now = self._clock.now()
            self.outlet.publish(PoseFrame(now, now, self._next, self._truth(now)))
            self._next += 1
            self._clock.sleep_until(now + 0.01)

    def pause(self) -> None:
        self._stop.set()
        self._thread.join(2.0)

    def close(self) -> None:
        self.pause()
        self.outlet.close()


class Watched:
    """A pipeline whose events and closing time are kept."""

    def __init__(self, source, names) -> None:
        self.events: list[MocapEvent] = []
        self.clock = WallClock()
        self.pipeline = PosePipeline(
            source(self.clock), PoseEstimator(names), self.clock, on_event=[self.events.append]
        )
        self.pipeline.start()

    def kinds(self) -> list[EventKind]:
        return [e.kind for e in self.events]

    def close(self) -> None:
        before = stopwatch.monotonic()
        self.pipeline.close()
        self.closing_took = stopwatch.monotonic() - before


def check_death_and_return(watched: Watched, feeder, revive) -> None:
    """The story every network source must tell: live, stale on time, live again, closed."""
    pipeline = watched.pipeline
    with closing(watched):
        eventually(lambda: pipeline.live and "cf1" in pipeline.poses())
        last = pipeline.estimate("cf1")
        assert last.freshness in (Freshness.FRESH, Freshness.BRIDGED)
        watched.events.clear()
        feeder.close()
        eventually(lambda: EventKind.SOURCE_STALE in watched.kinds(), 3.0)
        eventually(lambda: EventKind.BODY_STALE in watched.kinds(), 3.0)
        stale = next(e for e in watched.events if e.kind is EventKind.SOURCE_STALE)
        silence = float(stale.message.split()[3])
        # Never early; how late is up to the machine's load.
        assert silence >= 150
        assert pipeline.poses() == {}
        assert pipeline.estimate("cf1").freshness is Freshness.STALE
        revived = revive()
        try:
            eventually(lambda: "cf1" in pipeline.poses(), 20.0)
            eventually(lambda: EventKind.SOURCE_RECONNECTED in watched.kinds(), 3.0)
            eventually(lambda: EventKind.BODY_RECOVERED in watched.kinds(), 3.0)
        finally:
            revived.close()
    assert watched.closing_took < 1.0
    assert pipeline.source.status.state is SourceState.CLOSED
    assert pipeline.error is None
    assert pipeline._thread is not None
    assert not pipeline._thread.is_alive()


def test_zenoh_publisher_dies_and_returns():
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    names = ["cf1", "cf2"]

    def feeder() -> Feeder:
        return Feeder(ZenohPublisher(WallClock(), listen=[endpoint]), names)

    first = feeder()
    check_death_and_return(
        Watched(lambda clock: ZenohSource(clock, connect=[endpoint]), names), first, feeder
    )


def test_vendor_server_dies_and_returns(qualisys_port_free):
    port = free_port()
    names = ["cf1", "cf2"]

    def feeder() -> Feeder:
        return Feeder(QualisysServer(names, port), names)

    def source(clock):
        return MotionCaptureSource(
            clock, "qualisys", hostname="127.0.0.1", port=port, stall_after=0.5, retry_after=0.1
        )

    first = feeder()
    check_death_and_return(Watched(source, names), first, feeder)


def test_vendor_server_that_stalls_is_noticed_and_closing_does_not_wait(qualisys_port_free):
    port = free_port()
    server = QualisysServer(["cf1"], port)
    feeder = Feeder(server, ["cf1"])
    watched = Watched(
        lambda clock: MotionCaptureSource(clock, "qualisys", hostname="127.0.0.1", port=port),
        ["cf1"],
    )
    with closing(watched):
        eventually(lambda: watched.pipeline.live)
        watched.events.clear()
        feeder.pause()
        eventually(lambda: EventKind.SOURCE_STALE in watched.kinds(), 3.0)
    assert watched.closing_took < 1.0
    server.close()


def test_no_server_is_said_in_words_and_closing_does_not_wait():
    clock = WallClock()
    source = MotionCaptureSource(clock, "qualisys", hostname="127.0.0.1", port=free_port())
    eventually(lambda: source.status.error is not None)
    assert "QTM" in (source.status.error or "")
    assert source.status.state is SourceState.LOST
    before = stopwatch.monotonic()
    source.close()
    source.close()
    assert stopwatch.monotonic() - before < 1.0
    assert source.frames(0.5) == []


def test_a_type_the_wheel_was_built_without_is_said_in_words():
    source = MotionCaptureSource(WallClock(), "motionanalysis", hostname="127.0.0.1")
    eventually(lambda: source.status.error is not None)
    assert "type" in (source.status.error or "")
    source.close()


def test_vendor_poses_survive_the_wire_and_hidden_bodies_are_absent(qualisys_port_free):
    rng = np.random.default_rng(3)
    port = free_port()
    truth = {}
    for i in range(6):
        q = rng.normal(size=4)
        truth[f"cf{i}"] = Pose(rng.uniform(-3, 3, 3), q / np.linalg.norm(q))
    offset = Pose(np.array([0.0, 0.0, -0.02]))
    clock = WallClock()
    with QualisysServer([*truth, "hidden"], port) as server:
        source = MotionCaptureSource(
            clock,
            "qualisys",
            hostname="127.0.0.1",
            port=port,
            latency=0.005,
            convention=Convention(offsets={"cf0": offset}),
        )
        eventually(lambda: server.clients == 1)
        server.publish(PoseFrame(0.0, 0.0, 7, truth, rng.uniform(-1, 1, (5, 3))))
        frames = []
        eventually(lambda: frames.extend(source.frames(0.1)) or frames)
        source.close()
    (frame,) = frames
    assert frame.received - frame.timestamp >= 0.005
    assert set(frame.bodies) == set(truth)
    for name, pose in frame.bodies.items():
        expected = truth[name]
        position = expected.position
        if name == "cf0":
            position = Convention(offsets={"cf0": offset}).body("cf0", expected).position
            assert np.linalg.norm(position - expected.position) == pytest.approx(0.02)
        np.testing.assert_allclose(pose.position, position, atol=2e-6)
        assert angle_between(pose.quaternion, expected.quaternion) < 1e-3


def test_malformed_payloads_are_counted_and_dropped():
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    session = open_session(listen=[endpoint])
    clock = WallClock()
    source = ZenohSource(clock, key="test/poses", connect=[endpoint])
    good = encode(1, 0.0, 0.0, 5, 6, {"cf1": Pose(np.zeros(3))})
    frames = []

    def arrived() -> bool:
        session.put("test/poses", good)
        frames.extend(source.frames(0.05))
        return bool(frames)

    eventually(arrived)
    before = source.status.malformed
    for bad in (b"", b"CAPF", good[:-1], good[:20] + b"\xff" + good[21:], b"x" * 5000):
        session.put("test/poses", bad)
    eventually(lambda: source.status.malformed - before == 5)
    assert source.status.state is SourceState.LIVE
    assert "checksum" in (source.status.error or "") or source.status.error
    source.close()
    session.close()


def test_lost_frames_are_counted_and_told():
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    session = open_session(listen=[endpoint])
    watched = Watched(lambda c: ZenohSource(c, key="gap", connect=[endpoint]), ["cf1"])
    with closing(watched):
        for k in range(10_000):
            session.put("gap", encode(k, 0.0, 0.0, 5, 6, {}))
            stopwatch.sleep(0.01)
            if watched.pipeline.source.status.frames >= 3:
                break
        session.put("gap", encode(k + 5, 0.0, 0.0, 5, 6, {}))
        eventually(lambda: EventKind.FRAMES_LOST in watched.kinds())
        assert watched.pipeline.source.status.lost == 4
    session.close()


def relay_in_child(port: int, qualisys: int) -> None:
    clock = WallClock()
    camera = MotionCaptureSource(clock, "qualisys", hostname="127.0.0.1", port=qualisys)
    outlet = ZenohPublisher(clock, listen=[f"tcp/127.0.0.1:{port}"])
    relay(camera, [outlet], clock, duration=60.0)


def test_one_machine_reads_the_cameras_and_others_listen(qualisys_port_free):
    qualisys, zenoh_port = free_port(), free_port()
    clock = WallClock()
    with QualisysServer(["cf1", "cf2"], qualisys) as server:
        child = multiprocessing.get_context("spawn").Process(
            target=relay_in_child, args=(zenoh_port, qualisys), daemon=True
        )
        child.start()
        simulated = SimSource(clock, circling(["cf1", "cf2"]))
        stop = threading.Event()
        thread = threading.Thread(
            target=relay, args=(simulated, [server], clock, 60.0, stop), daemon=True
        )
        thread.start()
        sources = [
            open_source("zenoh", clock=clock, connect=[f"tcp/127.0.0.1:{zenoh_port}"])
            for _ in range(2)
        ]
        for source in sources:
            seen: set[str] = set()
            eventually(
                lambda source=source, seen=seen: (
                    [seen.update(f.bodies) for f in source.frames(0.1)] and len(seen) == 2
                )
            )
            source.close()
        stop.set()
        thread.join(2.0)
        child.kill()
        child.join(2.0)


def test_a_taken_port_and_a_bad_endpoint_are_input_errors():
    with QualisysServer(["cf1"], 0) as server, pytest.raises(InputError, match="port"):
        QualisysServer(["cf1"], server.port)
    with pytest.raises(InputError, match="endpoints"):
        open_session(listen=["nonsense"])
    with pytest.raises(InputError, match="choose one of"):
        open_source("kinect", clock=WallClock())
    with pytest.raises(InputError, match="pathh"):
        open_source("replay", clock=WallClock(), pathh="x")


def test_server_survives_clients_that_talk_nonsense():
    with QualisysServer(["cf1"], 0) as server:
        for data in (b"\xff" * 64, b"\0" * 8, b"GET / HTTP/1.1\r\n\r\n"):
            with socket.create_connection(("127.0.0.1", server.port + 1)) as client:
                client.sendall(data)
                client.settimeout(2.0)
                while client.recv(4096):
                    pass
        with socket.create_connection(("127.0.0.1", server.port + 1)) as client:
            client.settimeout(2.0)
            assert b"QTM RT Interface connected" in client.recv(4096)
