"""Flights of virtual vehicles over UDP through the radio backend."""

import math
import os
import signal
import subprocess
import sys
import textwrap
import time

import numpy as np
import pytest

from crazyarena.clock import WallClock
from crazyarena.crazyswarm_compat import commands as c
from crazyarena.crazyswarm_compat.crazyswarm1 import Crazyswarm
from crazyarena.crazyswarm_compat.radio import (
    CommandLost,
    Lane,
    Preparation,
    RadioBackend,
    RadioOptions,
    StreamEnded,
)
from tests.crazyswarm_compat.radio.conftest import Hangar, stream
from tests.waiting import eventually

FLYING, LOCKED = 1 << 4, 1 << 6
YAML = "crazyflies:\n- {id: 1, channel: 80, initialPosition: [0, 0, 0]}\n"
RATE = 30.0


def circle(t):
    """Full state on a circle of 0.5 m around the origin at 1 m, from (0.5, 0), starting slowly."""
    ramp = 1.0 - math.exp(-t)
    angle = 0.8 * (t - ramp)
    w, a = 0.8 * ramp, 0.8 * (1.0 - ramp)
    co, si = math.cos(angle), math.sin(angle)
    pos = [0.5 * co, 0.5 * si, 1.0]
    vel = [-0.5 * w * si, 0.5 * w * co, 0.0]
    acc = [0.5 * (-a * si - w * w * co), 0.5 * (a * co - w * w * si), 0.0]
    return c.FullState(pos, vel, acc, 0.0, [0.0, 0.0, 0.0])


def moving(x, speed):
    """Full state at (x, 0, 0.8) that moves along x."""
    return c.FullState([x, 0.0, 0.8], [speed, 0.0, 0.0], np.zeros(3), 0.0, np.zeros(3))


def script(swarm):
    """High level, stream, high level again; returns positions (n, 3) at 30 Hz."""
    helper, cf = swarm.timeHelper, swarm.allcfs.crazyflies[0]
    path = []

    def fly(duration):
        for _ in range(round(duration * RATE)):
            path.append(np.array(cf.position()))
            helper.sleepForRate(RATE)

    cf.takeoff(1.0, 2.0)
    fly(2.5)
    cf.goTo([0.5, 0.0, 1.0], 0.0, 2.0)
    fly(2.5)
    for k in range(round(3.0 * RATE)):
        m = circle(k / RATE)
        cf.cmdFullState(m.position, m.velocity, m.acceleration, m.yaw, m.omega)
        path.append(np.array(cf.position()))
        helper.sleepForRate(RATE)
    cf.notifySetpointsStop()
    cf.goTo([0.0, 0.0, 0.8], 0.5, 2.0)
    fly(2.5)
    cf.land(0.02, 2.0)
    fly(2.5)
    return np.array(path)


@pytest.mark.slow
def test_the_same_script_flies_the_same_path_in_simulation_and_over_the_radio(world):
    simulated = script(Crazyswarm(YAML, args="--backend sim --vis null --dt 0.001"))
    hangar, backend = world()
    backend.close()
    with pytest.warns(UserWarning, match="no --mocap"):
        swarm = Crazyswarm(YAML, args=f"--backend radio --uri {hangar.uris[0]}")
    link = swarm.allcfs._backend
    hangar.feed(link)
    link.prepare()
    flown = script(swarm)
    assert not [e for e in link.take_events() if isinstance(e, (CommandLost, StreamEnded))]
    swarm.allcfs.close()
    error = math.sqrt(np.mean(np.sum((flown - simulated) ** 2, axis=1)))
    print(f"RMSE {error:.4f} m")
    assert error < 0.05, f"RMSE {error:.4f} m"
    # It did fly, and landed.
    assert np.ptp(flown[:, 0]) > 0.5
    assert flown[:, 2].max() > 0.9
    assert hangar.position(1)[2] < 0.05


class TestHandOver:
    """What the API user never meets."""

    def test_a_stream_that_stops_is_held(self, world):
        hangar, backend = world()
        backend.prepare()
        backend.send(c.Takeoff(0.8, 1.5))
        time.sleep(1.8)
        stream(
            backend, lambda t: c.FullState([0.4 * t, 0, 0.8], [0.4, 0, 0], [0] * 3, 0, [0] * 3), 1.5
        )
        time.sleep(3.0)
        assert not hangar.info() & LOCKED
        assert hangar.priority() == 1
        assert np.linalg.norm(hangar.position(1) - [0.65, 0.0, 0.8]) < 0.3
        (event,) = [e for e in backend.take_events() if isinstance(e, StreamEnded)]
        assert event.action == "hold"
        # The high-level commander has it: landing needs nothing more.
        backend.send(c.Land(0.0, 1.5))
        time.sleep(2.2)
        assert hangar.position(1)[2] < 0.05
        assert not hangar.info() & LOCKED

    @pytest.mark.slow
    def test_a_stream_that_ends_on_the_ground_leaves_the_vehicle_unlocked(self, world):
        hangar, backend = world()
        backend.prepare()
        backend.send(c.Takeoff(0.4, 1.0))
        time.sleep(1.3)
        stream(backend, lambda t: c.Position([0.0, 0.0, max(0.02, 0.4 - 0.3 * t)]), 1.5)
        stream(backend, lambda t: c.CutMotors(), 0.2)
        time.sleep(3.0)
        assert not hangar.info() & LOCKED
        assert hangar.priority() == 1
        # So it can start again.
        backend.send(c.Takeoff(0.4, 1.0))
        time.sleep(1.5)
        assert hangar.position(1)[2] == pytest.approx(0.4, abs=0.1)

    def test_a_predecessor_that_streamed(self, world):
        """A client that closes as cflib does leaves a setpoint behind."""
        hangar, backend = world()
        backend.prepare()
        stream(backend, lambda t: c.CutMotors(), 0.1)
        assert hangar.priority() == 2
        backend.close()
        successor = RadioBackend(
            hangar.config(), WallClock(), RadioOptions(cache=backend.options.cache)
        )
        try:
            hangar.feed(successor)
            if hangar.info() & LOCKED:
                hangar.server.reboot()
            successor.prepare()
            stream_left = hangar.server.swarm.vehicles[0]
            stream_left.receive(bytes.fromhex("3c") + bytes(14))
            successor.send(c.Takeoff(0.5, 1.0))
            time.sleep(1.5)
            assert hangar.position(1)[2] == pytest.approx(0.5, abs=0.1)
        finally:
            successor.close()


class TestStops:
    def test_emergency_stop_in_flight_overtakes_all_traffic(self, world):
        hangar, backend = world()
        backend.prepare()
        backend.send(c.Takeoff(0.8, 1.5))
        time.sleep(1.8)
        for k in range(200):
            backend.send(c.SetParam("ring.effect", k % 10), 1)
        before = time.monotonic()
        backend.send(c.Emergency())
        eventually(lambda: hangar.info() & LOCKED, 1.0)
        assert time.monotonic() - before < 0.5
        statistics = backend.statistics(1).lanes[Lane.EMERGENCY]
        eventually(lambda: backend.statistics(1).lanes[Lane.EMERGENCY].sent >= 15, 5.0)
        assert statistics.max_age < 0.1
        # Nothing brings it back.
        backend.send(c.Takeoff(0.8, 1.5))
        time.sleep(1.0)
        assert hangar.position(1)[2] < 0.1

    def test_emergency_stop_through_a_bad_link(self, world):
        hangar, backend = world()
        backend.prepare()
        hangar.server.set_faults(loss=0.5)
        backend.send(c.Emergency())
        eventually(lambda: hangar.info() & LOCKED, 1.0)

    def test_the_watchdog_fires_when_it_is_not_fed(self, world):
        hangar, backend = world()
        backend.prepare()
        backend.arm_watchdog()
        for _ in range(15):
            time.sleep(0.1)
            backend.feed_watchdog()
        assert not hangar.info() & LOCKED
        eventually(lambda: hangar.info() & LOCKED, 2.0)


GROUND = """
    import sys, time
    from crazyarena.clock import WallClock
    from crazyarena.crazyswarm_compat import commands as c
    from crazyarena.crazyswarm_compat.config import FleetConfig, VehicleConfig
    from crazyarena.crazyswarm_compat.radio import Preparation, RadioBackend, RadioOptions
    from pathlib import Path

    uri, cache, mode = sys.argv[1:]
    fleet = FleetConfig((VehicleConfig(1, "cf1", (0, 0, 0), uri=uri),), "test")
    backend = RadioBackend(fleet, WallClock(), RadioOptions(cache=Path(cache)))
    backend.prepare(Preparation(needs_pose=False))
    if mode == "watchdog":
        backend.arm_watchdog(feed_period=0.1)
    backend.send(c.Takeoff(0.8, 1.5))
    time.sleep(2.0)
    if mode == "stream":
        for _ in range(30):
            backend.send(c.Position([0, 0, 0.8]))
            time.sleep(0.033)
    print("flying", flush=True)
    while True:
        if mode == "stream":
            backend.send(c.Position([0, 0, 0.8]))
        time.sleep(0.033)
"""


class TestKilledGround:
    """The ground process dies by SIGKILL in flight."""

    @pytest.fixture
    def ground(self, toc_cache):
        """Kill a ground process in flight; returns the hangar and the time of death."""
        hangar = Hangar(1, 0, feed_rate=100.0)
        processes = []

        def fly_and_kill(mode):
            code = textwrap.dedent(GROUND)
            process = subprocess.Popen(
                [sys.executable, "-c", code, hangar.uris[0], str(toc_cache), mode],
                stdout=subprocess.PIPE,
            )
            processes.append(process)
            assert process.stdout.readline() == b"flying\n"
            assert hangar.info() & FLYING
            os.kill(process.pid, signal.SIGKILL)
            process.wait()
            return hangar, time.monotonic()

        yield fly_and_kill
        for process in processes:
            process.kill()
            process.wait()
            process.stdout.close()
        hangar.close()

    def test_the_vehicle_stops_its_motors_by_its_own_watchdog(self, ground):
        hangar, died = ground("watchdog")
        eventually(lambda: hangar.info() & LOCKED, 3.0)
        assert 0.7 < time.monotonic() - died < 1.5
        time.sleep(1.0)
        assert hangar.position(1)[2] < 0.1

    def test_a_stream_that_dies_is_levelled_and_shut_down(self, ground):
        hangar, died = ground("stream")
        time.sleep(max(0.0, died + 1.5 - time.monotonic()))
        assert not hangar.info() & LOCKED
        eventually(lambda: hangar.info() & LOCKED, 2.0)
        assert 1.7 < time.monotonic() - died < 2.6

    @pytest.mark.slow
    def test_without_watchdog_the_high_level_commander_flies_on(self, ground):
        """Why the watchdog is worth arming."""
        hangar, _ = ground("high level")
        time.sleep(3.0)
        assert not hangar.info() & LOCKED
        assert hangar.position(1)[2] == pytest.approx(0.8, abs=0.15)


@pytest.mark.slow
def test_twenty_seconds_of_full_state_over_a_bad_link(world):
    """5 % loss and 8 ms latency each way."""
    hangar, backend = world()
    backend.prepare(Preparation(controller=2))
    backend.send(c.Takeoff(1.0, 2.0))
    time.sleep(2.5)
    backend.send(c.GoTo([0.5, 0.0, 1.0], 0.0, 2.0))
    time.sleep(2.5)
    hangar.server.set_faults(loss=0.05, latency=0.008)
    link = hangar.server.links[0]
    lost_before = link.uplink.counters.lost
    carried_before = link.uplink.counters.carried
    before = backend.statistics(1)
    sent_before = before.lanes[Lane.SETPOINT].sent
    errors = []
    for k in range(600):
        target = circle(k / RATE)
        backend.send(target, 1)
        errors.append(np.linalg.norm(hangar.position(1) - target.position))
        time.sleep(1.0 / RATE)
    statistics = backend.statistics(1)
    backend.send(c.NotifySetpointsStop(), 1)
    backend.send(c.Land(0.02, 2.0), 1)
    time.sleep(2.8)
    assert hangar.position(1)[2] < 0.05
    assert not hangar.info() & LOCKED
    assert max(errors) < 0.5
    assert statistics.lanes[Lane.SETPOINT].sent - sent_before == pytest.approx(600, abs=5)
    # What was lost shows, in both directions.
    true_loss = (link.uplink.counters.lost - lost_before) / (
        link.uplink.counters.carried - carried_before
    )
    sent = statistics.uplink_sent - before.uplink_sent
    told_loss = 1.0 - (statistics.uplink_arrived - before.uplink_arrived) / sent
    print(f"lost {true_loss:.3f}, told {told_loss:.3f}, RMS {np.mean(np.square(errors)) ** 0.5}")
    assert 0.02 < true_loss < 0.08
    assert told_loss == pytest.approx(true_loss, abs=0.02)
    assert 0.02 < statistics.downlink_loss < 0.09
    assert statistics.latency_p50 > 0.014
