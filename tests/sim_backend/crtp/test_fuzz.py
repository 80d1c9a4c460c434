"""Garbage on the wire neither crashes a virtual Crazyflie nor moves it."""

from __future__ import annotations

import random
import struct
from collections.abc import Iterator
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crazyarena.sim_backend.crtp.packets import MAX_DATAGRAM, Port, parse
from crazyarena.sim_backend.crtp.vehicle import Hardware
from tests.sim_backend.crtp.recordings import Bench, conversations, param_id, requests

_PORTS = [int(port) for port in Port]
# What a well-formed order to move looks like: such a packet is a command, not garbage, and
# random bytes do hit it now and then.
_SETPOINT_BYTES = {1: 17, 2: 17, 4: 17, 5: 17, 6: 29, 7: 17, 8: 17, 9: 17, 10: 17, 11: 16}
_MOTION_BYTES = {
    1: 10, 2: 10, 4: 23, 5: 9, 7: 15, 8: 15, 9: 16, 10: 16, 11: 24, 12: 24, 13: 10
}  # fmt: skip


_IDLE_THRUST = param_id("powerDist.idleThrust")


def _orders_motion(datagram: bytes) -> bool:
    packet = parse(datagram)
    if packet is None or not packet.data:
        return False
    if packet.port == Port.PARAM and packet.channel == 2:
        # Armed motors turn at what it says.
        return packet.data[:2] == struct.pack("<H", _IDLE_THRUST)
    if packet.channel != 0:
        return False
    kind, size = packet.data[0], len(packet.data)
    if packet.port == Port.GENERIC_SETPOINT:
        # Type 3 has as many channels as its second byte says.
        return _SETPOINT_BYTES.get(kind) == size or kind == 3
    if packet.port == Port.SETPOINT:
        # With its thrust unlocked by an earlier packet.
        return size == 14
    return packet.port == Port.HIGH_LEVEL and _MOTION_BYTES.get(kind) == size


def _assert_at_rest(bench: Bench, start: np.ndarray) -> None:
    state = bench.fleet.true_state(0)
    rows = bench.vehicle.flight.rows
    for row in (rows.state, rows.setpoint, rows.control, rows.kalman, rows.high_level):
        assert np.isfinite(row).all()
    assert state.position == pytest.approx(start, abs=1e-3)
    assert np.linalg.norm(state.velocity) < 1e-2
    assert not rows.motors.any()


def _assert_answers(answers: list[bytes]) -> None:
    for answer in answers:
        assert 0 < len(answer) <= MAX_DATAGRAM


@pytest.fixture(scope="module")
def bench() -> Bench:
    bench = Bench(Hardware.FULL)
    bench.run_to(1000)
    return bench


def _headers() -> st.SearchStrategy[int]:
    return st.builds(
        lambda port, channel, reserved: port << 4 | reserved << 2 | channel,
        st.one_of(st.sampled_from(_PORTS), st.integers(0, 15)),
        st.integers(0, 3),
        st.sampled_from((3, 0)),
    )


@st.composite
def _datagrams(draw: st.DrawFn) -> bytes:
    """Mostly well-headed, with small first bytes, so that the services are reached."""
    header = draw(_headers())
    head = bytes(draw(st.lists(st.integers(0, 20), max_size=3)))
    return bytes((header,)) + head + draw(st.binary(max_size=40))


@settings(max_examples=300)
@given(st.lists(st.one_of(st.binary(max_size=64), _datagrams()), max_size=20))
def test_any_datagrams(bench: Bench, datagrams: list[bytes]) -> None:
    start = bench.fleet.true_state(0).position
    for datagram in datagrams:
        if not _orders_motion(datagram):
            _assert_answers(bench.ask(datagram))
    bench.run_to(bench.fleet.tick + 4)
    _assert_at_rest(bench, start)


@cache
def _recorded() -> list[bytes]:
    texts = [row[2] for _, rows in conversations() for row in rows]
    texts += [row[1] for _, rows in requests() for row in rows]
    return [bytes.fromhex(text) for text in dict.fromkeys(texts)]


@settings(max_examples=200)
@given(data=st.data())
def test_mangled_recordings(bench: Bench, data: st.DataObject) -> None:
    """Real packets cut short, grown, sent to another port, with bits turned, or replayed."""
    datagram = bytearray(data.draw(st.sampled_from(_recorded())))
    kind = data.draw(st.sampled_from(("cut", "grow", "port", "flip", "replay")))
    if kind == "cut":
        del datagram[data.draw(st.integers(0, len(datagram))) :]
    elif kind == "grow":
        datagram += data.draw(st.binary(min_size=1, max_size=30))
    elif kind == "port" and datagram:
        datagram[0] = data.draw(_headers())
    elif kind == "flip":
        bit = data.draw(st.integers(0, 8 * len(datagram) - 1))
        datagram[bit // 8] ^= 1 << bit % 8
    start = bench.fleet.true_state(0).position
    if not _orders_motion(bytes(datagram)):
        _assert_answers(bench.ask(bytes(datagram)))
    bench.run_to(bench.fleet.tick + 4)
    _assert_at_rest(bench, start)


# Type 6 has integers only.
@pytest.mark.parametrize("kind", sorted(set(_SETPOINT_BYTES) - {6}))
@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e30])
def test_setpoints_that_no_vehicle_could_hold(bench: Bench, kind: int, value: float) -> None:
    size = _SETPOINT_BYTES[kind]
    start = bench.fleet.true_state(0).position
    payload = struct.pack("<Bffff", kind, value, 0.0, value, value)[:size].ljust(size, b"\0")
    bench.ask(b"\x7c" + payload)
    bench.run_to(bench.fleet.tick + 100)
    _assert_at_rest(bench, start)


def test_orders_of_motion_do_move(bench: Bench) -> None:
    """The exception above is needed: what it leaves out is what flies."""
    other = Bench()
    other.run_to(1000)
    order = b"\x8c\x07" + struct.pack("<Bff?f", 0, 0.5, 0.0, False, 1.0)
    assert _orders_motion(order)
    other.ask(order)
    other.run_to(2500)
    assert other.fleet.true_state(0).position[2] > 0.3


def test_the_idle_thrust_is_stored_in_16_bits() -> None:
    other = Bench()
    other.run_to(1000)
    order = b"\x2e" + struct.pack("<HI", _IDLE_THRUST, 0x7FFF_0000 + 9000)
    assert _orders_motion(order)
    other.ask(order)
    other.run_to(1100)
    assert other.vehicle.flight.rows.motors.tolist() == [9000.0] * 4


def _random_datagrams(count: int, seed: int) -> Iterator[bytes]:
    rng = random.Random(seed)
    recorded = _recorded()
    for _ in range(count):
        draw = rng.random()
        if draw < 0.4:
            yield rng.randbytes(rng.randrange(70))
        elif draw < 0.8:
            header = rng.choice(_PORTS) << 4 | rng.choice((0, 12)) | rng.randrange(4)
            yield bytes((header, rng.randrange(16))) + rng.randbytes(rng.randrange(32))
        else:
            datagram = bytearray(rng.choice(recorded))
            datagram[rng.randrange(len(datagram))] ^= 1 << rng.randrange(8)
            yield bytes(datagram[: rng.randrange(1, len(datagram) + 1)])


def _bombard(count: int, seed: int) -> int:
    bench = Bench(Hardware.FULL)
    bench.run_to(1000)
    start = bench.fleet.true_state(0).position
    sent = 0
    for datagram in _random_datagrams(count, seed):
        if _orders_motion(datagram):
            continue
        sent += 1
        _assert_answers(bench.vehicle.receive(datagram))
        if sent % 500 == 0:
            bench.run_to(bench.fleet.tick + 4)
            _assert_at_rest(bench, start)
            bench.heard.clear()
    # It still answers as it should.
    assert bench.ask("fd00")[0].startswith(b"\xfdBitcraze Crazyflie")
    assert bench.ask("dd00") == [bytes.fromhex("dd000c000000")]
    return sent


def test_ten_thousand_random_datagrams() -> None:
    assert _bombard(10_000, seed=1) > 9_000


@pytest.mark.slow
def test_a_million_random_datagrams() -> None:
    assert _bombard(1_030_000, seed=2) >= 1_000_000
