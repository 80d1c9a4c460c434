"""The radio backend over virtual dongles: vehicles in a process of their own."""

import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from crazyarena.clock import WallClock
from crazyarena.crazyswarm_compat import commands as c
from crazyarena.crazyswarm_compat.config import FleetConfig, VehicleConfig
from crazyarena.crazyswarm_compat.radio import (
    LinkLost,
    LinkUp,
    RadioBackend,
    RadioOptions,
    VehicleRestarted,
)
from crazyarena.errors import BackendError
from crazyarena.sim_backend.crazyradio.environment import with_dongles
from crazyarena.sim_backend.crazyradio.remote import RemoteAir
from crazyarena.sim_backend.crazyradio.usb_backend import install
from crazyarena.types import Pose
from tests.sim_backend.crtp.virtual_process import virtual_process
from tests.waiting import eventually

ROOT = Path(__file__).resolve().parents[3]
COUNT = 4


@pytest.fixture(scope="module")
def vehicles():
    options = ("--radio", "--radio-port", "0", "--count", str(COUNT))
    with virtual_process(*options) as process:
        undo = install(RemoteAir(process.air))
        yield process
        undo()


@pytest.fixture
def connected(vehicles, toc_cache):
    """Factory: a backend for the first vehicles, just booted, on a perfect link."""
    backends = []
    for line in ("plug 0", "loss 0%", "latency 0ms", "reboot"):
        vehicles.command(line)
    time.sleep(2.1)

    def make(count=1, **options):
        fleet = FleetConfig(
            tuple(
                VehicleConfig(k + 1, f"cf{k + 1}", (0.0, 0.5 * k, 0.0), uri=vehicles.uris[k])
                for k in range(count)
            ),
            "test",
        )
        backend = RadioBackend(fleet, WallClock(), RadioOptions(cache=toc_cache, **options))
        backends.append(backend)
        return backend

    yield make
    for backend in backends:
        backend.close()


def feed(backend, stop):
    """Poses of vehicles that stand where they started."""

    def run():
        while not stop.wait(0.01):
            poses = {k: Pose(np.array([0.0, 0.5 * (k - 1), 0.01])) for k in backend.vehicles}
            backend.send_external_poses(poses)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    return thread


def all_locked(backend):
    states = [backend.supervisor(k) for k in backend.vehicles]
    return all(state is not None and state.locked for state in states)


def test_poses_of_four_vehicles_are_broadcast_and_each_finds_its_own(connected):
    backend = connected(4)
    stop = threading.Event()
    feeder = feed(backend, stop)
    try:

        def placed():
            states = [backend.telemetry(k).state for k in backend.vehicles]
            return all(
                state is not None and abs(state.position[1] - 0.5 * k) < 0.05
                for k, state in enumerate(states)
            )

        eventually(placed)
    finally:
        stop.set()
        feeder.join()
    driver = backend._links[1].client.link
    assert driver.dongle.statistics.broadcasts > 1
    assert not [e for e in backend.take_events() if isinstance(e, LinkLost)]


def test_emergency_stop_of_all(connected):
    backend = connected(4)
    backend.send(c.Emergency())
    eventually(lambda: all_locked(backend))


def test_a_reboot_is_an_outage_and_the_backend_comes_back(connected, vehicles):
    backend = connected(1, reconnect=True, reconnect_interval=0.5)
    eventually(lambda: backend.telemetry(1).supervisor is not None)
    vehicles.command("reboot")
    eventually(lambda: any(isinstance(e, LinkLost) for e in backend._events._events))
    lost = [e for e in backend.take_events() if isinstance(e, LinkLost)]
    assert "nothing heard" in lost[0].reason or "too many packets lost" in lost[0].reason
    eventually(lambda: backend.connected(1))
    events = []

    def restarted():
        events.extend(backend.take_events())
        return [e for e in events if isinstance(e, VehicleRestarted)]

    eventually(restarted)
    assert [e for e in events if isinstance(e, LinkUp)]
    assert len(restarted()) == 1


def test_an_unplugged_dongle_is_named_and_plugged_in_again_it_goes_on(connected, vehicles):
    backend = connected(1, reconnect=True, reconnect_interval=0.5)
    vehicles.command("unplug 0")
    events = []
    eventually(lambda: events.extend(backend.take_events()) or not backend.connected(1))
    reasons = [e.reason for e in events if isinstance(e, LinkLost)]
    assert reasons == ["Crazyradio 0 does not answer any more: was it unplugged?"]
    vehicles.command("plug 0")
    eventually(lambda: backend.connected(1))


def test_no_dongle_and_nobody_there_are_told_apart(connected, vehicles):
    vehicles.command("unplug 0")
    with pytest.raises(BackendError, match="Cannot find a Crazyradio Dongle"):
        connected(1)
    vehicles.command("plug 0")
    vehicles.command("cf1 cut 20s")
    with pytest.raises(BackendError, match=r"cf1 .*no answer"):
        connected(1, connect_timeout=3.0)
    vehicles.command("cut 0s")


def test_nothing_is_left_when_it_is_closed(connected, vehicles):
    before = threading.active_count()
    for _ in range(3):
        backend = connected(3)
        backend.close()
    # The threads that cflib starts end within a second of the link.
    eventually(lambda: threading.active_count() <= before)
    program = "from cflib.drivers.crazyradio import Crazyradio; print(Crazyradio().version)"
    done = subprocess.run(
        [sys.executable, "-c", program],
        env=with_dongles(vehicles.air),
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.stdout.strip() == "0.53", done.stderr


@pytest.mark.parametrize(
    "happens", ["unplug 0", "cf1 cut 60s", "cf1 reboot", "loss 20%", "latency 50ms"]
)
def test_nothing_is_left_whatever_has_happened(happens, connected, vehicles):
    before = threading.active_count()
    backend = connected(2, reconnect=True, reconnect_interval=0.2, link_timeout=0.5)
    vehicles.command(happens)
    if happens in ("unplug 0", "cf1 cut 60s", "cf1 reboot"):
        eventually(lambda: any(isinstance(e, LinkLost) for e in backend._events._events))
    else:
        eventually(lambda: (backend.statistics(1).latency_p50 or 0.0) > 0.0)
    backend.close()
    vehicles.command("cut 0s")
    eventually(lambda: threading.active_count() <= before, 30.0)


def test_another_program_may_have_the_dongle_afterwards(connected, vehicles):
    """Two clients: the second is told who is in its way, and the first does not notice."""
    backend = connected(1)
    program = (
        "from crazyarena.clock import WallClock\n"
        "from crazyarena.crazyswarm_compat.config import FleetConfig, VehicleConfig\n"
        "from crazyarena.crazyswarm_compat.radio import RadioBackend\n"
        f"cf = VehicleConfig(1, 'cf1', (0.0, 0.0, 0.0), uri={vehicles.uris[0]!r})\n"
        "RadioBackend(FleetConfig((cf,), 'test'), WallClock()).close()\n"
        "print('connected')\n"
    )

    def second():
        return subprocess.run(
            [sys.executable, "-c", program],
            env=with_dongles(vehicles.air),
            capture_output=True,
            text=True,
            timeout=120,
        )

    done = second()
    assert "Resource busy" in done.stderr
    assert "does no other program hold it?" in done.stderr
    assert backend.connected(1)
    assert not [e for e in backend.take_events() if isinstance(e, LinkLost)]
    backend.close()
    done = second()
    assert "connected" in done.stdout, done.stderr


def test_a_tenth_lost_is_only_slower(connected, vehicles):
    backend = connected(1)
    vehicles.command("loss 10%")
    time.sleep(2.0)
    backend.take_events()
    for value in (0.41, 0.42, 0.43):
        backend.set_param(1, "ctrlMel.kp_xy", value)
    statistics = backend.statistics(1)
    assert statistics.log_missed == 0
    assert statistics.round_trip_loss == 0.0
    assert backend.connected(1)


def test_fifty_milliseconds_each_way(connected, vehicles):
    vehicles.command("latency 50ms")
    backend = connected(1)
    eventually(lambda: backend.statistics(1).latency_p50 is not None)
    assert backend.statistics(1).latency_p50 > 0.1


def test_cflibs_own_driver_is_an_option(connected):
    backend = connected(2, driver="cflib")
    backend.send(c.Emergency())
    eventually(lambda: all_locked(backend))


@pytest.mark.parametrize("script", ["hover.py", pytest.param("figure8.py", marks=pytest.mark.slow)])
def test_examples_fly_over_the_virtual_dongle(script):
    """As a user starts them: two vehicles of the list beside the script."""
    options = ("--radio", "--radio-port", "0", "--count", "2", "--feed-poses", "100")
    with virtual_process(*options) as process:
        done = subprocess.run(
            [
                sys.executable,
                "-W",
                "ignore",
                str(ROOT / "examples" / "crazyswarm" / script),
            ],
            env=with_dongles(process.air),
            capture_output=True,
            text=True,
            timeout=240,
        )
    assert done.returncode == 0, done.stderr + done.stdout
