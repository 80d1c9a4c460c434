"""Dongles whose air is in another process, and what travels between."""

import contextlib
import os
import socket
import subprocess
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyarena.clock import WallClock
from crazyarena.errors import InputError
from crazyarena.sim_backend.crazyradio import wire
from crazyarena.sim_backend.crazyradio.air import Frame, InUse, Outcome, Unplugged
from crazyarena.sim_backend.crazyradio.air_time import Rate
from crazyarena.sim_backend.crazyradio.environment import with_dongles
from crazyarena.sim_backend.crazyradio.gateway import Gateway
from crazyarena.sim_backend.crazyradio.remote import RemoteAir
from tests.sim_backend.crazyradio.on_air import ADDRESS, Vehicle, air_with

FRAME = Frame(80, Rate.M2, ADDRESS, b"\x30x")


@pytest.fixture
def gateway():
    vehicle = Vehicle()
    serving = Gateway(air_with(vehicle, serials=("A", "B")), WallClock(), port=0)
    serving.vehicle = vehicle
    yield serving
    serving.close()


frames = st.builds(
    Frame,
    st.integers(0, 125),
    st.sampled_from(list(Rate)),
    st.binary(min_size=5, max_size=5),
    st.binary(min_size=1, max_size=32),
    st.integers(0, 15),
    st.integers(0, 4000).map(lambda micros: 1e-6 * micros),
    st.booleans(),
)


@given(frame=frames, number=st.integers(0, 2**32 - 1), token=st.binary(min_size=8, max_size=8))
def test_requests_arrive_as_they_were(frame, number, token):
    data = wire.request(wire.Kind.EXCHANGE, number, token, "E7E7000001", frame)
    kind, number_, token_, serial, frame_ = wire.parse_request(data)
    assert (kind, number_, token_, serial) == (wire.Kind.EXCHANGE, number, token, "E7E7000001")
    assert frame_.ack_wait == pytest.approx(frame.ack_wait)
    for name in ("channel", "rate", "address", "payload", "retries", "acked"):
        assert getattr(frame_, name) == getattr(frame, name)


@given(
    acked=st.booleans(),
    retries=st.integers(0, 15),
    micros=st.integers(0, 10**6),
    payload=st.binary(max_size=32),
    strong=st.booleans(),
)
def test_answers_arrive_as_they_were(acked, retries, micros, payload, strong):
    outcome = Outcome(acked, retries, 1e-6 * micros, payload, strong)
    body = wire.pack_outcome(outcome)
    data = wire.answer(wire.Kind.EXCHANGE, 7, wire.Status.OK, body)
    assert wire.parse_answer(data) == (wire.Kind.EXCHANGE, 7, wire.Status.OK, body)
    found = wire.parse_outcome(body)
    assert found.duration == pytest.approx(outcome.duration)
    assert (found.acked, found.retries, found.payload, found.strong) == (
        acked,
        retries,
        payload,
        strong,
    )


@given(st.binary(max_size=100))
def test_anything_else_is_nobodys(data):
    for prefix in (b"", b"CRV1"):
        request = wire.parse_request(prefix + data)
        assert request is None or len(request) == 5
        answer = wire.parse_answer(prefix + data)
        assert answer is None or len(answer) == 4
        wire.parse_outcome(data)


def test_frames_are_carried(gateway):
    air = RemoteAir(gateway.address)
    assert air.dongles() == ("A", "B")
    air.claim("A")
    outcome = air.exchange("A", FRAME, 0.0)
    assert outcome.acked
    assert gateway.vehicle.got == [b"\x30x"]
    air.close()


def test_rubbish_is_not_answered_and_harms_nobody(gateway):
    host, _, port = gateway.address.partition(":")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.settimeout(0.2)
        stranger.connect((host, int(port)))
        for rubbish in (b"", b"\xff", b"CRV1" + bytes(60), os.urandom(200)):
            stranger.send(rubbish)
        with contextlib.suppress(TimeoutError):
            while True:
                # All zeros is a question for the dongles, which any stranger may ask.
                assert stranger.recv(256)[4] == wire.Kind.DONGLES
    air = RemoteAir(gateway.address)
    assert air.exchange("A", FRAME, 0.0).acked
    air.close()


def test_a_dongle_has_one_holder(gateway):
    first, second = RemoteAir(gateway.address), RemoteAir(gateway.address)
    first.claim("A")
    with pytest.raises(InUse):
        second.claim("A")
    second.claim("B")
    first.release("A")
    second.claim("A")
    gateway.air.plug("A", False)
    with pytest.raises(Unplugged):
        second.exchange("A", FRAME, 0.0)
    first.close()
    second.close()


def test_nobody_at_the_other_end_is_nobody_in_range(gateway):
    air = RemoteAir(gateway.address)
    assert air.dongles() == ("A", "B")
    gateway.close()
    outcome = air.exchange("A", FRAME, 0.0)
    assert not outcome.acked
    assert outcome.duration > 4 * FRAME.ack_wait
    assert air.dongles() == ("A", "B")
    air.close()


def test_a_taken_port_is_named(gateway):
    port = int(gateway.address.partition(":")[2])
    with pytest.raises(InputError, match="--radio-port"):
        Gateway(gateway.air, WallClock(), port=port)


@pytest.mark.parametrize("address", ["", "here", "127.0.0.1:", "127.0.0.1:70000", ":1"])
def test_wrong_addresses(address):
    with pytest.raises(ValueError, match="HOST:PORT"):
        RemoteAir(address)


def test_the_environment_alone_plugs_them_in(gateway, tmp_path):
    """In a program of any kind, with a sitecustomize of its own behind ours."""
    (tmp_path / "sitecustomize.py").write_text("import builtins; builtins.theirs = True\n")
    base = dict(os.environ, PYTHONPATH=str(tmp_path))
    program = "from cflib.drivers.crazyradio import get_serials; print(theirs, *get_serials())"
    done = subprocess.run(
        [sys.executable, "-c", program],
        env=with_dongles(gateway.address, base),
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.stdout.split() == ["True", "A", "B"], done.stderr
    broken = subprocess.run(
        [sys.executable, "-c", "print(1)"],
        env=with_dongles("nowhere", base),
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert broken.stdout == "1\n"
    assert "HOST:PORT" in broken.stderr
