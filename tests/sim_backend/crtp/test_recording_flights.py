"""Recorded flights of a real firmware, flown again: the supervisor says the same."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator

import numpy as np
import pytest

from crazyarena.sim_backend.firmware import supervisor as sv
from tests.sim_backend.crtp.recordings import Bench, conversations, flights

_TOLERANCE = 0.1  # s
_STREAM_RATE = 30.0  # Hz
_HEIGHT = 1.0  # m, where the operations do not say

_ARM = bytes.fromhex("9d0101")
_DISARM = bytes.fromhex("9d0100")
_RECOVER = bytes.fromhex("9d02")
_STOP = bytes.fromhex("9d03")
_FEED = bytes.fromhex("9d04")
_NOTIFY = bytes.fromhex("7d0000000000")


def _takeoff(height: float, duration: float) -> bytes:
    return b"\x8c\x07" + struct.pack("<Bff?f", 0, height, 0.0, False, duration)


def _full_state(x: float, y: float, z: float) -> bytes:
    position = [round(1000 * value) for value in (x, y, z)]
    # The unit quaternion: largest component w, all others zero.
    return b"\x7c\x06" + struct.pack("<hhhhhhhhhIhhh", *position, *[0] * 6, 3 << 30, 0, 0, 0)


def _repeat(datagram: bytes, start: float, end: float, rate: float) -> list[tuple[float, bytes]]:
    count = max(1, round((end - start) * rate))
    return [(start + k / rate, datagram) for k in range(count)]


def _schedule(ops: list) -> list[tuple[float, bytes]]:
    """Datagrams with their times for the operations of a flight; skips unknown ones."""
    out: list[tuple[float, bytes]] = []
    for (at, what), (until, _) in zip(ops, [*ops[1:], [ops[-1][0], "end"]], strict=True):
        text = what.lower()
        if text.startswith("arm+takeoff"):
            out += [(at, _ARM), (at + 0.01, _RECOVER), (at + 0.02, _takeoff(_HEIGHT, 2.0))]
        elif text.startswith("takeoff"):
            out.append((at, _takeoff(_HEIGHT, 2.0)))
        elif text.startswith("stream full"):
            out += _repeat(_full_state(0.0, 0.0, _HEIGHT), at, until, _STREAM_RATE)
        elif text.startswith("emergency stop"):
            out.append((at, _STOP))
        elif match := re.match(r"feed watchdog ([\d.]+)s at ([\d.]+) hz", text):
            out += _repeat(_FEED, at, at + float(match[1]), float(match[2]))
        elif text == "arm":
            out.append((at, _ARM))
        elif text == "disarm":
            out.append((at, _DISARM))
        elif text == "notify":
            out.append((at, _NOTIFY))
        elif text not in ("silence", "stop feeding", "end"):
            pytest.skip(f"operation {what!r} is not one this test can fly by itself")
    return out


def _changes(rows: list[tuple[float, int]]) -> Iterator[tuple[float, int]]:
    previous = None
    for time, value in rows:
        if value != previous:
            yield time, value
            previous = value


def _assert_same(recorded: list[tuple[float, int]], flown: list[tuple[float, int]]) -> None:
    """Every bit of one side has the same value on the other within the tolerance.

    Bit by bit, because two bits that change within one period of the supervisor or another give
    a value in between on one side only.
    """
    steps = np.diff([time for time, _ in recorded])
    for name, left, right, slack in (
        ("recorded", recorded, flown, 0.0),
        # What fell between two recorded samples may be missing there.
        ("flown", flown, recorded, float(np.max(steps))),
    ):
        times = np.array([time for time, _ in right])
        values = np.array([value for _, value in right])
        for time, value in left:
            if not right[0][0] <= time <= right[-1][0]:
                continue
            near = values[np.abs(times - time) <= _TOLERANCE + slack]
            same = int(np.bitwise_or.reduce(~(near ^ value)))
            missing = ~same & 0xFFFF
            assert missing == 0, (
                f"{name} {value:#05x} at {time:.3f} s: bits {missing:#x} differ; the other side: "
                f"{list(_changes(right))}, this one: {list(_changes(left))}"
            )
    assert flown[-1][1] == recorded[-1][1]


def _fly(
    schedule: list[tuple[float, bytes]], start: float, end: float, offset: float
) -> tuple[Bench, list[tuple[float, int]]]:
    """Fly from ``start`` to ``end`` (s, recorded clock), which is firmware time less ``offset``."""
    bench = Bench()
    bench.run_to(1000 * (start + offset))
    info: list[tuple[float, int]] = []
    waiting = sorted(schedule, key=lambda item: item[0])
    time = start
    while time < end:
        while waiting and waiting[0][0] <= time:
            bench.ask(waiting.pop(0)[1])
        info.append((time, bench.vehicle.flight.info()))
        time += 0.01
        bench.run_to(1000 * (time + offset))
    info.append((end, bench.vehicle.flight.info()))
    return bench, info


def _offset(log: list) -> float:
    return float(np.median([row[1] / 1000.0 - row[0] for row in log]))


_COLUMNS = ["t", "fw_ms", "x", "y", "z", "roll_deg", "supervisor.info", "stabilizer.thrust"]


@pytest.mark.parametrize("flight", [pytest.param(f, id=n) for n, f in flights() if "columns" in f])
def test_flight_by_operations(flight: dict) -> None:
    columns = flight["columns"]
    at = columns.index("supervisor.info")
    log = flight["log"]
    offset = _offset(log)
    recorded = [(row[0], int(row[at])) for row in log]
    bench, flown = _fly(_schedule(flight["ops"]), log[0][0], log[-1][0], offset)
    _assert_same(recorded, flown)

    end = bench.fleet.true_state(0)
    final = dict(zip(columns, log[-1], strict=True))
    assert end.position == pytest.approx((final["x"], final["y"], final["z"]), abs=0.05)
    assert np.linalg.norm(end.velocity) < 0.05
    if final["stabilizer.thrust"] == 0.0:
        assert not bench.vehicle.flight.rows.motors.any()
    # What is locked stays locked: neither arming nor recovery nor a command moves it.
    if recorded[-1][1] & sv.INFO_LOCKED:
        for datagram in (_ARM, _RECOVER, _NOTIFY, _takeoff(_HEIGHT, 2.0)):
            bench.ask(datagram)
        bench.run_to(bench.fleet.tick + 1000)
        assert bench.vehicle.flight.info() & sv.INFO_LOCKED
        assert bench.fleet.true_state(0).position == pytest.approx(end.position, abs=1e-3)


def _tours() -> list:
    """Flights without column names are those of a conversation: same takeoff, same client."""
    return [
        pytest.param(conversation, flight, id=f"{name}-{flight_name}")
        for name, conversation in conversations()
        for flight_name, flight in flights()
        if "columns" not in flight
    ]


@pytest.mark.parametrize(("conversation", "flight"), _tours())
def test_flight_of_a_conversation(conversation: list, flight: dict) -> None:
    log = flight["log"]
    # The log block of the conversation that carries the bits of the flight's rows tells the
    # firmware's time of each datagram; ops and log share another clock.
    stamps = [
        (row[0], int.from_bytes(bytes.fromhex(row[2])[2:5], "little") / 1000.0)
        for row in conversation
        if row[1] == "<" and row[2].startswith("52")
    ]
    if not stamps or not log:
        pytest.skip("no firmware time in the conversation")
    shift = float(np.median([firmware - time for time, firmware in stamps]))
    schedule = [
        (row[0], bytes.fromhex(row[2]))
        for row in conversation
        if row[1] == ">" and not row[2].startswith(("2", "fc"))
    ]
    start = log[0][1] / 1000.0 - shift
    end = log[-1][1] / 1000.0 - shift
    bench, flown = _fly(schedule, start, end, shift)
    recorded = [(row[1] / 1000.0 - shift, int(row[6])) for row in log]
    _assert_same(recorded, flown)
    assert bench.fleet.true_state(0).position == pytest.approx(log[-1][2:5], abs=0.15)
