"""Messages of the contestant's channel: whatever comes in is a message or an error."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyarena.crazyswarm_compat import commands as cs
from crazyarena.runner.contestant.contract_2022.command_check import Asked
from crazyarena.runner.contestant.contract_lsy.dialogue import Drawing
from crazyarena.runner.contestant.dialogue import Answer
from crazyarena.runner.contestant.sandbox import wire

numbers = st.floats(-100, 100)
triples = st.tuples(numbers, numbers, numbers)


def there_and_back(verb, command):
    answer = Answer(7, Asked(verb, command), None, 0.5, 0.001, 0.002)
    back = wire.decode(wire.encode_answer(answer))
    assert isinstance(back, Answer)
    assert (back.step, back.error) == (7, None)
    assert (back.command_seconds, back.learn_seconds) == (0.001, 0.002)
    assert back.asked.verb == verb
    return back.asked.command


@given(triples, triples, triples, numbers, triples)
def test_full_state_survives(position, velocity, acceleration, yaw, omega):
    back = there_and_back(1, cs.FullState(position, velocity, acceleration, yaw, omega))
    for name, value in (
        ("position", position),
        ("velocity", velocity),
        ("acceleration", acceleration),
        ("omega", omega),
    ):
        np.testing.assert_array_equal(getattr(back, name), value)
    assert back.yaw == yaw


@given(triples, numbers, st.floats(0.1, 10), st.booleans())
def test_go_to_survives(position, yaw, duration, relative):
    back = there_and_back(5, cs.GoTo(position, yaw, duration, relative))
    np.testing.assert_array_equal(back.position, position)
    assert (back.yaw, back.duration, back.relative) == (yaw, duration, relative)


@pytest.mark.parametrize(
    ("verb", "command"),
    [
        (-1, None),
        (0, None),
        (2, cs.Takeoff(1.0, 2.0)),
        (3, cs.Land(0.1, 2.0)),
        (4, cs.Stop()),
        (6, cs.NotifySetpointsStop()),
    ],
)
def test_other_verbs_survive(verb, command):
    assert there_and_back(verb, command) == command


colours = st.tuples(*[st.floats(0, 1)] * 4)
drawings = st.lists(
    st.builds(
        lambda kind, points, rgba, size: Drawing(kind, np.array(points), rgba, size),
        st.sampled_from(["line", "points"]),
        st.lists(triples, min_size=1, max_size=5),
        colours,
        st.floats(0, 10),
    ),
    max_size=6,
)


@given(drawings)
def test_what_is_drawn_survives_beside_a_command(drawn):
    answer = Answer(7, Asked(2, cs.Takeoff(1.0, 2.0)), None, 0.5, 0.001, 0.002, drawings=drawn)
    packet = wire.encode_answer(answer)
    back = wire.decode(packet)
    assert back.asked.command == cs.Takeoff(1.0, 2.0)
    assert len(back.drawings) == len(drawn)
    for one, other in zip(back.drawings, drawn, strict=True):
        assert (one.kind, one.rgba, one.size) == (other.kind, other.rgba, other.size)
        np.testing.assert_array_equal(one.points, other.points)
    if drawn:
        for cut in (packet[:-1], packet[: wire._ANSWER.size + 2]):
            with pytest.raises(wire.ChannelError):
                wire.decode(cut)
    assert wire.decode(wire.encode_answer(Answer(7, None, None, 0.0))).drawings is None


def test_drawings_without_room_are_left_out():
    much = [Drawing("line", np.zeros((600, 3)), (1.0, 0.0, 0.0, 1.0), 1.0)] * 9
    packet = wire.encode_answer(Answer(1, None, None, 0.0, drawings=much))
    assert len(packet) <= wire.MAX_PACKET
    assert 0 < len(wire.decode(packet).drawings) < 9


def test_errors_survive_and_long_ones_keep_their_end():
    text = "x" * 100_000 + "the end"
    back = wire.decode(wire.encode_answer(Answer(3, None, text, 0.25)))
    assert (back.kind, back.number, back.seconds) == (wire.FAILED, 3, 0.25)
    assert back.text.endswith("the end")
    assert len(back.text) == wire.MAX_TEXT


@given(st.binary(max_size=300))
def test_garbage_is_an_error_or_a_harmless_message(packet):
    try:
        message = wire.decode(packet)
    except wire.ChannelError:
        return
    if isinstance(message, Answer) and message.asked is not None:
        command = message.asked.command
        if isinstance(command, cs.FullState):
            assert np.isfinite(np.asarray(command.position)).all()


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_numbers_that_are_not_finite_do_not_pass(value):
    answer = Answer(0, Asked(2, cs.Takeoff(1.0, 2.0)), None, 0.0)
    packet = bytearray(wire.encode_answer(answer))
    packet[wire._ANSWER.size - 13 * 8 : wire._ANSWER.size - 12 * 8] = np.float64(value).tobytes()
    with pytest.raises(wire.ChannelError, match="height"):
        wire.decode(bytes(packet))


def test_an_unknown_verb_does_not_pass():
    packet = bytearray(wire.encode_answer(Answer(0, Asked(4, cs.Stop()), None, 0.0)))
    packet[9] = 77
    with pytest.raises(wire.ChannelError):
        wire.decode(bytes(packet))
