"""Virtual Crazyflies in wall time: pace, addresses, faults while they run, true poses."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Iterator, Mapping

import numpy as np
import pytest

from crazyarena.clock import WallClock
from crazyarena.errors import InputError
from crazyarena.mocap.camera_model import CameraModel
from crazyarena.mocap.sim_source import SimSource
from crazyarena.mocap.zenoh_link import ZenohSource
from crazyarena.sim_backend.arena import ArenaFleet
from crazyarena.sim_backend.crtp import host as hosts
from crazyarena.sim_backend.crtp.faults import Faults
from crazyarena.sim_backend.crtp.film import IdealCameras
from crazyarena.sim_backend.crtp.server import VirtualServer
from crazyarena.sim_backend.crtp.swarm import VirtualSwarm
from crazyarena.types import Pose, PoseFrame

_PROBE = b"\xff"
_ECHO = bytes.fromhex("fc010203")
_LOG_CREATE = bytes.fromhex("5d0601772000")
_LOG_START = bytes.fromhex("5d030101")


class _Client:
    def __init__(self, uri: str) -> None:
        address, _, port = uri.removeprefix("udp://").partition(":")
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect((address, int(port)))

    def ask(self, datagram: bytes, timeout: float = 2.0) -> bytes | None:
        self._socket.send(datagram)
        return self.hear(timeout)

    def hear(self, timeout: float = 2.0) -> bytes | None:
        self._socket.settimeout(timeout)
        try:
            return self._socket.recv(64)
        except TimeoutError:
            return None

    def close(self) -> None:
        self._socket.close()


def _swarm(count: int = 1) -> VirtualSwarm:
    fleet = ArenaFleet(hosts.starts(count))
    fleet.advance(1)
    return VirtualSwarm(fleet)


@pytest.fixture
def server() -> Iterator[VirtualServer]:
    with VirtualServer(_swarm(2), port=0) as running:
        yield running


@pytest.fixture
def client(server: VirtualServer) -> Iterator[_Client]:
    client = _Client(server.uris[0])
    yield client
    client.close()


def _wait(condition: Callable[[], object], timeout: float = 10.0) -> None:
    end = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.01)


def test_each_vehicle_has_its_port(server: VirtualServer) -> None:
    assert len(set(server.uris)) == 2
    for uri in server.uris:
        client = _Client(uri)
        assert client.ask(_PROBE) == _PROBE
        assert client.ask(_ECHO) == _ECHO
        client.close()


def test_a_probe_does_not_take_over_the_stream(server: VirtualServer, client: _Client) -> None:
    assert client.ask(_LOG_CREATE) == bytes.fromhex("5d060100")
    assert client.ask(_LOG_START) == bytes.fromhex("5d030100")
    other = _Client(server.uris[0])
    assert other.ask(_PROBE) == _PROBE
    assert other.hear(0.1) is None
    datagram = client.hear()
    assert datagram is not None
    assert datagram[:2] == bytes.fromhex("5201")
    other.close()


def test_time_passes_like_wall_time(server: VirtualServer) -> None:
    _wait(lambda: server.pace.ticks > 0)
    ticks, begin = server.pace.ticks, time.monotonic()
    _wait(lambda: time.monotonic() - begin > 1.0)
    assert server.pace.ticks - ticks == pytest.approx(
        1000 * (time.monotonic() - begin), abs=20 + server.pace.worst
    )


class _Jumping(WallClock):
    ahead = 0.0

    def now(self) -> float:
        return super().now() + self.ahead


def test_a_stall_is_caught_up_and_nothing_is_skipped() -> None:
    """The clock jumps ahead; every millisecond of the gap is simulated all the same."""
    clock = _Jumping()
    swarm = _swarm()
    heard: list[int] = []
    with VirtualServer(swarm, port=0, clock=clock) as server:
        client = _Client(server.uris[0])
        client.ask(_LOG_CREATE)
        client.ask(_LOG_START)
        begin = clock.now()
        clock.ahead = 3.0
        while len(heard) < 300:
            datagram = client.hear()
            assert datagram is not None
            heard.append(int.from_bytes(datagram[2:5], "little"))
        _wait(lambda: server.pace.ticks >= 3000)
        assert server.pace.stalls >= 1
        assert server.pace.worst >= 2900
        assert swarm.fleet.tick - 1 == server.pace.ticks
        assert server.pace.ticks <= 1000 * (clock.now() - begin) + 1000
        client.close()
    # Log data of the whole stall, every 10 ms.
    assert np.diff(heard) == pytest.approx(np.full(299, 10), abs=2)


def test_cameras_see_a_stall_as_it_went() -> None:
    """Frames of the time that is caught up show each moment of it, not all the same one."""
    clock = _Jumping()
    swarm = _swarm()
    exposures: list[tuple[float, int]] = []

    class Cameras(IdealCameras):
        def expose(self, time: float, truth: Mapping[str, Pose]) -> None:
            exposures.append((time, swarm.fleet.tick))
            super().expose(time, truth)

    with VirtualServer(swarm, port=0, clock=clock, cameras=Cameras(clock.now(), 100.0)) as server:
        _wait(lambda: len(exposures) > 5)
        clock.ahead = 1.0
        _wait(lambda: len(exposures) > 120)
        assert server.pace.worst >= 900
    times, ticks = np.array(exposures).T
    assert times - 1e-3 * ticks == pytest.approx(np.full(len(times), times[0]), abs=0.012)


def test_faults_while_it_runs(server: VirtualServer, client: _Client) -> None:
    server.set_faults(loss=1.0, safe_link=False)
    assert client.ask(_ECHO, 0.2) is None
    server.set_faults(loss=0.0)
    assert client.ask(_ECHO) == _ECHO

    server.set_faults(latency=0.1)
    begin = time.monotonic()
    assert client.ask(_ECHO) == _ECHO
    assert time.monotonic() - begin >= 0.2
    server.set_faults(latency=0.0)

    server.cut(0.3, vehicle=0)
    begin = time.monotonic()
    assert client.ask(_ECHO, 0.05) is None
    while client.ask(_ECHO, 0.02) is None:
        assert time.monotonic() - begin < 5.0
    assert time.monotonic() - begin >= 0.25
    other = _Client(server.uris[1])
    assert other.ask(_ECHO) == _ECHO
    other.close()
    assert server.links[0].uplink.counters.cut > 0
    assert server.links[1].uplink.counters.cut == 0


def test_battery_and_reboot(server: VirtualServer, client: _Client) -> None:
    vehicle = server.swarm.vehicles[0]
    server.set_battery(3.2, 0)

    def volts(index: int) -> float:
        return server.swarm.fleet.telemetry(index).battery or 0.0

    _wait(lambda: volts(0) < 3.25)
    assert volts(0) == pytest.approx(3.2, abs=0.03)
    assert volts(1) > 4.1
    with pytest.raises(ValueError, match="battery"):
        server.set_battery(5.0)

    client.ask(bytes.fromhex("9d03"), 0.05)
    _wait(lambda: vehicle.flight.info() & 64)
    server.reboot(0)
    _wait(lambda: vehicle.flight.info() & 64 == 0 and vehicle.flight.info() & 8)
    assert client.ask(_ECHO) == _ECHO


def test_a_taken_port_is_named() -> None:
    with VirtualServer(_swarm(), port=0) as first:
        port = first.links[0].port
        with pytest.raises(InputError, match=str(port)):
            VirtualServer(_swarm(), port=port)


def test_cameras_see_the_true_poses() -> None:
    frames: list[PoseFrame] = []

    class Collector:
        def publish(self, frame: PoseFrame) -> None:
            frames.append(frame)

    clock = WallClock()
    model = CameraModel(
        rate=100.0,
        latency=0.0,
        latency_jitter=0.0,
        position_noise=0.0,
        attitude_noise=0.0,
        dropout=0.0,
    )
    swarm = _swarm(2)
    cameras = SimSource(clock, model=model)
    with VirtualServer(
        swarm,
        port=0,
        clock=clock,
        cameras=cameras,
        publisher=Collector(),  # type: ignore[arg-type]
    ):
        _wait(lambda: len(frames) >= 50)
    assert [frame.frame_id for frame in frames] == list(range(len(frames)))
    stamps = [frame.timestamp for frame in frames]
    assert np.diff(stamps) == pytest.approx(np.full(len(stamps) - 1, 0.01))
    assert set(frames[-1].bodies) == {"cf1", "cf2"}
    assert frames[-1].bodies["cf2"].position == pytest.approx(
        swarm.fleet.true_pose(1).position, abs=1e-6
    )


@pytest.mark.parametrize(
    ("options", "field"),
    [
        (hosts.Options(count=0), "count"),
        (hosts.Options(feed_poses=-1.0), "feed-poses"),
        (hosts.Options(loss="much"), "loss"),
        (hosts.Options(latency="8"), "latency"),
        (hosts.Options(battery="12V"), "battery"),
        (hosts.Options(level="no-such-level", mocap=False), "no-such-level"),
        (hosts.Options(port=65535, count=2, mocap=False), "65535"),
    ],
)
def test_wrong_options_are_named(options: hosts.Options, field: str) -> None:
    with pytest.raises(InputError, match=field):
        hosts.build(options)


def test_commands_on_standard_input() -> None:
    host = hosts.build(hosts.Options(port=0, mocap=False, level="level1"))
    try:
        faults = host.server.links[0].faults
        assert host.command("loss 5%") == "loss 5%"
        assert faults.loss == pytest.approx(0.05)
        host.command("latency 8ms±3ms")
        assert (faults.latency, faults.jitter) == pytest.approx((0.008, 0.003))
        host.command("cut 2s")
        assert faults.cut_until > 0.0
        host.command("battery 3.2V")
        host.command("reboot")
        assert "received 0" in host.command("status")
        for wrong in ("explode", "loss", "cut never"):
            with pytest.raises(InputError):
                host.command(wrong)
    finally:
        host.close()


def test_faults_are_each_vehicles_own() -> None:
    given = Faults(loss=0.5)
    server = VirtualServer(_swarm(2), port=0, faults=given)
    server.set_faults(0, loss=0.1)
    assert [link.faults.loss for link in server.links] == [0.1, 0.5]
    server.close()


def test_true_poses_over_zenoh() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    host = hosts.build(hosts.Options(count=2, port=0, mocap_endpoint=endpoint))
    source = ZenohSource(WallClock(), connect=[endpoint])
    try:
        host.server.start()
        frames: list[PoseFrame] = []
        _wait(lambda: frames.extend(source.frames(0.1)) or len(frames) >= 30, 30.0)
    finally:
        source.close()
        host.close()
    rate = (len(frames) - 1) / (frames[-1].timestamp - frames[0].timestamp)
    assert rate == pytest.approx(120.0, rel=0.05)
    assert set(frames[-1].bodies) == {"cf1", "cf2"}
    assert frames[-1].bodies["cf2"].position == pytest.approx((0.0, 0.5, 0.0135), abs=1e-3)


class _Hand:
    """A clock that somebody sets."""

    def __init__(self) -> None:
        self.time = 0.0

    def now(self) -> float:
        return self.time

    def sleep_until(self, deadline: float) -> float:
        self.time = max(self.time, deadline)
        return 0.0


class _Mail:
    """A link on which datagrams lie until the server reads them."""

    uri = "test://"

    def __init__(self) -> None:
        self.faults = Faults()
        self.waiting: list[bytes] = []
        self._ends = socket.socketpair()

    @property
    def uplink(self) -> _Mail:
        return self

    def due(self) -> float:
        return float("inf")

    def fileno(self) -> int:
        return self._ends[0].fileno()

    def post(self, datagram: bytes) -> None:
        self.waiting.append(datagram)
        self._ends[1].send(b".")

    def receive(self, now: float) -> list[tuple[bytes, object]]:
        if self.waiting:
            self._ends[0].recv(64)
        taken, self.waiting = self.waiting, []
        return [(datagram, None) for datagram in taken]

    def send(self, datagram: bytes, now: float, receiver: object = None) -> None: ...

    def flush(self, now: float) -> None: ...

    def boots(self) -> bool:
        return False

    def reboot(self, now: float) -> None: ...

    def report(self) -> str:
        return ""

    def close(self) -> None:
        for end in self._ends:
            end.close()


def _passes(server: VirtualServer, clock: _Hand, times: list[float], act: Callable[[float], None]):
    """Run the server's loop by hand: at each time ``act``, then one pass."""
    due = iter(times)

    def wait() -> set[int]:
        try:
            clock.time = next(due)
        except StopIteration:
            server.stop()
            return set()
        act(clock.time)
        return {0} if server.links[0].waiting else set()  # type: ignore[attr-defined]

    server._wait = wait  # type: ignore[method-assign]
    server.run()


@pytest.mark.parametrize("moment", [0.0, 0.0013, 0.0021, 0.0039])
def test_a_packet_counts_from_the_tick_at_which_it_arrives(moment: float) -> None:
    clock, mail = _Hand(), _Mail()
    server = VirtualServer(_swarm(), links=[mail], clock=clock)
    heard = []
    flight = server.swarm.vehicles[0].flight
    first = server.swarm.fleet.tick
    offer = flight.fleet.setpoint

    def setpoint(*arguments: object) -> None:
        heard.append(flight.fleet.tick - first)
        offer(*arguments)  # type: ignore[arg-type]

    flight.fleet.setpoint = setpoint  # type: ignore[method-assign]
    arrival = 0.1 + moment

    def act(time: float) -> None:
        if time == arrival:
            mail.post(bytes.fromhex("7c00"))

    # The pass before it left the vehicle at a round 4 ms.
    _passes(server, clock, [0.096, 0.1, arrival] if moment else [0.096, arrival], act)
    server.close()
    assert heard == [int(1e3 * arrival + 1e-9)]


@pytest.mark.parametrize("rate", [120.0, 240.0, 97.0])
def test_cameras_see_the_vehicle_where_it_is_when_they_look(rate: float) -> None:
    clock, mail = _Hand(), _Mail()
    source = SimSource(clock, None, CameraModel(rate=rate))
    server = VirtualServer(_swarm(), links=[mail], clock=clock, cameras=source)
    fleet, first = server.swarm.fleet, server.swarm.fleet.tick
    late = []
    expose = source.expose

    def looked(time: float, truth: Mapping[str, Pose]) -> None:
        late.append(1e-3 * (fleet.tick - first) - time)
        expose(time, truth)

    source.expose = looked  # type: ignore[method-assign]
    _passes(server, clock, [0.0, *np.arange(0.004, 0.4, 0.004), 0.55], lambda time: None)
    server.close()
    assert len(late) > 0.5 * rate
    assert min(late) > -1e-9
    assert max(late) < 1e-3 + 1e-9


def test_it_wakes_for_the_arrival_of_a_frame() -> None:
    clock = _Hand()
    source = SimSource(clock, None, CameraModel(latency=0.0021, latency_jitter=0.0))
    server = VirtualServer(_swarm(), port=0, clock=clock, cameras=source)
    slept: list[float] = []

    def select(timeout: float) -> list[object]:
        slept.append(timeout)
        server.stop()
        return []

    server._selector.select = select  # type: ignore[assignment, method-assign]
    source.expose(0.0, {})
    server.run()
    server.close()
    assert slept == [pytest.approx(0.0021)]
