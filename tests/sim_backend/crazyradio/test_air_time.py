"""Durations, against numbers worked out by hand from the product specification."""

import pytest

from crazyarena.sim_backend.crazyradio.air_time import (
    SETTLE,
    Rate,
    ack_wait,
    on_air,
    parse_rate,
)


@pytest.mark.parametrize(
    ("payload", "rate", "micros"),
    [(32, Rate.M2, 164.5), (1, Rate.M2, 40.5), (32, Rate.M1, 329.0), (0, Rate.K250, 292.0)],
)
def test_frame(payload, rate, micros):
    assert on_air(payload, rate) == pytest.approx(1e-6 * micros)


@pytest.mark.parametrize(
    ("setting", "rate", "micros"),
    [
        (0x00, Rate.M2, 250),
        (0x0F, Rate.M2, 4000),
        (0xA0, Rate.M2, 500),  # 32 bytes take 165 µs and the turn-round 130
        (0xA0, Rate.M1, 500),
        (0xA0, Rate.K250, 1500),
        (0x80, Rate.M2, 250),
        (0xFF, Rate.M2, 500),  # more than a payload holds
    ],
)
def test_wait_for_an_acknowledgement(setting, rate, micros):
    assert ack_wait(setting, rate) == pytest.approx(1e-6 * micros)


@pytest.mark.parametrize("rate", list(Rate))
@pytest.mark.parametrize("payload", range(33))
def test_the_wait_is_long_enough_for_the_acknowledgement(rate, payload):
    assert ack_wait(0x80 | payload, rate) >= SETTLE + on_air(payload, rate)


def test_labels():
    assert [parse_rate(text) for text in ("250k", "1M", " 2M ")] == list(Rate)
    assert parse_rate("3M") is None
