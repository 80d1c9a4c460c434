"""Which vehicle is where on the air."""

import pytest

from crazyarena.errors import InputError
from crazyarena.sim_backend.crazyradio.air_time import Rate
from crazyarena.sim_backend.crazyradio.fleet import (
    Place,
    RadioPlan,
    parse_link,
    parse_plan,
    put_on_air,
)
from tests.sim_backend.crazyradio.on_air import Leaping


def closed(links):
    for link in links:
        link.close()
    return [link.uri for link in links]


def test_vehicles_take_the_channels_in_turn():
    links, air = put_on_air((1, 2, 10), Leaping(), RadioPlan((80, 90), Rate.M1, 2))
    assert closed(links) == [
        "radio://0/80/1M/E7E7E7E701",
        "radio://1/90/1M/E7E7E7E702",
        "radio://0/80/1M/E7E7E7E70A",
    ]
    assert len(air.dongles()) == 2


def test_a_list_says_where_they_are():
    """The same last byte on different channels, another dongle, and a link that says nothing."""
    given = ["radio://0/80/2M/E7E7E7E701", "radio://2/100/250K/E7E7E7E701", "udp://1.2.3.4:1", None]
    links, air = put_on_air((1, 2, 3, 4), Leaping(), uris=given)
    assert closed(links) == [
        *given[:2],
        "radio://0/80/2M/E7E7E7E703",
        "radio://0/80/2M/E7E7E7E704",
    ]
    assert len(air.dongles()) == 3


@pytest.mark.parametrize(
    ("uri", "place"),
    [
        ("radio://1/5/1M/1", Place(1, 5, Rate.M1, b"\0\0\0\0\x01")),
        ("radio://1/5/1M/01", Place(1, 5, Rate.M1, b"\0\0\0\0\x01")),
        ("radio://0/126/2M/E7E7E7E701", None),
        ("radio://9/80/2M/E7E7E7E701", None),
        ("radio://0/80", None),
        ("usb://0", None),
    ],
)
def test_links(uri, place):
    assert parse_link(uri) == place


def test_plans():
    assert parse_plan(" 80, 90", "250k", 2) == RadioPlan((80, 90), Rate.K250, 2)
    for channels, rate, dongles, option in (
        ("80,", "2M", 1, "--channel"),
        ("-1", "2M", 1, "--channel"),
        ("80", "4M", 1, "--rate"),
        ("80", "2M", 9, "--dongles"),
    ):
        with pytest.raises(InputError, match=option):
            parse_plan(channels, rate, dongles)
