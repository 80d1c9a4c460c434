"""Answers about parameters that come twice or late are not taken for others."""

import struct
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyarena.crazyswarm_compat.radio.param_answers import ParamAnswers

READ, WRITE, MISC = 1, 2, 3


def packet(channel, data):
    return SimpleNamespace(channel=channel, data=data)


class Thread:
    """What cflib's parameter thread would hear."""

    def __init__(self):
        self.heard, self.done = [], []
        self.answers = ParamAnswers(self.done.append)
        self.hears = self.answers.through(self.heard.append)

    def ask(self, channel, data, wide=True):
        self.answers.asks(channel, data, wide)


@given(
    st.lists(
        st.tuples(st.integers(0, 1), st.sampled_from([None, 0.25, 0.5]), st.integers(0, 2)),
        max_size=12,
    )
)
def test_on_a_link_that_keeps_the_order_every_request_has_its_own_answer(requests):
    """Of each request (id, value to write or None, answers too many) the answers come in order,
    those that are too many only after the next request has gone out."""
    thread, values = Thread(), [0.0, 0.0]
    late = []
    for ident, value, more in requests:
        head = struct.pack("<H", ident)
        if value is None:
            request = READ, head
            answer = packet(READ, head + b"\0" + struct.pack("<f", values[ident]))
        else:
            values[ident] = value
            request = WRITE, head + struct.pack("<f", value)
            answer = packet(*request)
        thread.ask(*request)
        for each in [*late, answer]:
            thread.hears(each)
        assert thread.done == [head]
        (heard,) = thread.heard
        assert struct.unpack("<f", bytes(heard.data)[-4:])[0] == values[ident]
        thread.heard.clear()
        thread.done.clear()
        late = [answer] * more


def test_a_second_answer_to_a_reading_does_not_acknowledge_a_write():
    thread = Thread()
    old = packet(READ, struct.pack("<HBf", 7, 0, 0.4))
    thread.ask(READ, struct.pack("<H", 7))
    thread.hears(old)
    thread.ask(WRITE, struct.pack("<Hf", 7, 0.5))
    thread.hears(old)
    assert thread.done == [b"\x07\0"]
    thread.hears(packet(WRITE, struct.pack("<Hf", 7, 0.4)))  # of a write before
    assert thread.done == [b"\x07\0"]
    thread.hears(packet(WRITE, struct.pack("<Hf", 7, 0.5)))
    assert thread.done == 2 * [b"\x07\0"]


def test_a_refusal_is_an_answer():
    thread = Thread()
    thread.ask(WRITE, struct.pack("<Hf", 7, 0.5))
    thread.hears(packet(WRITE, struct.pack("<HB", 8, 2)))
    assert not thread.done
    thread.hears(packet(WRITE, struct.pack("<HB", 7, 2)))
    assert thread.done


def test_what_the_vehicle_tells_unasked_passes_and_answers_nothing():
    thread = Thread()
    thread.ask(WRITE, struct.pack("<HB", 3, 1))
    thread.hears(packet(MISC, struct.pack("<BHB", 1, 3, 0)))
    assert len(thread.heard) == 1
    assert not thread.done


def test_ids_of_old_firmware():
    thread = Thread()
    thread.ask(READ, b"\x05", wide=False)
    thread.hears(packet(READ, b"\x06\x01"))
    thread.hears(packet(READ, b"\x05\x01"))
    assert thread.done == [b"\x05"]


@pytest.mark.parametrize("times", [2, 3])
def test_a_vehicle_that_answers_several_times(world, times):
    """As over a slow link, on which requests were sent again."""
    hangar, backend = world(fed=False)
    vehicle = hangar.server.swarm.vehicles[0]
    receive, owed = vehicle.receive, []

    def again(datagram):
        answers = receive(datagram)
        about_values = datagram[0] >> 4 == 2 and datagram[0] & 3 in (READ, WRITE)
        if not about_values:
            return answers
        late, owed[:] = list(owed), answers * (times - 1)
        return [*late, *answers]

    vehicle.receive = again
    for k in range(10):
        value = 0.3 + 0.01 * k
        backend._links[1].parameters._read("ctrlMel.kp_xy")
        backend.set_param(1, "ctrlMel.kp_xy", value)
        assert backend.get_param(1, "ctrlMel.kp_xy") == pytest.approx(value)
        assert hangar.fleet.get_param(0, "ctrlMel.kp_xy") == pytest.approx(value)
