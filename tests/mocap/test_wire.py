from __future__ import annotations

import struct
import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyarena.mocap.wire import PayloadError, decode, encode
from crazyarena.types import Pose

finite = st.floats(-1e6, 1e6, allow_nan=False)
names = st.lists(st.text(min_size=1, max_size=20), max_size=6, unique=True).filter(
    lambda many: all(len(n.encode("utf-8", "surrogatepass")) <= 60 for n in many)
)


def sound(text: str) -> bool:
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


@st.composite
def contents(draw):
    bodies = {}
    for name in draw(names):
        if not sound(name):
            continue
        quaternion = np.array(draw(st.lists(st.floats(-1, 1), min_size=4, max_size=4)))
        norm = np.linalg.norm(quaternion)
        quaternion = quaternion / norm if norm > 1e-3 else np.array([0.0, 0.0, 0.0, 1.0])
        position = np.array(draw(st.lists(finite, min_size=3, max_size=3)))
        bodies[name] = Pose(position, quaternion)
    count = draw(st.integers(0, 5))
    markers = np.array(draw(st.lists(finite, min_size=3 * count, max_size=3 * count)))
    return draw(st.integers(0, 2**64 - 1)), bodies, markers.reshape(count, 3)


@given(contents(), finite, finite)
def test_what_is_encoded_is_decoded(content, captured, sent):
    frame_id, bodies, markers = content
    wire = decode(encode(frame_id, captured, sent, 17, 19, bodies, markers))
    assert (wire.frame_id, wire.host, wire.run, wire.captured, wire.sent) == (
        frame_id,
        17,
        19,
        captured,
        sent,
    )
    assert list(wire.bodies) == list(bodies)
    for name, pose in bodies.items():
        assert wire.bodies[name].position.tobytes() == pose.position.tobytes()
        assert wire.bodies[name].quaternion.tobytes() == pose.quaternion.tobytes()
    assert wire.markers.tobytes() == markers.tobytes()


@given(st.binary(max_size=200))
def test_noise_is_refused_cleanly(payload):
    with pytest.raises(PayloadError):
        decode(payload)
    with pytest.raises(PayloadError):
        decode(b"CAPF\x01\x00" + payload)


def good() -> bytes:
    return encode(5, 1.0, 2.0, 3, 4, {"cf1": Pose(np.ones(3))}, np.zeros((2, 3)))


@given(st.integers(0, 2000), st.integers(1, 255))
def test_no_single_damaged_byte_passes(at, flip):
    payload = bytearray(good())
    payload[at % len(payload)] ^= flip
    with pytest.raises(PayloadError):
        decode(bytes(payload))


@given(st.integers(0, 400))
def test_no_cut_payload_passes(length):
    payload = good()
    if length < len(payload):
        with pytest.raises(PayloadError):
            decode(payload[:length])


def resealed(payload: bytearray) -> bytes:
    return bytes(payload[:-4]) + struct.pack("<I", zlib.crc32(bytes(payload[:-4])))


def test_numbers_that_are_not_finite_and_bent_quaternions_are_refused():
    for offset, value in ((56, float("nan")), (56, float("inf")), (56 + 24, 0.5), (40, np.nan)):
        payload = bytearray(good())
        struct.pack_into("<d", payload, offset, value)
        with pytest.raises(PayloadError, match=r"finite|norm"):
            decode(resealed(payload))


def test_a_later_version_is_refused_by_name():
    payload = bytearray(good())
    payload[4] = 2
    with pytest.raises(PayloadError, match="version 2"):
        decode(resealed(payload))


def test_names_must_be_unique_and_nonempty():
    with pytest.raises(PayloadError, match="name"):
        encode(0, 0.0, 0.0, 0, 0, {"": Pose(np.zeros(3))})
    two = {"cf1": Pose(np.zeros(3)), "cf2": Pose(np.zeros(3))}
    payload = bytearray(encode(0, 0.0, 0.0, 0, 0, two))
    payload[payload.rindex(b"cf2") + 2] = ord("1")
    with pytest.raises(PayloadError, match="twice"):
        decode(resealed(payload))
