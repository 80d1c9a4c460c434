"""Setpoint decoding: odd lengths, random bytes, and the client's own encoder."""

from __future__ import annotations

import math
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyarena.sim_backend.crtp import setpoints as s
from crazyarena.sim_backend.firmware import layout as la

UNIT = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: math.hypot(*q) > 1e-3)
SIZES = {1: 17, 2: 17, 3: 10, 4: 17, 5: 17, 6: 29, 7: 17, 8: 17, 9: 17, 10: 17, 11: 16}


@given(st.binary(max_size=64))
def test_garbage_never_raises(payload):
    row = s.decode_setpoint(payload)
    if row is not None:
        assert row.shape == (la.SETPOINT_SIZE,)
        assert set(row[la.SP_MODE : la.SP_MODE + 7]) <= {0.0, 1.0, 2.0}
    s.decode_notify(payload)
    rpyt = s.RpytDecoder().decode(payload, 2)
    assert (rpyt is None) == (len(payload) < 14)


@pytest.mark.parametrize(("kind", "size"), SIZES.items())
def test_a_packet_that_is_cut_short_is_dropped(kind, size):
    payload = bytes([kind]) + bytes(size - 1)
    whole = s.decode_setpoint(payload)
    assert whole is not None
    for length in range(1, size):
        assert s.decode_setpoint(payload[:length]) is None
    np.testing.assert_array_equal(s.decode_setpoint(payload + b"\xff" * 3), whole)


def test_auxiliary_channels_must_be_there():
    packet = struct.pack("<BBHHHH", 3, 1, 1600, 1500, 1500, 2000)
    assert s.decode_setpoint(packet) is None
    row = s.decode_setpoint(packet + struct.pack("<H", 1499))
    assert row[la.M_ROLL] == la.MODE_VELOCITY
    assert row[la.SP_RATE] == pytest.approx(-144.0)


def test_stop_and_unknown_types_are_null_setpoints():
    for kind in (0, 12, 255):
        assert not s.decode_setpoint(bytes([kind])).any()
    assert s.decode_setpoint(b"") is None


def test_notify_carries_its_milliseconds():
    assert s.decode_notify(struct.pack("<BI", 0, 250)) == 250
    assert s.decode_notify(struct.pack("<BI", 1, 250)) is None
    assert s.decode_notify(b"\x00\x00") is None


@given(UNIT)
def test_quaternion_survives_compression(q):
    q = np.array(q) / np.linalg.norm(q)
    back = s.decompress_quaternion(s.compress_quaternion(q))
    assert np.linalg.norm(back) == pytest.approx(1.0)
    assert abs(back @ q) > 1.0 - 1e-5


@given(st.integers(0, 2**32 - 1))
def test_any_code_decodes_to_numbers(code):
    q = s.decompress_quaternion(code)
    assert np.isfinite(q).all()
    assert abs(q).max() <= 1.0


def test_the_client_library_speaks_the_same_format():
    commander = pytest.importorskip("cflib.crazyflie.commander")
    sent = []

    class Link:
        class platform:
            @staticmethod
            def get_protocol_version():
                return 12

        @staticmethod
        def send_packet(packet):
            sent.append(packet)

    client = commander.Commander(Link)
    q = [0.1, -0.2, 0.3, math.sqrt(1 - 0.14)]
    client.send_full_state_setpoint((1, -2, 0.5), (0.1, 0, -3), (0, 1, 2), q, 0.5, -0.25, 1)
    row = s.decode_setpoint(bytes(sent[-1].data))
    np.testing.assert_allclose(row[:9], [1, -2, 0.5, 0.1, 0, -3, 0, 1, 2], atol=1e-9)
    np.testing.assert_allclose(row[la.SP_QUAT : la.SP_QUAT + 4], q, atol=2e-3)
    np.testing.assert_allclose(
        row[la.SP_RATE : la.SP_RATE + 3], np.rad2deg([0.5, -0.25, 1]), atol=1e-9
    )
    client.send_velocity_world_setpoint(0.5, 0, 0.25, 30.0)
    row = s.decode_setpoint(bytes(sent[-1].data))
    assert row[la.SP_RATE + 2] == pytest.approx(30.0)
    client.send_notify_setpoint_stop(120)
    assert s.decode_notify(bytes(sent[-1].data)) == 120
