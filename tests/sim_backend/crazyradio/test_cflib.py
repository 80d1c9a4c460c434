"""cflib's public calls over ``radio://``, with vehicles in a process of their own."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import threading

import cflib.crtp
import numpy as np
import pytest
from cflib.crazyflie import Crazyflie
from cflib.crazyflie.log import LogConfig
from cflib.crazyflie.mem import MemoryElement, Poly4D
from cflib.crazyflie.swarm import CachedCfFactory, Swarm
from cflib.crazyflie.syncCrazyflie import SyncCrazyflie
from cflib.crazyflie.syncLogger import SyncLogger
from cflib.positioning.motion_commander import MotionCommander
from cflib.utils.power_switch import PowerSwitch

from crazyarena.sim_backend.crazyradio.remote import RemoteAir
from crazyarena.sim_backend.crazyradio.usb_backend import install
from tests.sim_backend.crtp.virtual_process import virtual_process
from tests.waiting import eventually

LOCKED = 1 << 6
COUNT = 4
SECOND = 0xE7E7E7E702


@pytest.fixture(scope="module")
def vehicles():
    """Four vehicles, two on each of two channels, and two dongles in this process."""
    options = ("--radio", "--radio-port", "0", "--count", str(COUNT), "--channel", "80,90")
    with virtual_process(*options, "--dongles", "2", "--feed-poses", "100") as process:
        undo = install(RemoteAir(process.air))
        cflib.crtp.init_drivers()
        yield process
        undo()


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return str(tmp_path_factory.mktemp("toc"))


@pytest.fixture
def scf(vehicles, cache):
    """A connection to the first vehicle, which has just booted."""
    vehicles.command("reboot")
    vehicles.command("loss 0%")
    connection = SyncCrazyflie(vehicles.uris[0], cf=Crazyflie(rw_cache=cache))
    eventually(lambda: opened(connection))
    try:
        connection.wait_for_params()
        eventually(lambda: connection.cf.supervisor.can_fly)
        yield connection
    finally:
        connection.close_link()


def opened(connection):
    """Try to connect; a vehicle that boots does not answer for two seconds."""
    with contextlib.suppress(Exception):  # cflib's own, "Too many packets lost"
        connection.open_link()
    return connection.is_link_open()


def height(scf, wanted, tolerance=0.1):
    """Wait until the vehicle says that it is so high."""
    config = LogConfig("height", 20)
    config.add_variable("stateEstimate.z", "float")
    with SyncLogger(scf, config) as logger:
        for _, data, _ in logger:
            if abs(data["stateEstimate.z"] - wanted) < tolerance:
                return


def test_scan(vehicles):
    found = cflib.crtp.scan_interfaces(SECOND)
    assert [uri for uri, _ in found if uri.startswith("radio")] == ["radio://0/90/2M/E7E7E7E702"]
    assert vehicles.uris[1] == "radio://1/90/2M/E7E7E7E702"
    nobody = cflib.crtp.scan_interfaces(0xE7E7E7E799)
    assert not [uri for uri, _ in nobody if uri.startswith("radio")]


def test_tables_without_a_cache(vehicles):
    with SyncCrazyflie(vehicles.uris[1], cf=Crazyflie()) as connection:
        connection.wait_for_params()
        names = connection.cf.param.toc.toc
        assert sum(map(len, names.values())) == sum(map(len, connection.cf.param.values.values()))
        assert sum(map(len, names.values())) > 250
        assert sum(map(len, connection.cf.log.toc.toc.values())) > 400


def test_parameters_and_log(scf):
    seen = threading.Event()
    scf.cf.param.add_update_callback("ctrlMel", "kp_xy", lambda *_: seen.set())
    scf.cf.param.set_value("ctrlMel.kp_xy", 0.55)
    assert seen.wait(5.0)
    assert float(scf.cf.param.get_value("ctrlMel.kp_xy")) == pytest.approx(0.55)
    config = LogConfig("battery", 10)
    config.add_variable("pm.vbat", "float")
    stamps = []
    with SyncLogger(scf, config) as logger:
        for stamp, _, _ in logger:
            stamps.append(stamp)
            if len(stamps) == 100:
                break
    assert np.diff(stamps) == pytest.approx(np.full(99, 10), abs=3)


def test_motion_commander(scf):
    with MotionCommander(scf, default_height=0.4) as commander:
        commander.forward(0.3, velocity=0.4)
        height(scf, 0.4)
    height(scf, 0.0)


def test_trajectory(scf):
    """Up by 0.6 m within a second, as one polynomial with rest at both ends."""
    # 35 t⁴ - 84 t⁵ + 70 t⁶ - 20 t⁷ goes from 0 to 1.
    rise = [0.0] * 4 + [0.6 * value for value in (35.0, -84.0, 70.0, -20.0)]
    still = [0.0] * 8
    memory = scf.cf.mem.get_mems(MemoryElement.TYPE_TRAJ)[0]
    memory.trajectory = [
        Poly4D(
            1.0,
            Poly4D.Poly(still),
            Poly4D.Poly(still),
            Poly4D.Poly(rise),
            Poly4D.Poly(still),
        )
    ]
    assert memory.write_data_sync()
    commander = scf.cf.high_level_commander
    commander.define_trajectory(1, 0, 1)
    commander.takeoff(0.4, 1.0)
    height(scf, 0.4)
    commander.start_trajectory(1, 1.0, relative_position=True)
    height(scf, 1.0)
    commander.land(0.0, 1.5)
    height(scf, 0.0)
    commander.stop()


def test_swarm_of_four_on_one_dongle(vehicles, cache):
    vehicles.command("reboot")
    first = SyncCrazyflie(vehicles.uris[0], cf=Crazyflie(rw_cache=cache))
    eventually(lambda: opened(first))
    first.close_link()
    # The second dongle stays unused: the first changes its channel for every other packet.
    uris = {uri.replace("radio://1", "radio://0") for uri in vehicles.uris}
    heights = {}

    def fly(scf):
        eventually(lambda: scf.cf.supervisor.can_fly)
        commander = scf.cf.high_level_commander
        commander.takeoff(0.5, 1.0)
        height(scf, 0.5)
        heights[scf.cf.link_uri] = 0.5
        commander.land(0.0, 1.0)
        height(scf, 0.0)
        commander.stop()

    with Swarm(uris, factory=CachedCfFactory(rw_cache=cache)) as swarm:
        swarm.parallel_safe(fly)
    assert set(heights) == uris


def test_emergency_stop(scf, vehicles):
    scf.cf.high_level_commander.takeoff(0.5, 1.0)
    height(scf, 0.5)
    scf.cf.supervisor.send_emergency_stop()
    eventually(lambda: scf.cf.supervisor.is_locked)
    height(scf, 0.0)


def test_a_vehicle_switched_off_and_on_over_the_radio(scf, vehicles, cache):
    lost = threading.Event()
    scf.cf.connection_lost.add_callback(lambda *_: lost.set())
    scf.cf.high_level_commander.takeoff(0.5, 1.0)
    height(scf, 0.5)
    scf.close_link()
    PowerSwitch(vehicles.uris[0]).stm_power_cycle()
    with SyncCrazyflie(vehicles.uris[0], cf=Crazyflie(rw_cache=cache)) as connection:
        height(connection, 0.0)  # without power it fell
        assert not connection.cf.supervisor.is_flying


def test_out_of_range_is_told(scf, vehicles):
    lost = []
    scf.cf.connection_lost.add_callback(lambda _, why: lost.append(why))
    vehicles.command("cf1 cut 3s")
    eventually(lambda: lost)
    assert lost == ["Too many packets lost"]


def test_two_programs_cannot_have_one_dongle(scf, vehicles):
    program = (
        "import usb.core\n"
        "from cflib.drivers.crazyradio import Crazyradio\n"
        "try:\n    Crazyradio(devid=0)\n"
        "except usb.core.USBError as error:\n    print(error.errno)\n"
        "print(Crazyradio(devid=1).version)\n"
    )
    command = [sys.executable, "-m", "crazyarena", "with-virtual-radio", "--air", vehicles.air]
    done = subprocess.run(
        [*command, "--", sys.executable, "-c", program], capture_output=True, text=True, timeout=60
    )
    assert done.stdout.split() == ["16", "0.53"]


def test_a_program_gets_its_own_vehicles_and_its_exit_code_is_passed_on():
    program = (
        "import sys, cflib.crtp; from cflib.crazyflie.syncCrazyflie import SyncCrazyflie\n"
        "cflib.crtp.init_drivers()\n"
        "with SyncCrazyflie('radio://0/40/1M/E7E7E7E702') as scf:\n"
        "    print(scf.cf.platform.get_protocol_version())\n"
        "sys.exit(7)\n"
    )
    command = [sys.executable, "-m", "crazyarena", "with-virtual-radio", "--count", "2"]
    done = subprocess.run(
        [*command, "--channel", "40", "--rate", "1M", "--", sys.executable, "-c", program],
        capture_output=True,
        text=True,
        timeout=240,
    )
    assert done.stdout.split() == ["12"]
    assert done.returncode == 7


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--channel", "126"], "--channel"),
        (["--rate", "3M"], "--rate"),
        (["--dongles", "0"], "--dongles"),
        (["--air", "nowhere"], "--air"),
    ],
)
def test_wrong_options(options, words):
    command = [sys.executable, "-m", "crazyarena", "with-virtual-radio", *options]
    done = subprocess.run([*command, "--", "true"], capture_output=True, text=True, timeout=240)
    assert done.returncode == 2
    assert words in done.stderr
