"""The stock client on the virtual Crazyflie: public calls of cflib only."""

from __future__ import annotations

import contextlib
import math
import random
import re
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

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
from cflib.positioning.position_hl_commander import PositionHlCommander

from crazyarena.sim_backend.crtp.toc import log_entries, param_entries
from tests.sim_backend.crtp.virtual_process import VirtualProcess, virtual_process
from tests.waiting import PATIENCE

_COUNT = 10
_PORTS = range(19850, 19850 + _COUNT)  # cflib scans these and no others


def _own_address() -> str:
    """An address of this machine on which nobody has the ports that cflib scans."""
    while True:
        address = f"127.{random.randint(1, 254)}.{random.randint(0, 254)}.{random.randint(1, 254)}"
        with contextlib.ExitStack() as stack, contextlib.suppress(OSError):
            for port in _PORTS:
                probe = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
                probe.bind((address, port))
            return address


_HOST = _own_address()


@pytest.fixture(scope="module", autouse=True)
def _drivers() -> None:
    cflib.crtp.init_drivers()


@pytest.fixture(scope="module")
def vehicles() -> Iterator[VirtualProcess]:
    options = ("--count", str(_COUNT), "--host", _HOST, "--feed-poses", "100")
    with virtual_process(*options) as process:
        yield process


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("toc")


@pytest.fixture
def scf(vehicles: VirtualProcess, cache: Path) -> Iterator[SyncCrazyflie]:
    """A connection to the first vehicle, which has just booted."""
    vehicles.command("reboot")
    with SyncCrazyflie(vehicles.uris[0], cf=Crazyflie(rw_cache=str(cache))) as connection:
        connection.wait_for_params()
        wait_until(lambda: connection.cf.supervisor.can_fly)
        yield connection
        if connection.cf.is_connected():
            wait_until(lambda: not connection.cf.supervisor.is_flying)


def wait_until(condition: Callable[[], Any], timeout: float = 20.0) -> None:
    end = time.monotonic() + PATIENCE * timeout
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.05)


class Estimate:
    """The last estimate a vehicle logged, and the highest and lowest point so far."""

    def __init__(self, cf: Crazyflie) -> None:
        self._config = LogConfig("estimate", 20)
        for axis in "xyz":
            self._config.add_variable(f"stateEstimate.{axis}", "float")
        self._config.add_variable("supervisor.info", "uint16_t")
        self.path: list[np.ndarray] = []
        self.info: list[tuple[int, int]] = []
        self._config.data_received_cb.add_callback(self._note)
        cf.log.add_config(self._config)
        self._config.start()
        wait_until(lambda: self.path)

    def _note(self, stamp: int, data: dict[str, float], _: object) -> None:
        self.path.append(np.array([data[f"stateEstimate.{axis}"] for axis in "xyz"]))
        self.info.append((stamp, int(data["supervisor.info"])))

    @property
    def position(self) -> np.ndarray:
        return self.path[-1]

    @property
    def top(self) -> float:
        return max(point[2] for point in self.path)


def test_scan_interfaces(vehicles: VirtualProcess, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SCAN_ADDRESS", _HOST)
    found = [uri for uri, _ in cflib.crtp.scan_interfaces() if uri.startswith("udp")]
    # cflib lists a vehicle once for each time that somebody in this process set up its drivers.
    assert list(dict.fromkeys(found)) == vehicles.uris


def test_full_toc_download_without_cache(vehicles: VirtualProcess) -> None:
    with SyncCrazyflie(vehicles.uris[1], cf=Crazyflie()) as connection:
        connection.wait_for_params()
        cf = connection.cf
        assert cf.platform.get_protocol_version() == 12
        assert sum(len(group) for group in cf.param.toc.toc.values()) == len(param_entries())
        assert sum(len(group) for group in cf.log.toc.toc.values()) == len(log_entries())
        assert sum(len(group) for group in cf.param.values.values()) == len(param_entries())
        assert cf.param.toc.get_element_by_complete_name("ctrlMel.kp_xy").is_persistent()
        assert float(cf.param.get_value("ctrlMel.kp_xy")) == pytest.approx(0.4)
        assert len(cf.mem.mems) == 8


def test_sync_logger(scf: SyncCrazyflie) -> None:
    config = LogConfig("test", 50)
    config.add_variable("pm.vbat", "float")
    config.add_variable("stateEstimateZ.z", "int16_t")
    config.add_variable("supervisor.info", "uint16_t")
    stamps = []
    with SyncLogger(scf, config) as logger:
        for stamp, data, _ in logger:
            stamps.append(stamp)
            assert 4.0 < data["pm.vbat"] <= 4.2
            assert abs(data["stateEstimateZ.z"] - 13) < 20
            if len(stamps) == 10:
                break
    assert np.diff(stamps) == pytest.approx(np.full(9, 50), abs=5)


def test_parameters_set_get_persist(scf: SyncCrazyflie) -> None:
    param = scf.cf.param
    seen: list[str] = []
    param.add_update_callback("ctrlMel", "kp_xy", lambda name, value: seen.append(value))
    param.set_value("ctrlMel.kp_xy", 0.55)
    wait_until(lambda: seen)
    assert float(param.get_value("ctrlMel.kp_xy")) == pytest.approx(0.55)

    answers: list[Any] = []

    def ask(call: Callable[..., None], name: str = "ctrlMel.kp_xy") -> Any:
        answers.clear()
        call(name, lambda _, answer: answers.append(answer))
        wait_until(lambda: answers)
        return answers[0]

    assert ask(param.persistent_get_state).is_stored is False
    assert ask(param.persistent_store) is True
    state = ask(param.persistent_get_state)
    assert state.is_stored
    assert (state.default_value, state.stored_value) == pytest.approx((0.4, 0.55))
    assert ask(param.get_default_value) == pytest.approx(0.4)
    assert ask(param.get_default_value, "deck.bcFlow2") is None
    assert ask(param.persistent_clear) is True
    assert ask(param.persistent_get_state).is_stored is False
    with pytest.raises(AttributeError):
        param.set_value("deck.bcFlow2", 0)
    # By name, without an answer that the client would look at.
    param.set_value_raw("ctrlMel.kd_xy", 0x06, 0.31)
    seen.clear()
    param.add_update_callback("ctrlMel", "kd_xy", lambda name, value: seen.append(value))
    param.request_param_update("ctrlMel.kd_xy")
    wait_until(lambda: seen)
    assert float(seen[0]) == pytest.approx(0.31)


def test_stored_parameters_survive_a_reboot(
    scf: SyncCrazyflie, vehicles: VirtualProcess, cache: Path
) -> None:
    done = threading.Event()
    scf.cf.param.set_value("posCtlPid.xKp", 1.75)
    scf.cf.param.persistent_store("posCtlPid.xKp", lambda *_: done.set())
    assert done.wait(5.0)
    scf.close_link()
    vehicles.command("reboot")
    with SyncCrazyflie(vehicles.uris[0], cf=Crazyflie(rw_cache=str(cache))) as connection:
        connection.wait_for_params()
        assert float(connection.cf.param.get_value("posCtlPid.xKp")) == pytest.approx(1.75)
        done.clear()
        connection.cf.param.persistent_clear("posCtlPid.xKp", lambda *_: done.set())
        assert done.wait(5.0)


def test_motion_commander(scf: SyncCrazyflie) -> None:
    estimate = Estimate(scf.cf)
    start = estimate.position
    with MotionCommander(scf, default_height=0.4) as commander:
        wait_until(lambda: abs(estimate.position[2] - 0.4) < 0.08, 5.0)
        commander.forward(0.4, velocity=0.4)
        time.sleep(0.5)
        moved = estimate.position - start
        assert moved[:2] == pytest.approx((0.4, 0.0), abs=0.12)
    wait_until(lambda: estimate.position[2] < 0.06)


def test_position_hl_commander(scf: SyncCrazyflie) -> None:
    estimate = Estimate(scf.cf)
    x, y, _ = (float(value) for value in estimate.position)
    scf.cf.commander.send_notify_setpoint_stop()
    commander = PositionHlCommander(
        scf, x=x, y=y, default_height=0.5, default_velocity=0.5, controller=1
    )
    with commander:
        commander.go_to(x + 0.3, y + 0.2, 0.6)
        time.sleep(0.7)
        assert estimate.position == pytest.approx((x + 0.3, y + 0.2, 0.6), abs=0.1)
        commander.go_to(x, y, 0.4)
    wait_until(lambda: estimate.position[2] < 0.06)


def test_high_level_commander_with_uploaded_trajectory(scf: SyncCrazyflie) -> None:
    cf = scf.cf
    estimate = Estimate(cf)
    start = estimate.position
    (memory,) = cf.mem.get_mems(MemoryElement.TYPE_TRAJ)
    # Half a metre forward and back, at rest at both ends: a quintic blend, then its mirror.
    blend = [0.0, 0.0, 0.0, 10.0, -15.0, 6.0, 0.0, 0.0]
    there = Poly4D.Poly([0.5 * value for value in blend])
    back = Poly4D.Poly([0.5] + [-0.5 * value for value in blend[1:]])
    flat = Poly4D.Poly([0.0] * 8)
    memory.trajectory = [Poly4D(1.0, there, flat, flat, flat), Poly4D(1.0, back, flat, flat, flat)]
    assert memory.write_data_sync()
    cf.high_level_commander.define_trajectory(1, 0, 2)

    cf.commander.send_notify_setpoint_stop()
    cf.high_level_commander.takeoff(0.5, 1.5)
    time.sleep(2.0)
    assert estimate.position[2] == pytest.approx(0.5, abs=0.1)
    marker = len(estimate.path)
    cf.high_level_commander.start_trajectory(1, time_scale=1.5, relative_position=True)
    time.sleep(3.5)
    flown = np.array(estimate.path[marker:]) - start
    assert flown[:, 0].max() == pytest.approx(0.5, abs=0.12)
    assert flown[-1, :2] == pytest.approx((0.0, 0.0), abs=0.12)
    cf.high_level_commander.land(0.0, 1.5)
    wait_until(lambda: estimate.position[2] < 0.06)


def _stream(cf: Crazyflie, seconds: float, point: np.ndarray, rise: float) -> None:
    """Full-state setpoints at 50 Hz: up by ``rise`` m in the first half, then hovering."""
    begin = time.monotonic()
    while (now := time.monotonic() - begin) < seconds:
        share = min(now / (0.5 * seconds), 1.0)
        height = rise * share * share * (3.0 - 2.0 * share)
        speed = 0.0 if share == 1.0 else rise * 6.0 * share * (1.0 - share) / (0.5 * seconds)
        cf.commander.send_full_state_setpoint(
            point + (0.0, 0.0, height), (0, 0, speed), (0, 0, 0), (0, 0, 0, 1), 0, 0, 0
        )
        time.sleep(0.02)


def test_full_state_streaming(scf: SyncCrazyflie) -> None:
    cf = scf.cf
    estimate = Estimate(cf)
    start = estimate.position
    _stream(cf, 4.0, start, 0.6)
    assert estimate.position == pytest.approx(start + (0.0, 0.0, 0.6), abs=0.1)
    # The hand-over: high-level commands take effect only after the notification.
    cf.commander.send_notify_setpoint_stop()
    cf.high_level_commander.land(0.0, 1.5)
    wait_until(lambda: estimate.position[2] < 0.06)


def test_lock_after_the_stream_stops(scf: SyncCrazyflie) -> None:
    cf = scf.cf
    estimate = Estimate(cf)
    _stream(cf, 2.0, estimate.position, 0.4)
    silent = estimate.info[-1][0]
    wait_until(lambda: cf.supervisor.is_locked)
    time.sleep(0.2)
    locked = next(stamp for stamp, info in estimate.info if info & 64)
    assert 1900 < locked - silent < 2300  # ms of the firmware's clock
    cf.supervisor.send_arming_request(True)
    cf.supervisor.send_crash_recovery_request()
    cf.commander.send_notify_setpoint_stop()
    cf.high_level_commander.takeoff(0.5, 1.0)
    time.sleep(1.0)
    assert cf.supervisor.is_locked
    assert estimate.position[2] < 0.1


def test_memories(scf: SyncCrazyflie) -> None:
    cf = scf.cf
    done = threading.Event()

    def finish(*_: object) -> None:
        done.set()

    def wait() -> None:
        assert done.wait(5.0)
        done.clear()

    (tester,) = cf.mem.get_mems(MemoryElement.TYPE_MEMORY_TESTER)
    tester.read_data(5, 100, finish)
    wait()
    assert tester.readValidationSuccess
    tester.write_data(7, 100, finish)
    wait()

    (eeprom,) = cf.mem.get_mems(MemoryElement.TYPE_I2C)
    eeprom.update(finish)
    wait()
    assert eeprom.valid
    assert eeprom.elements["radio_address"] == 0xE7E7E7E701
    eeprom.elements["radio_channel"] = 42
    eeprom.write_data(finish)
    wait()
    eeprom.update(finish)
    wait()
    assert eeprom.valid
    assert eeprom.elements["radio_channel"] == 42

    (ring,) = cf.mem.get_mems(MemoryElement.TYPE_DRIVER_LED)
    ring.leds[3].set(255, 0, 0)
    ring.write_data(finish)
    wait()

    decks = cf.mem.get_mems(MemoryElement.TYPE_1W)
    assert all(deck.valid for deck in decks)
    assert {deck.elements["Board name"] for deck in decks} == {"bcFlow2", "bcMultiranger"}

    found: list[dict] = []
    (manager,) = cf.mem.get_mems(MemoryElement.TYPE_DECK_MEMORY)
    manager.query_decks(lambda decks: (found.append(decks), finish()))
    wait()
    assert found == [{}]


def test_link_statistics(scf: SyncCrazyflie) -> None:
    latencies: list[float] = []
    scf.cf.link_statistics.latency_updated.add_callback(latencies.append)
    wait_until(lambda: len(latencies) >= 2)
    assert all(0.0 < value < 500.0 for value in latencies)  # ms


def test_arming(scf: SyncCrazyflie) -> None:
    supervisor = scf.cf.supervisor
    assert supervisor.is_armed
    assert supervisor.is_auto_armed
    supervisor.send_arming_request(False)
    # This build arms by itself, so that the request only shows for a moment.
    wait_until(lambda: supervisor.is_armed and supervisor.can_fly)
    assert "Is armed" in supervisor.read_state_list()


def test_emergency_stop(scf: SyncCrazyflie) -> None:
    cf = scf.cf
    estimate = Estimate(cf)
    cf.commander.send_notify_setpoint_stop()
    cf.high_level_commander.takeoff(0.4, 1.0)
    time.sleep(1.5)
    assert cf.supervisor.is_flying
    cf.supervisor.send_emergency_stop()
    wait_until(lambda: cf.supervisor.is_locked, 2.0)
    wait_until(lambda: estimate.position[2] < 0.1)
    assert not cf.supervisor.can_fly


def test_estimator_needs_external_poses(vehicles: VirtualProcess, cache: Path) -> None:
    """A vehicle that is not fed believes what the client tells it, and nothing else."""
    with (
        virtual_process("--port", "0") as process,
        SyncCrazyflie(process.uris[0], cf=Crazyflie(rw_cache=str(cache))) as connection,
    ):
        estimate = Estimate(connection.cf)
        yaw = 0.5
        quaternion = (0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))
        for _ in range(100):
            connection.cf.extpos.send_extpose(1.0, -2.0, 0.5, *quaternion)
            time.sleep(0.01)
        assert estimate.position == pytest.approx((1.0, -2.0, 0.5), abs=0.05)
        for _ in range(100):
            connection.cf.extpos.send_extpos(1.1, -2.0, 0.5)
            time.sleep(0.01)
        assert estimate.position == pytest.approx((1.1, -2.0, 0.5), abs=0.05)


@pytest.mark.slow
def test_swarm_of_ten(vehicles: VirtualProcess, cache: Path) -> None:
    vehicles.command("reboot")
    with Swarm(vehicles.uris, factory=CachedCfFactory(rw_cache=str(cache))) as swarm:
        swarm.reset_estimators()
        before = dict(swarm.get_estimated_positions())

        def fly(scf: SyncCrazyflie) -> None:
            scf.cf.commander.send_notify_setpoint_stop()
            commander = scf.cf.high_level_commander
            commander.takeoff(0.5, 2.0)
            time.sleep(2.5)
            commander.go_to(0.2, 0.0, 0.0, 0.0, 1.5, relative=True)
            time.sleep(2.0)

        swarm.parallel_safe(fly)
        after = swarm.get_estimated_positions()
        for uri, start in before.items():
            assert after[uri].x - start.x == pytest.approx(0.2, abs=0.1)
            assert after[uri].z == pytest.approx(0.5, abs=0.1)

        def land(scf: SyncCrazyflie) -> None:
            scf.cf.high_level_commander.land(0.0, 1.5)
            wait_until(lambda: not scf.cf.supervisor.is_flying)

        swarm.parallel_safe(land)


@pytest.mark.slow
def test_full_state_flight_over_a_bad_link(cache: Path) -> None:
    """20 s at 50 Hz, with lost and late packets; the vehicle's end counts what was lost."""
    options = ("--port", "0", "--feed-poses", "100", "--loss", "5%", "--latency", "8ms±3ms")
    with (
        virtual_process(*options) as process,
        SyncCrazyflie(process.uris[0], cf=Crazyflie(rw_cache=str(cache))) as connection,
    ):
        connection.wait_for_params()
        cf = connection.cf
        estimate = Estimate(cf)
        start = estimate.position
        _stream(cf, 20.0, start, 0.6)
        assert estimate.position == pytest.approx(start + (0.0, 0.0, 0.6), abs=0.1)
        for _ in range(3):
            cf.commander.send_notify_setpoint_stop()
        cf.high_level_commander.land(0.0, 1.5)
        wait_until(lambda: estimate.position[2] < 0.06)
        wait_until(lambda: not cf.supervisor.is_flying)
        found = re.search(r"received (\d+) \(lost (\d+), repeated (\d+)", process.command("status"))
        assert found is not None
        received, lost, repeated = (int(number) for number in found.groups())
        assert received > 1500
        assert 0.02 * 1000 < lost < 0.1 * received
        assert repeated > 0
