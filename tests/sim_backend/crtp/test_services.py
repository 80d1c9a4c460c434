"""Single services of the virtual Crazyflie, without sockets."""

from __future__ import annotations

import math
import struct
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyarena.crazyswarm_compat import commands as c
from crazyarena.sim_backend.arena import ArenaFleet
from crazyarena.sim_backend.arena_params import PARAMS
from crazyarena.sim_backend.crtp.console import ConsoleService
from crazyarena.sim_backend.crtp.log import MAX_BLOCKS
from crazyarena.sim_backend.crtp.setpoints import compress_quaternion
from crazyarena.sim_backend.crtp.toc import TYPES, Table, log_entries, param_entries
from crazyarena.sim_backend.crtp.vehicle import Hardware, VirtualCrazyflie
from crazyarena.sim_backend.decks import make_deck
from crazyarena.sim_backend.firmware.supervisor import INFO_CRASHED, INFO_FLYING
from crazyarena.sim_backend.vehicles import load_vehicle, vehicle_rows
from tests.sim_backend.crtp.recordings import Bench, param_id


@pytest.fixture
def bench() -> Bench:
    bench = Bench(Hardware.FULL)
    bench.run_to(1000)
    return bench


def _log_id(bench: Bench, name: str) -> int:
    return [entry.name for entry in bench.vehicle.log.entries].index(name)


def _read_logs(bench: Bench, *names: str) -> dict[str, float]:
    """Values of float variables by one-shot log blocks."""
    values = {}
    for name in names:
        bench.ask(b"\x5d\x06\x63\x77" + struct.pack("<H", _log_id(bench, name)))
        _, data = bench.ask("5d036300")
        bench.ask("5d0263")
        values[name] = struct.unpack_from("<f", data, 5)[0]
    return values


# Types


@given(st.sampled_from(sorted(TYPES)), st.floats() | st.integers(-(2**70), 2**70))
def test_every_number_has_a_place_in_every_type(name: str, value: float) -> None:
    ctype = TYPES[name]
    data = ctype.pack(value)
    assert len(data) == ctype.size
    back = ctype.unpack(data)
    if name not in ("float", "fp16") and abs(value) < 100 and (value >= 0 or name[0] == "i"):
        assert back == math.trunc(value)


@pytest.mark.parametrize("table", Table)
def test_simulated_parameters_have_the_types_of_the_table(table: Table) -> None:
    """So that no value a client can write is beyond what the simulation takes."""
    types = {entry.name: entry.ctype.name for entry in param_entries(table)}
    shared = {p.name: p.ctype for p in PARAMS if p.name in types}
    assert len(shared) > 100
    assert shared == {name: types[name] for name in shared}


# Parameters


def test_a_written_gain_reaches_the_controller(bench: Bench) -> None:
    number = param_id("ctrlMel.kp_xy")
    request = b"\x2e" + struct.pack("<Hf", number, 0.7)
    assert bench.ask(request) == [request]
    assert bench.fleet.get_param(0, "ctrlMel.kp_xy") == pytest.approx(0.7)
    # And what the simulation changes itself, a client reads.
    bench.fleet.set_param(0, "ctrlMel.kp_xy", 0.9)
    assert bench.ask(b"\x2d" + struct.pack("<H", number))[0][4:] == struct.pack("<f", 0.9)


def test_a_parameter_nothing_models_keeps_its_value(bench: Bench) -> None:
    number = param_id("ring.fadeTime")
    bench.ask(b"\x2e" + struct.pack("<Hf", number, 2.5))
    assert bench.ask(b"\x2d" + struct.pack("<H", number))[0][4:] == struct.pack("<f", 2.5)


@pytest.mark.parametrize(
    ("name", "code", "value", "status"),
    [
        (b"ring\0solidRed", 0x08, b"\x11", 0),
        (b"ring\0nosuch", 0x08, b"\x11", 2),
        (b"deck\0bcFlow2", 0x08, b"\x00", 13),
        (b"ring\0solidRed", 0x06, bytes(4), 22),
    ],
)
def test_set_by_name(bench: Bench, name: bytes, code: int, value: bytes, status: int) -> None:
    answers = bench.ask(b"\x2f\0" + name + bytes((0, code)) + value)
    assert answers == [b"\x2f\0" + name + bytes((0, status))]


def test_store_clear_and_reboot(bench: Bench) -> None:
    number = struct.pack("<H", param_id("posCtlPid.xKp"))
    write = b"\x2e" + number + struct.pack("<f", 1.5)
    assert bench.ask(b"\x2f\x05" + number) == [b"\x2f\x05" + number + b"\x02"]
    bench.ask(write)
    assert bench.ask(b"\x2f\x03" + number) == [b"\x2f\x03" + number + b"\x00"]
    state = b"\x2f\x04" + number + b"\x01" + struct.pack("<ff", 2.0, 1.5)
    assert bench.ask(b"\x2f\x04" + number) == [state]
    bench.vehicle.reboot()
    assert bench.fleet.get_param(0, "posCtlPid.xKp") == 1.5
    assert bench.ask(b"\x2f\x05" + number) == [b"\x2f\x05" + number + b"\x00"]
    bench.vehicle.reboot()
    assert bench.fleet.get_param(0, "posCtlPid.xKp") == 2.0


# Logs


def test_log_block_in_all_its_types(bench: Bench) -> None:
    number = struct.pack("<H", _log_id(bench, "pm.vbatMV"))
    volts = 1000.0 * (bench.fleet.telemetry(0).battery or 0.0)
    for code, layout in ((1, "B"), (2, "H"), (3, "I"), (4, "b"), (5, "h"), (6, "i"), (7, "f")):
        bench.ask(bytes((0x5D, 6, code, 0x20 | code)) + number)
        _, data = bench.ask(bytes((0x5D, 3, code, 0)))
        value = struct.unpack_from("<" + layout, data, 5)[0]
        limit = {1: 255, 4: 127}.get(code, 65535)
        assert value == pytest.approx(min(volts, limit), abs=1)


def test_log_periods(bench: Bench) -> None:
    bench.ask(b"\x5d\x06\x01\x77" + struct.pack("<H", _log_id(bench, "pm.vbat")))
    for start, period in ((b"\x5d\x03\x01\x01", 10), (b"\x5d\x08\x01\x19\x00", 25)):
        bench.heard.clear()
        bench.ask(start)
        bench.run_to(bench.fleet.tick + 1000)
        assert len(bench.heard) == pytest.approx(1000 / period, abs=1)
    bench.ask("5d0401")
    bench.heard.clear()
    bench.run_to(bench.fleet.tick + 100)
    assert bench.heard == []


def test_log_capacity(bench: Bench) -> None:
    for ident in range(MAX_BLOCKS):
        assert bench.ask(bytes((0x5D, 6, ident)))[0][-1] == 0
    assert bench.ask(bytes((0x5D, 6, 99)))[0][-1] == 12
    # 128 variables of all blocks together: eight bytes a block, sixteen blocks.
    eight = 8 * (b"\x11" + struct.pack("<H", _log_id(bench, "pm.state")))
    for ident in range(MAX_BLOCKS):
        assert bench.ask(bytes((0x5D, 7, ident)) + eight)[0][-1] == 0
    assert bench.ask(b"\x5d\x07\x00" + eight[:3])[0][-1] == 12
    assert bench.ask("5d05")[0][-1] == 0
    assert bench.ask(b"\x5d\x09\x00")[0][-1] == 8


def test_logged_estimate_is_the_estimate(bench: Bench) -> None:
    state = bench.fleet.telemetry(0).state
    assert state is not None
    names = [f"stateEstimate.{axis}" for axis in "xyz"]
    assert list(_read_logs(bench, *names).values()) == pytest.approx(state.position, abs=1e-6)
    flight = _read_logs(bench, "acc.z", "stateEstimateZ.az", "kalman.varX")
    assert flight["acc.z"] == pytest.approx(1.0, abs=0.02)
    assert flight["stateEstimateZ.az"] == pytest.approx(9810.0, rel=0.02)
    assert 0.0 < flight["kalman.varX"] < 1.0


# Setpoints and commands


def test_legacy_thrust_is_locked_until_a_zero(bench: Bench) -> None:
    def setpoint(thrust: int) -> None:
        for _ in range(20):
            bench.ask(b"\x3c" + struct.pack("<fffH", 0.0, 0.0, 0.0, thrust))
            bench.run_to(bench.fleet.tick + 20)

    setpoint(30000)
    assert not bench.vehicle.flight.rows.motors.any()
    setpoint(0)
    setpoint(30000)
    assert bench.vehicle.flight.rows.motors.all()


def test_takeoff_is_ignored_after_a_stream_until_the_notification(bench: Bench) -> None:
    takeoff = b"\x8c\x07" + struct.pack("<Bff?f", 0, 0.5, 0.0, False, 1.0)
    bench.ask(b"\x3c" + bytes(14))
    bench.ask(takeoff)
    bench.run_to(bench.fleet.tick + 1500)
    assert not bench.vehicle.flight.info() & INFO_FLYING
    bench.ask("7d0000000000")
    bench.run_to(bench.fleet.tick + 500)
    assert bench.fleet.true_state(0).position[2] > 0.1


def test_group_mask(bench: Bench) -> None:
    bench.ask("8c0004")
    for group, flies in ((0x03, False), (0x06, True)):
        bench.ask(b"\x8c\x07" + struct.pack("<Bff?f", group, 0.5, 0.0, False, 1.0))
        bench.run_to(bench.fleet.tick + 700)
        assert bool(bench.vehicle.flight.info() & INFO_FLYING) is flies


def test_an_unknown_high_level_command_is_refused(bench: Bench) -> None:
    assert bench.ask("8c630000") == [bytes.fromhex("8c63000008")]
    assert bench.ask("8c07000000") == [bytes.fromhex("8c07000008")]


def test_a_take_off_without_its_last_byte_is_taken(bench: Bench) -> None:
    takeoff = b"\x8c\x07" + struct.pack("<Bff?f", 0, 0.5, 0.0, False, 1.0)
    assert bench.ask(takeoff[:-1]) == [bytes.fromhex("8c07000000")]
    assert bench.ask(takeoff[:-2]) == [bytes.fromhex("8c07000008")]
    landing = b"\x8c\x08" + struct.pack("<Bff?f", 0, 0.0, 0.0, False, 1.0)
    assert bench.ask(landing[:-1]) == [bytes.fromhex("8c08000008")]


# Tables of hardware


@pytest.mark.parametrize("table", Table)
def test_no_entry_is_there_twice_and_every_name_fits_its_packet(table: Table) -> None:
    for entries in (param_entries(table), log_entries(table)):
        names = [entry.name for entry in entries]
        assert len(names) == len(set(names))
        assert all(len(name) + 1 <= 26 for name in names)
        groups = [name.partition(".")[0] for name in names]
        if table is not Table.RECORDED:
            assert len(set(groups)) == sum(a != b for a, b in pairwise(["", *groups]))


def test_what_every_vehicle_has_and_a_simulation_build_lacks() -> None:
    recorded = {entry.name for entry in param_entries(Table.RECORDED)}
    for table in (Table.CF21, Table.CF21_BRUSHLESS):
        params = {entry.name: entry for entry in param_entries(table)}
        for name in (
            "colAv.enable", "motorPowerSet.m4", "pm.criticalLowVoltage", "health.startBatTest",
            "lighthouse.method", "sound.effect", "ctrlAtt.tau_xy", "cpu.id2",
        ):  # fmt: skip
            assert name in params
        assert not any("_SIM" in name for name in params)
        logs = {entry.name for entry in log_entries(table)}
        for name in ("pm.batteryLevel", "pm.state", "health.motorVarXM1", "motor.m3rpm"):
            assert name in logs
        assert params["locSrv.extQuatStdDev"].boot == pytest.approx(0.0045)
        assert params["pm.lowVoltage"].boot == pytest.approx(3.2)
    assert "colAv.enable" not in recorded
    by_name = {entry.name: entry.boot for entry in param_entries(Table.RECORDED)}
    assert by_name["locSrv.extQuatStdDev"] == pytest.approx(0.05)


def _told(vehicle: VirtualCrazyflie) -> dict[str, float]:
    return {entry.name: vehicle._read(i) for i, entry in enumerate(vehicle.log.entries)}


def test_sensors_that_follow_from_what_is_simulated() -> None:
    model = vehicle_rows(load_vehicle("cf21b"))
    fleet = ArenaFleet([(0.0, 0.0, 0.0)], vehicles=model)
    vehicle = VirtualCrazyflie(fleet, 0, table=Table.CF21_BRUSHLESS)
    ground = _told(vehicle)
    assert ground["motor.m1rpm"] == 0.0
    fleet.external_truth()
    fleet.advance(500)
    fleet.send(c.Takeoff(1.0, 1.5), 0)
    for _ in range(250):
        fleet.external_truth()
        fleet.advance(10)
    flying = _told(vehicle)
    # What carries the vehicle, at the speed that its rotors have for it.
    each = 9.81 * model.plant[0] / 4.0
    expected = 30.0 / math.pi * 5103.0 * math.sqrt(each)
    for motor in range(1, 5):
        assert flying[f"motor.m{motor}rpm"] == pytest.approx(expected, rel=0.1)
    assert flying["baro.asl"] - ground["baro.asl"] == pytest.approx(1.0, abs=0.1)
    assert ground["baro.pressure"] - flying["baro.pressure"] == pytest.approx(0.12, abs=0.015)
    assert flying["ctrlMel.accelz"] == pytest.approx(1.0, abs=0.1)
    assert _told(VirtualCrazyflie(fleet, 0, table=Table.CF21))["motor.m1rpm"] == 0.0


def test_decks_tell_what_they_see() -> None:
    fleet = ArenaFleet([(0.0, 0.0, 0.4), (1.0, 2.0, 0.0)])
    fleet.decks.fit(0, make_deck("flow", np.random.default_rng(0)))
    fleet.decks.fit(1, make_deck("lighthouse", np.random.default_rng(0)))
    flow, lighthouse = (VirtualCrazyflie(fleet, index) for index in range(2))
    assert _told(flow)["range.zrange"] == pytest.approx(400.0)
    fleet.advance(100)
    told = _told(lighthouse)
    assert told["lighthouse.status"] == 2
    assert told["lighthouse.bsActive"] == 3
    place = [told[f"lighthouse.{axis}"] for axis in "xyz"]
    np.testing.assert_allclose(place, [1.0, 2.0, 0.0], atol=0.1)
    assert _told(flow)["lighthouse.status"] == 0


@pytest.mark.parametrize(
    ("table", "device"),
    [(Table.CF21, b"Crazyflie 2.1"), (Table.CF21_BRUSHLESS, b"Crazyflie 2.1 Brushless")],
)
def test_hardware_boots_as_hardware(table: Table, device: bytes) -> None:
    bench = Bench(Hardware.FULL, table)
    assert bench.ask("dd02") == [b"\xdd\x02" + device]
    assert bench.fleet.get_param(0, "locSrv.extQuatStdDev") == pytest.approx(0.0045)
    entries = bench.vehicle.params.entries
    for ident, entry in enumerate(entries):
        assert entry.ctype.unpack(bench.vehicle.params.get(ident)) == pytest.approx(
            entry.ctype.unpack(entry.ctype.pack(entry.boot))
        ), entry.name
    # What the simulation models is live.
    ident = [entry.name for entry in entries].index("colAv.enable")
    bench.ask(b"\x2e" + struct.pack("<HB", ident, 1))
    assert bench.fleet.get_param(0, "colAv.enable") == 1
    bench.run_to(100)
    level = bench.vehicle._read(_log_id(bench, "pm.batteryLevel"))
    assert level in range(50, 100, 10)


# Localization


def test_poses_single_and_packed() -> None:
    bench = Bench()
    bench.swarm._feed_period = None
    # On the ground the estimator is slow to take a heading that it is told to doubt.
    bench.fleet.set_param(0, "locSrv.extQuatStdDev", 4.5e-3)
    yaw = 0.8
    quaternion = (0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))
    pose = b"\x6d\x08" + struct.pack("<fffffff", 1.0, 2.0, 0.5, *quaternion)
    packed = b"\x6d\x09" + struct.pack(
        "<BhhhIBhhhI", 1, 1500, 2000, 500, compress_quaternion(quaternion), 9, 1, 2, 3, 0
    )
    position = b"\x6e\x01" + struct.pack("<hhh", 900, 2000, 500)
    for datagram, x in ((pose, 1.0), (packed, 1.5), (position, 0.9)):
        for _ in range(100):
            bench.ask(datagram)
            bench.run_to(bench.fleet.tick + 10)
        state = bench.fleet.telemetry(0).state
        assert state is not None
        assert state.position == pytest.approx((x, 2.0, 0.5), abs=0.08)
        if datagram != position:
            q = state.quaternion
            assert 2.0 * math.atan2(q[2], q[3]) == pytest.approx(yaw, abs=0.05)
    logs = _read_logs(bench, "locSrv.x", "ext_pos.Y")
    assert list(logs.values()) == pytest.approx([0.9, 2.0])


@pytest.mark.parametrize("stop", ["6d03", "9d03"])
def test_emergency_stop_on_either_port(bench: Bench, stop: str) -> None:
    assert bench.ask(stop) == []
    bench.run_to(bench.fleet.tick + 200)
    assert bench.vehicle.flight.info() & 64


@pytest.mark.parametrize("feed", ["6d04", "9d04"])
def test_watchdog_on_either_port(bench: Bench, feed: str) -> None:
    bench.ask(feed)
    bench.run_to(bench.fleet.tick + 900)
    assert not bench.vehicle.flight.info() & 64
    bench.run_to(bench.fleet.tick + 300)
    assert bench.vehicle.flight.info() & 64


# Supervisor and platform


def test_arming_and_recovery_answers(bench: Bench) -> None:
    assert bench.ask("9d0101") == [bytes.fromhex("91810101")]
    assert bench.ask("9d0100") == [bytes.fromhex("91810100")]
    assert bench.ask("9d02") == [bytes.fromhex("91820101")]
    assert bench.ask("dc02") == [bytes.fromhex("dc0201")]
    assert bench.ask("9c0d") == []
    assert bench.ask("9d05") == []


def test_single_bits_and_the_whole_field_agree(bench: Bench) -> None:
    (field,) = bench.ask("9c0c")
    info = int.from_bytes(field[2:4], "little")
    assert not info & INFO_CRASHED
    for bit in range(11):
        (answer,) = bench.ask(bytes((0x9C, bit + 1)))
        assert answer == bytes((0x90, 0x81 + bit, info >> bit & 1))


def test_versions(bench: Bench) -> None:
    assert bench.ask("dd00") == [bytes.fromhex("dd000c000000")]
    assert bench.ask("dd01") == [b"\xdd\x012026.08"]
    assert bench.ask("dd02") == [b"\xdd\x02CF21"]


# Memories


def test_memory_reads_and_writes_stay_inside(bench: Bench) -> None:
    assert bench.ask(b"\x4d\x00" + struct.pack("<IB", 4090, 6))[0][6] == 0
    assert bench.ask(b"\x4d\x00" + struct.pack("<IB", 4090, 7))[0][6:] == b"\x05"
    assert bench.ask(b"\x4d\x00" + struct.pack("<IB", 0, 25))[0][6:] == b"\x05"
    assert bench.ask(b"\x4e\x00" + struct.pack("<I", 4095) + b"ab")[0][6:] == b"\x05"
    assert bench.ask(b"\x4d\x63" + struct.pack("<IB", 0, 1))[0][6:] == b"\x02"
    bench.ask(b"\x4e\x00" + struct.pack("<I", 7) + b"abc")
    assert bench.ask(b"\x4d\x00" + struct.pack("<IB", 7, 3))[0][7:] == b"abc"
    assert bytes(bench.fleet.trajectories[0, 7:10]) == b"abc"


def test_wrong_writes_to_the_tester_are_counted(bench: Bench) -> None:
    bench.ask(b"\x4e\x01" + struct.pack("<I", 16) + bytes((16, 17, 99)))
    assert _read_logs(bench, "memTst.errCntW")["memTst.errCntW"] == 1.0


# Console


@given(st.lists(st.text(max_size=60), max_size=10))
def test_console_text_arrives_whole(texts: list[str]) -> None:
    console = ConsoleService()
    for text in texts:
        console.write(text)
    console.write("\n")
    packets = console.take()
    assert all(packet[0] == 0 and 1 < len(packet) <= 31 for packet in packets)
    sent = "".join(texts).encode("latin-1", "replace") + b"\n"
    assert b"".join(packet[1:] for packet in packets) == sent
    assert console.take() == []


def test_console_text_reaches_the_client(bench: Bench) -> None:
    bench.vehicle.console.write("SYS: hello\n")
    bench.run_to(bench.fleet.tick + 10)
    assert (b"\x00SYS: hello\n") in [datagram for _, datagram in bench.heard]


# Battery


@pytest.mark.parametrize("volts", [3.0, 3.5, 4.0, 4.2])
def test_battery_voltage(bench: Bench, volts: float) -> None:
    bench.vehicle.set_battery(volts)
    bench.run_to(bench.fleet.tick + 10)
    assert _read_logs(bench, "pm.vbat")["pm.vbat"] == pytest.approx(volts, abs=0.03)
    assert np.isfinite(bench.fleet.bodies).all()
