"""The vehicle's radio chip."""

import random
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.sim_backend.crazyradio.on_air import Vehicle

SAFE = b"\xff\x05\x01"


class Ground:
    """A ground station that keeps the safe link as its description asks."""

    def __init__(self, vehicle, rng, loss):
        self._vehicle, self._rng, self._loss = vehicle, rng, loss
        self._up = self._down = 0
        self.got = []

    def _once(self, frame):
        if self._rng.random() < self._loss:
            return None
        answer = self._vehicle.receiver.hear(bytes(frame))
        return None if self._rng.random() < self._loss else answer

    def connect(self):
        while self._once(SAFE) != SAFE:
            pass

    def send(self, packet):
        """Until it is acknowledged."""
        frame = bytes((packet[0] & 0xF3 | self._up << 3 | self._down << 2,)) + packet[1:]
        while (answer := self._once(frame)) is None:
            pass
        self._up = 1 - self._up
        if answer and (answer[0] & 4) == self._down << 2:
            self._down = 1 - self._down
            if answer[0] & 0xF3 != 0xF3:
                self.got.append(answer)


def _numbered(number):
    return b"\x50" + struct.pack("<I", number)


def _numbers(packets):
    return [struct.unpack("<I", packet[1:])[0] for packet in packets]


@given(loss=st.sampled_from([0.0, 0.1, 0.5]), seed=st.integers(0, 1000))
def test_safe_link_loses_and_doubles_nothing(loss, seed):
    rng = random.Random(seed)
    vehicle = Vehicle()
    ground = Ground(vehicle, rng, loss)
    ground.connect()
    for number in range(200):
        vehicle.receiver.say(_numbered(number))
        ground.send(_numbered(number) if rng.random() < 0.8 else b"\xff")
    for _ in range(400):
        ground.send(b"\xff")
    up = _numbers(vehicle.got)
    assert up == sorted(set(up))
    assert _numbers(ground.got) == list(range(200))


def test_without_it_a_lost_acknowledgement_doubles_one_way_and_loses_the_other():
    vehicle = Vehicle()
    vehicle.receiver.say(b"\x50first")
    vehicle.receiver.say(b"\x50second")
    assert vehicle.receiver.hear(b"\x30up") == b"\x50first"  # lost on its way
    assert vehicle.receiver.hear(b"\x30up") == b"\x50second"
    assert vehicle.got == [b"\x30up", b"\x30up"]


def test_nothing_to_say_is_a_null_packet_with_the_signal_strength():
    assert Vehicle().receiver.hear(b"\xff") == bytes((0xF3, 0x01, 45))


def test_no_room_is_no_acknowledgement():
    vehicle = Vehicle()
    vehicle.receiver.hear(SAFE)
    vehicle.room = False
    assert vehicle.receiver.hear(b"\x30up") is None
    vehicle.room = True
    assert vehicle.receiver.hear(b"\x30up") is not None
    assert vehicle.got == [b"\x30up"]


def test_its_queue_is_finite():
    receiver = Vehicle().receiver
    said = sum(receiver.say(b"\x50x") for _ in range(1000))
    assert said == receiver.waiting < 200
    assert receiver.counters.overflowed == 1000 - said


def test_a_reset_forgets_the_safe_link_and_what_waits():
    vehicle = Vehicle()
    vehicle.receiver.hear(SAFE)
    vehicle.receiver.say(b"\x50old")
    vehicle.receiver.reset()
    assert not vehicle.receiver.safe_link
    assert vehicle.receiver.hear(b"\xff")[0] & 0xF3 == 0xF3


@pytest.mark.parametrize("request_byte", [0x01, 0x02, 0x03, 0xF0, 0x77])
def test_power_requests_are_passed_on_and_acknowledged(request_byte):
    asked = []
    vehicle = Vehicle()
    vehicle.receiver._power = asked.append
    assert vehicle.receiver.hear(bytes((0xF3, 0xFE, request_byte))) is not None
    assert asked == [request_byte]


@given(frames=st.lists(st.binary(min_size=1, max_size=32), max_size=50))
def test_any_frames_are_survived(frames):
    vehicle = Vehicle()
    vehicle.receiver.say(b"\x50x")
    for frame in frames:
        answer = vehicle.receiver.hear(frame)
        assert answer is not None
        assert len(answer) <= 32
        vehicle.receiver.overhear(frame)
