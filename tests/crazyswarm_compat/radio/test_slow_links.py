"""Links that take their time: how long answers are waited for, and how a connection is made."""

import math
import threading

import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyarena.clock import WallClock
from crazyarena.crazyswarm_compat import commands as c
from crazyarena.crazyswarm_compat.radio import RadioBackend, RadioOptions
from crazyarena.crazyswarm_compat.radio.connecting import wrong_uri
from crazyarena.crazyswarm_compat.radio.quality import RoundTrip
from crazyarena.errors import CommandError, InputError
from tests.crazyswarm_compat.radio.conftest import Hangar
from tests.waiting import eventually


class TestRoundTrip:
    def test_before_any_answer_the_least(self):
        assert RoundTrip().patience(0.08) == 0.08

    @given(st.floats(0.001, 0.5), st.floats(0.0, 0.3))
    def test_longer_than_a_steady_link_takes(self, mean, least):
        trip = RoundTrip()
        for _ in range(100):
            trip.observe(mean)
        assert trip.patience(least) == pytest.approx(max(least, mean), rel=0.01)

    def test_backs_off_until_an_answer_comes(self):
        trip = RoundTrip()
        waited, now = [], 0.0
        for _ in range(4):
            waited.append(trip.patience(0.08))
            now += waited[-1]
            trip.timed_out(now)
        assert waited == sorted(waited)
        assert trip.patience(0.08) > 0.5
        trip.observe(0.1)
        assert 0.1 < trip.patience(0.08) < 0.4

    def test_answers_lost_together_count_once(self):
        trip = RoundTrip()
        trip.observe(0.1)
        before = trip.patience(0.0)
        for _ in range(6):
            trip.timed_out(10.0)
        assert trip.patience(0.0) == pytest.approx(2 * before)

    def test_never_for_ever(self):
        trip = RoundTrip()
        trip.observe(100.0)
        assert trip.patience(0.1) <= 3.0


@pytest.mark.parametrize("parameters", ["needed", "all"])
def test_a_connection_with_50_ms_each_way_and_nothing_in_the_cache(tmp_path, parameters):
    hangar = Hangar(1, 0, latency=0.05)
    before = threading.active_count()
    backend = None
    try:
        options = RadioOptions(cache=tmp_path, parameters=parameters)
        backend = RadioBackend(hangar.config(), WallClock(), options)
        known = backend._links[1].client.param.values
        count = sum(len(group) for group in known.values())
        names = backend.param_names(1)
        assert count == (len(names) if parameters == "all" else 3)
        # Values that were not fetched are when they are asked for.
        assert backend.get_param(1, "ctrlMel.kp_xy") == pytest.approx(0.4)
        backend.set_param(1, "ctrlMel.kp_xy", 0.5)
        assert backend.get_param(1, "ctrlMel.kp_xy") == pytest.approx(0.5)
    finally:
        if backend is not None:
            backend.close()
        hangar.close()
    eventually(lambda: threading.active_count() < before, 10.0)


def test_a_late_answer_does_not_double_a_command(world):
    hangar, backend = world(fed=False, latency=0.08)
    eventually(lambda: backend.statistics(1).latency_p50 is not None, 5.0)
    sent = backend.statistics(1).lanes
    before = next(s for lane, s in sent.items() if lane.name == "COMMAND").repeated
    for _ in range(5):
        backend.send(c.SetGroupMask(3), 1)
    eventually(lambda: hangar.fleet.get_param(0, "hlCommander.groupmask") == 3, 5.0)
    eventually(lambda: backend._links[1].outbox._awaiting is None, 5.0)
    after = next(
        s for lane, s in backend.statistics(1).lanes.items() if lane.name == "COMMAND"
    ).repeated
    assert after == before


@pytest.mark.parametrize(
    "uri",
    [
        "udp://127.0.0.1",
        "udp://127.0.0.1:",
        "udp://:19850",
        "udp://127.0.0.1:x",
        "udp://127.0.0.1:70000",
        "radio://0/126/2M/E7E7E7E701",
        "radio://0/80/3M/E7E7E7E701",
        "radio://0/80/2M/E7E7E7E7XX",
        "radio://",
        "127.0.0.1:19850",
        "",
    ],
)
def test_links_that_cannot_be(uri):
    assert "expected" in wrong_uri(uri)


@pytest.mark.parametrize(
    "uri",
    [
        "udp://127.0.0.1:19850",
        "udp://localhost:19850",
        "radio://0/80/2M/E7E7E7E701",
        "radio://0/80/2M",
        "radio://0",
        "radio://0/80/2M/E7E7E7E701?safelink=0",
        "radio://E7E7E7E7E7/10/250K/1",
        "usb://0",
    ],
)
def test_links_that_can(uri):
    assert wrong_uri(uri) is None


def test_a_link_without_port_is_named():
    hangar = Hangar(1, 0)
    try:
        with pytest.raises(InputError, match=r"cf1: uri: found 'udp://127.0.0.1'; expected udp"):
            RadioBackend(hangar.config(uri="udp://127.0.0.1"), WallClock())
    finally:
        hangar.close()


def test_outages_are_told_by_their_length(world):
    from crazyarena.crazyswarm_compat.radio import LinkUp

    hangar, backend = world(options=RadioOptions(link_timeout=0.3))
    backend.take_events()
    hangar.server.cut(1.0)
    eventually(lambda: not backend.connected(1), 5.0)
    eventually(lambda: backend.connected(1), 5.0)
    (up,) = [event for event in backend.take_events() if isinstance(event, LinkUp)]
    assert up.outage > 0.5


def test_numbers_that_are_none_are_refused_before_anything_is_written(world):
    hangar, backend = world(fed=False)
    for value in (math.nan, math.inf, -math.inf, 1e39):
        with pytest.raises(CommandError, match=r"ctrlMel\.kp_xy"):
            backend.set_param(1, "ctrlMel.kp_xy", value)
        with pytest.raises(CommandError):
            backend.send(c.SetParam("ctrlMel.kp_xy", value), 1)
    assert hangar.fleet.get_param(0, "ctrlMel.kp_xy") == pytest.approx(0.4)
    for command in (
        c.Takeoff(1e30, 1.0),
        c.Takeoff(1.0, 1e30),
        c.GoTo([0, 1e6, 0], 0.0, 1.0),
        c.Position([0, 0, 1], 1e7),
        c.Hover(0, 0, 0, 1e9),
    ):
        with pytest.raises(CommandError, match="within"):
            backend.send(command, 1)
