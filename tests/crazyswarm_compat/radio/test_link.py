"""Connections that come, go and come back; parameters, telemetry, uploads, statistics."""

import socket
import threading
import time

import numpy as np
import pytest

from crazyarena.clock import VirtualClock, WallClock
from crazyarena.crazyswarm_compat import commands as c
from crazyarena.crazyswarm_compat.config import FleetConfig, VehicleConfig
from crazyarena.crazyswarm_compat.radio import (
    CommandLost,
    CommandRefused,
    Lane,
    LinkLost,
    LinkUp,
    OutboxOptions,
    RadioBackend,
    RadioOptions,
    TrajectoryUploaded,
)
from crazyarena.errors import BackendError, CommandError, InputError
from crazyarena.sim_backend.arena import ArenaFleet
from crazyarena.sim_backend.crtp.server import VirtualServer
from crazyarena.sim_backend.crtp.swarm import VirtualSwarm
from crazyarena.sim_backend.crtp.toc import Table
from crazyarena.types import Pose
from tests.crazyswarm_compat.radio.conftest import Hangar
from tests.waiting import eventually

LOCKED = 1 << 6


def fleet_of(*uris):
    vehicles = [VehicleConfig(k + 1, f"cf{k + 1}", (0, 0, 0), uri=u) for k, u in enumerate(uris)]
    return FleetConfig(tuple(vehicles), "crazyflies.yaml")


def events(backend, kind):
    return [event for event in backend.take_events() if isinstance(event, kind)]


class TestConnecting:
    def test_needs_a_wall_clock(self):
        with pytest.raises(InputError, match="wall clock"):
            RadioBackend(fleet_of("udp://127.0.0.1:1"), VirtualClock())

    def test_a_vehicle_without_link_is_named(self):
        with pytest.raises(InputError, match=r"crazyflies\.yaml: cf1: found no link"):
            RadioBackend(fleet_of(None), WallClock())

    def test_two_vehicles_on_one_link(self):
        with pytest.raises(InputError, match=r"cf2: .* already used by cf1"):
            RadioBackend(fleet_of("udp://127.0.0.1:1", "udp://127.0.0.1:1"), WallClock())

    def test_every_vehicle_that_does_not_answer_is_named(self, tmp_path):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as silent:
            silent.bind(("127.0.0.1", 0))
            quiet = f"udp://127.0.0.1:{silent.getsockname()[1]}"
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as gone:
                gone.bind(("127.0.0.1", 0))
                closed = f"udp://127.0.0.1:{gone.getsockname()[1]}"
            options = RadioOptions(cache=tmp_path, connect_timeout=1.0)
            with pytest.raises(BackendError) as caught:
                RadioBackend(fleet_of(quiet, closed), WallClock(), options)
        message = str(caught.value)
        assert "cf1" in message
        assert "switched on" in message
        assert "cf2" in message
        assert "refused" in message

    def test_a_vehicle_that_opens_its_port_a_little_later_is_waited_for(self, toc_cache):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        started = []
        later = threading.Timer(0.7, lambda: started.append(Hangar(1, port)))
        later.start()
        try:
            options = RadioOptions(cache=toc_cache)
            RadioBackend(fleet_of(f"udp://127.0.0.1:{port}"), WallClock(), options).close()
        finally:
            later.join()
            for hangar in started:
                hangar.close()

    def test_the_table_of_contents_is_downloaded_once(self, tmp_path):
        hangar = Hangar(2, 0)
        try:
            options = RadioOptions(cache=tmp_path)
            first = RadioBackend(hangar.config(), WallClock(), options)
            first.close()
            # Two tables, parameters and log variables, the same for both vehicles.
            stored = sorted(tmp_path.glob("*.json"))
            assert len(stored) == 2
            before = [path.stat().st_mtime_ns for path in stored]
            received = [v.counters.received for v in hangar.server.swarm.vehicles]
            second = RadioBackend(hangar.config(), WallClock(), options)
            second.close()
            assert [path.stat().st_mtime_ns for path in stored] == before
            # Their descriptions are not read again.
            assert hangar.server.swarm.vehicles[0].counters.received - received[0] < 450
        finally:
            hangar.close()

    def test_a_lossy_link_without_safe_link_connects(self, world):
        _, backend = world(loss=0.05, safe_link=False)
        assert backend.connected(1)

    def test_closing_sends_nothing_that_would_stop_a_flight(self, world):
        hangar, backend = world()
        backend.prepare()
        backend.send(c.Takeoff(0.6, 1.0), 1)
        time.sleep(1.4)
        backend.close()
        backend.close()
        hangar.server.swarm.vehicles[0]._commander.rpyt.locked = False
        time.sleep(0.6)
        assert hangar.position(1)[2] == pytest.approx(0.6, abs=0.1)
        assert hangar.priority() == 1


class TestLinkLoss:
    def test_silence_is_detected_in_time_and_the_return_too(self, world):
        options = RadioOptions(link_timeout=0.5)
        hangar, backend = world(options=options)
        backend.take_events()
        start = backend.clock.now()
        hangar.server.cut(1.5)
        eventually(lambda: not backend.connected(1), 5.0)
        noticed = backend.clock.now() - start
        assert 0.3 < noticed < 1.2
        eventually(lambda: backend.connected(1), 5.0)
        kinds = [type(event) for event in backend.take_events()]
        assert kinds == [LinkLost, LinkUp]

    def test_sending_neither_blocks_nor_raises_without_a_vehicle(self, world):
        hangar, backend = world(options=RadioOptions(link_timeout=0.3))
        eventually(lambda: backend.telemetry(1).battery is not None, 5.0)
        hangar.server.close()
        worst = 0.0
        for k in range(100):
            before = time.perf_counter()
            backend.send(c.Position([0.0, 0.0, 1.0 + 1e-3 * k]), 1)
            backend.send(c.GoTo([0, 0, 1], 0.0, 1.0), 1)
            backend.send_external_poses({1: Pose(np.zeros(3))})
            backend.feed_watchdog()
            worst = max(worst, time.perf_counter() - before)
            time.sleep(0.005)
        backend.send(c.Emergency())
        eventually(lambda: not backend.connected(1), 5.0)
        assert worst < 0.25
        assert backend.telemetry(1).battery is not None  # the last word stays
        assert events(backend, LinkLost)

    def test_reconnects_when_asked(self, toc_cache):
        hangar = Hangar(1, 0)
        port = hangar.server.links[0].port
        options = RadioOptions(
            cache=toc_cache, reconnect=True, reconnect_interval=0.2, link_timeout=0.3
        )
        backend = RadioBackend(hangar.config(), WallClock(), options)
        try:
            hangar.close()
            eventually(lambda: not backend.connected(1), 5.0)
            hangar = Hangar(1, port)
            eventually(lambda: backend.connected(1), 15.0)
            kinds = [type(event) for event in backend.take_events()]
            assert kinds == [LinkUp, LinkLost, LinkUp]
            # The new connection is whole: parameters, and commands.
            backend.set_param(1, "ring.effect", 3)
            assert hangar.fleet.get_param(0, "ring.effect") == 3
        finally:
            backend.close()
            hangar.close()

    def test_events_reach_a_listener(self, world):
        hangar, backend = world(options=RadioOptions(link_timeout=0.3))
        heard = []
        lost = threading.Event()

        def listen(event):
            heard.append(event)
            lost.set()

        unsubscribe = backend.subscribe(listen)
        hangar.server.cut(0.8)
        assert lost.wait(3.0)
        assert heard[0].vehicle == 1
        unsubscribe()


class TestParameters:
    def test_written_values_are_read_back(self, world):
        hangar, backend = world(fed=False)
        backend.set_param(1, "ctrlMel.kp_xy", 0.123)
        assert backend.get_param(1, "ctrlMel.kp_xy") == pytest.approx(0.123)
        assert hangar.fleet.get_param(0, "ctrlMel.kp_xy") == pytest.approx(0.123)
        # Without waiting; reading waits for the writes under way.
        for value in range(20):
            backend.send(c.SetParam("ring.effect", value), 1)
        assert backend.get_param(1, "ring.effect") == 19

    def test_what_no_vehicle_takes_is_refused_at_once(self, world):
        _, backend = world(fed=False)
        with pytest.raises(BackendError, match=r"cf1: no parameter 'a\.b'"):
            backend.send(c.SetParam("a.b", 1.0), 1)
        with pytest.raises(BackendError, match=r"cf1: no parameter 'a\.b'"):
            backend.get_param(1, "a.b")
        with pytest.raises(CommandError, match=r"ring\.effect is 300.*uint8"):
            backend.send(c.SetParam("ring.effect", 300), 1)
        with pytest.raises(CommandError, match="read-only"):
            backend.set_param(1, "system.selftestPassed", 0)
        with pytest.raises(CommandError, match="no vehicle with id 9"):
            backend.send(c.Stop(), 9)
        assert "ring.effect" in backend.param_names(1)

    def test_led_ring(self, world):
        hangar, backend = world(fed=False)
        backend.send(c.SetLed(1.0, 0.5, 0.0), 1)
        assert backend.get_param(1, "ring.solidBlue") == 0
        stored = [hangar.fleet.get_param(0, f"ring.solid{n}") for n in ("Red", "Green", "Blue")]
        assert stored == [255, 127, 0]

    def test_collision_avoidance_that_the_firmware_lacks(self, world):
        _, backend = world(fed=False, table=Table.RECORDED)
        assert "colAv.enable" not in backend.param_names(1)
        with pytest.raises(BackendError, match=r"cf1: .* without collision avoidance"):
            backend.send(c.CollisionAvoidance(True), 1)
        backend.send(c.CollisionAvoidance(False), 1)


class TestTelemetry:
    def test_everything_is_told(self, world):
        hangar, backend = world()
        backend.prepare()
        backend.send(c.Takeoff(0.5, 1.0), 1)
        time.sleep(1.6)
        telemetry = backend.telemetry(1)
        assert telemetry.battery == pytest.approx(hangar.fleet.telemetry(0).battery, abs=0.1)
        assert telemetry.rssi == -45
        assert telemetry.supervisor == hangar.info()
        assert telemetry.link_quality > 0.9
        truth = hangar.fleet.true_state(0)
        np.testing.assert_allclose(telemetry.state.position, truth.position, atol=0.03)
        np.testing.assert_allclose(telemetry.state.velocity, truth.velocity, atol=0.1)
        np.testing.assert_allclose(telemetry.state.quaternion, truth.quaternion, atol=0.02)
        np.testing.assert_allclose(telemetry.state.angular_velocity, 0.0, atol=0.2)
        assert backend.supervisor(1).flying
        assert not backend.supervisor(1).locked

    def test_chosen_rates(self, world):
        _, backend = world(options=RadioOptions(state_rate=50.0, health_rate=0.0), fed=False)
        before = backend.statistics(1).log_packets
        start = time.perf_counter()
        time.sleep(1.0)
        count = backend.statistics(1).log_packets - before
        # The estimate, and the body rates as often.
        assert count / (time.perf_counter() - start) == pytest.approx(2 * 50, rel=0.3)
        assert backend.telemetry(1).battery is None
        with pytest.raises(InputError, match="state_rate"):
            RadioOptions(state_rate=1000.0)

    def test_loss_of_the_downlink_shows_in_the_log_packets(self, world):
        hangar, backend = world(options=RadioOptions(state_rate=100.0), fed=False)
        hangar.server.set_faults(loss=0.2)
        time.sleep(2.0)
        statistics = backend.statistics(1)
        assert 0.08 < statistics.downlink_loss < 0.35


class TestUploads:
    pieces = np.zeros((3, 33))
    pieces[:, 0] = 1.0
    pieces[:, 17] = 0.5

    def test_acknowledged(self, world):
        hangar, backend = world(fed=False)
        backend.upload_trajectory(1, 4, 2, self.pieces)
        memory = hangar.fleet.trajectories[0][2 * 132 : 5 * 132].tobytes()
        rows = np.frombuffer(memory, "<f4").reshape(3, 33)
        np.testing.assert_array_equal(rows[:, -1], 1.0)
        np.testing.assert_array_equal(rows[:, 16], 0.5)
        (event,) = events(backend, TrajectoryUploaded)
        assert event.trajectory_id == 4

    def test_refused(self, world):
        _, backend = world(fed=False)
        with pytest.raises(CommandError, match="31 pieces"):
            backend.upload_trajectory(1, 4, 30, self.pieces)
        with pytest.raises(BackendError, match="cf1: uploadTrajectory 200: refused"):
            backend.upload_trajectory(1, 200, 0, self.pieces)

    def test_not_acknowledged(self, world):
        hangar, backend = world(options=RadioOptions(upload_timeout=0.5), fed=False)
        hangar.server.cut(2.0)
        with pytest.raises(BackendError, match=r"cf1: uploadTrajectory 4: .* within 0\.5 s"):
            backend.upload_trajectory(1, 4, 0, self.pieces)

    def test_in_the_background(self, world):
        _, backend = world(fed=False)
        before = time.perf_counter()
        backend.send(c.UploadTrajectory(1, 0, self.pieces), 1)
        assert time.perf_counter() - before < 0.1
        eventually(lambda: events(backend, TrajectoryUploaded), 5.0)


class TestRefusals:
    def test_a_command_that_the_vehicle_refuses_is_reported(self, world):
        hangar, backend = world(fed=False)
        backend.send(c.Emergency(), 1)
        eventually(lambda: hangar.info() & LOCKED, 5.0)
        backend.send(c.Takeoff(1.0, 1.0), 1)
        (event,) = events(backend, CommandLost)
        assert (event.verb, event.reason) == ("takeoff", "emergency stop")

    def test_the_answer_of_an_unready_vehicle(self, world):
        hangar, backend = world(fed=False)
        # Disarmed: the supervisor does not let it fly.
        backend.send(c.Arm(False), 1)
        eventually(lambda: not hangar.info() & 2, 5.0)
        backend.send(c.Takeoff(1.0, 1.0), 1)
        eventually(lambda: backend.statistics(1).lanes[Lane.COMMAND].sent >= 1, 5.0)
        time.sleep(0.3)
        refused = events(backend, CommandRefused)
        if not refused:  # it armed itself again, as a vehicle with automatic arming does
            assert hangar.info() & 2
        else:
            assert (refused[0].verb, refused[0].code) == ("takeoff", 16)


class TestGroups:
    def test_only_members_follow(self, world):
        hangar, backend = world(2)
        backend.prepare()
        backend.send(c.SetGroupMask(2), 2)
        backend.send(c.SetParam("hlCommander.groupmask", 1), 1)
        eventually(lambda: hangar.fleet.get_param(1, "hlCommander.groupmask") == 2, 5.0)
        backend.send(c.Takeoff(0.5, 1.0, group_mask=2))
        time.sleep(1.5)
        assert hangar.position(1)[2] < 0.1
        assert hangar.position(2)[2] == pytest.approx(0.5, abs=0.1)


class TestPoses:
    def test_rate_limited_newest_wins_never_a_queue(self, world):
        options = RadioOptions(outbox=OutboxOptions(extpose_rate=50.0))
        hangar, backend = world(options=options, fed=False)
        before = backend.statistics(1).lanes[Lane.EXTPOSE].sent
        start = backend.clock.now()
        for k in range(300):
            backend.send_external_poses({1: Pose(np.array([1e-3 * k, 0.0, 0.0]))})
            backend.clock.sleep_until(start + (k + 1) / 300)
        elapsed = backend.clock.now() - start
        statistics = backend.statistics(1).lanes[Lane.EXTPOSE]
        assert (statistics.sent - before) / elapsed == pytest.approx(50, rel=0.2)
        assert statistics.overwritten > 150
        assert statistics.max_age < 0.2
        flight = hangar.server.swarm.vehicles[0].flight
        eventually(lambda: flight.measured is not None and flight.measured[0][0] > 0.29, 5.0)

    def test_packed_and_peers(self, world):
        hangar, backend = world(2, options=RadioOptions(poses="packed"), fed=False)
        backend._links[1].hears_peers = True
        heard = []
        flight = hangar.server.swarm.vehicles[0].flight
        flight.peer_position = lambda peer, position: heard.append((peer, position))
        backend.send_external_poses({1: Pose(np.zeros(3)), 2: Pose(np.array([1.0, 2.0, 3.0]))})
        eventually(lambda: heard, 5.0)
        assert heard[0][0] == 2
        assert heard[0][1] == pytest.approx((1.0, 2.0, 3.0))
        assert flight.measured is not None

    def test_positions_alone(self, world):
        hangar, backend = world(fed=False)
        backend.send_external_positions({1: np.array([0.1, 0.2, 0.0])})
        flight = hangar.server.swarm.vehicles[0].flight
        eventually(lambda: flight.measured is not None, 5.0)
        position, attitude = flight.measured
        assert position == pytest.approx((0.1, 0.2, 0.0))
        assert attitude is None


def test_motors_and_accelerometer_are_told_where_they_are_asked_for():
    """Through the telemetry of the backend, as whoever records a flight reads it."""
    fleet = ArenaFleet([(0.0, 0.0, 0.0)])
    fleet.advance(1)
    with VirtualServer(VirtualSwarm(fleet), port=0) as server:
        config = VehicleConfig(1, "cf1", (0.0, 0.0, 0.0), uri=server.uris[0])
        options = RadioOptions(plant_rate=50.0, cache=None)
        backend = RadioBackend(FleetConfig((config,), "test"), WallClock(), options)
        try:
            end = time.monotonic() + 10.0
            told = backend.telemetry(1)
            # The accelerometer's filter has to settle after boot.
            while (
                told.acceleration is None
                or told.acceleration[2] < 0.96
                or not told.link_quality
                or told.supervisor is None
            ):
                assert time.monotonic() < end, told
                time.sleep(0.02)
                told = backend.telemetry(1)
        finally:
            backend.close()
    assert told.motors.shape == (4,)
    assert told.acceleration == pytest.approx([0.0, 0.0, 1.0], abs=0.05)
    assert 3.0 < told.battery < 4.3
    assert told.supervisor is not None


class TestCollisionAvoidance:
    def test_the_parameter_alone_lets_a_vehicle_hear_the_others(self, world):
        # Crazyswarm2 has no call for it.
        _, backend = world(2, fed=False)
        backend.send(c.SetParam("colAv.enable", 1), 1)
        assert [backend._links[k].hears_peers for k in (1, 2)] == [True, False]
        backend.set_param(1, "colAv.enable", 0)
        assert not backend._links[1].hears_peers

    def test_two_vehicles_that_fly_at_each_other_over_the_air_keep_apart(self, world):
        hangar, backend = world(2)
        backend.prepare()
        backend.send(c.Takeoff(0.6, 1.5))
        eventually(lambda: min(hangar.position(k)[2] for k in (1, 2)) > 0.5, 10.0)
        backend.send(c.CollisionAvoidance(True, radii=(0.15, 0.15, 0.45)))
        eventually(lambda: hangar.fleet.get_param(1, "colAv.enable") == 1, 5.0)
        assert hangar.fleet.get_param(0, "colAv.ellipsoidZ") == pytest.approx(0.45)
        first, second = hangar.position(1).copy(), hangar.position(2).copy()
        backend.send(c.GoTo(second, 0.0, 3.0), 1)
        backend.send(c.GoTo(first, 0.0, 3.0), 2)
        nearest = np.inf
        deadline = time.monotonic() + 5.0
        while time.monotonic() < deadline:
            gap = hangar.position(1) - hangar.position(2)
            nearest = min(nearest, float(np.linalg.norm(gap / np.array([0.15, 0.15, 0.45]))))
            time.sleep(0.02)
        assert nearest > 1.6  # 2 is touching ellipsoids; head on it would be 0
