"""Faults of the link and their options."""

from __future__ import annotations

import math
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyarena.errors import InputError
from crazyarena.sim_backend.crtp.faults import (
    Channel,
    Faults,
    is_streamed,
    parse_latency,
    parse_share,
    parse_volts,
)

_SETPOINT = bytes.fromhex("7c00")
_REQUEST = bytes.fromhex("5c03")
_LOG_DATA = bytes.fromhex("5201000000")


@pytest.mark.parametrize(("text", "share"), [("5%", 0.05), ("0.05", 0.05), ("0", 0), ("100 %", 1)])
def test_share(text: str, share: float) -> None:
    assert parse_share(text) == pytest.approx(share)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("8ms", (0.008, 0.0)),
        ("8ms±3ms", (0.008, 0.003)),
        ("8ms+-3ms", (0.008, 0.003)),
        ("0.1 s ± 20 ms", (0.1, 0.02)),
        ("500us", (0.0005, 0.0)),
    ],
)
def test_latency(text: str, expected: tuple[float, float]) -> None:
    assert parse_latency(text) == pytest.approx(expected)


@pytest.mark.parametrize("text", ["3.2V", "3.2", "3.2 v"])
def test_volts(text: str) -> None:
    assert parse_volts(text) == pytest.approx(3.2)


@pytest.mark.parametrize(
    ("parse", "text"),
    [
        (parse_share, "5"),
        (parse_share, "-1%"),
        (parse_share, "lots"),
        (parse_latency, "8"),
        (parse_latency, "3ms±8ms"),
        (parse_latency, "8ms±3ms±1ms"),
        (parse_volts, "9V"),
        (parse_volts, "low"),
    ],
)
def test_wrong_options_name_themselves(parse: object, text: str) -> None:
    with pytest.raises(InputError, match=text.replace("±", ".")):
        parse(text)  # type: ignore[operator]


@given(st.text(max_size=20))
def test_options_parse_or_explain(text: str) -> None:
    for parse in (parse_share, parse_latency, parse_volts):
        try:
            value = parse(text)
        except InputError:
            continue
        values = value if isinstance(value, tuple) else (value,)
        assert all(math.isfinite(number) and number >= 0 for number in values)


def _through(faults: Faults, datagrams: list[bytes], spacing: float = 0.01) -> tuple[Channel, list]:
    channel = Channel(faults, random.Random(7))
    arrivals = []
    for k, datagram in enumerate(datagrams):
        channel.send(datagram, k, spacing * k)
    end = spacing * len(datagrams) + 10.0
    now = 0.0
    while channel.due() < end:
        now = channel.due()
        arrivals += [(now, peer) for _, peer in channel.take(now)]
    return channel, arrivals


def test_a_perfect_link_delivers_at_once() -> None:
    _, arrivals = _through(Faults(), [_SETPOINT] * 10)
    assert arrivals == [(pytest.approx(0.01 * k), k) for k in range(10)]


def test_streamed_packets_are_lost_for_good() -> None:
    channel, arrivals = _through(Faults(loss=0.05), [_SETPOINT, _LOG_DATA] * 5000)
    assert channel.counters.lost == pytest.approx(500, rel=0.2)
    assert len(arrivals) == 10_000 - channel.counters.lost
    assert channel.counters.repeated == 0


def test_requests_are_repeated_until_they_arrive() -> None:
    channel, arrivals = _through(Faults(loss=0.3), [_REQUEST] * 2000, spacing=1.0)
    assert [peer for _, peer in arrivals] == list(range(2000))
    late = sum(time > peer for time, peer in arrivals)
    assert late == pytest.approx(600, rel=0.2)
    assert channel.counters.repeated >= late
    assert channel.counters.lost == 0


def test_without_the_safe_link_requests_are_lost_too() -> None:
    channel, arrivals = _through(Faults(loss=0.3, safe_link=False), [_REQUEST] * 2000)
    assert channel.counters.lost == pytest.approx(600, rel=0.2)
    assert len(arrivals) + channel.counters.lost == 2000


@given(
    st.floats(0, 0.1),
    st.floats(0, 1),
    st.floats(0, 0.9),
    st.lists(st.sampled_from((_SETPOINT, _REQUEST, _LOG_DATA)), min_size=1, max_size=50),
)
def test_delay_is_within_bounds_and_keeps_the_order(
    latency: float, share: float, loss: float, datagrams: list[bytes]
) -> None:
    faults = Faults(loss=loss, latency=latency, jitter=share * latency)
    _, arrivals = _through(faults, datagrams)
    peers = [peer for _, peer in arrivals]
    assert peers == sorted(peers)
    times = [time for time, _ in arrivals]
    assert times == sorted(times)
    for time, peer in arrivals:
        assert time >= 0.01 * peer + latency - faults.jitter - 1e-9
    streamed = {k for k, datagram in enumerate(datagrams) if is_streamed(datagram)}
    assert set(range(len(datagrams))) - streamed <= set(peers)


def test_a_cut_link_delivers_nothing_until_it_is_mended() -> None:
    faults = Faults(cut_until=0.5)
    channel, arrivals = _through(faults, [_REQUEST] * 100)
    assert [peer for _, peer in arrivals] == list(range(50, 100))
    assert channel.counters.cut == 50


def test_what_is_under_way_when_the_link_is_cut_is_lost() -> None:
    faults = Faults(latency=0.1)
    channel = Channel(faults, random.Random(1))
    channel.send(_REQUEST, None, 0.0)
    faults.cut_until = 0.2
    assert channel.take(0.15) == []
    assert channel.counters.cut == 1
