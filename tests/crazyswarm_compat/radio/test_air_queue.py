"""What goes first to one vehicle, and what replaces what."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyarena.crazyswarm_compat import commands as c
from crazyarena.crazyswarm_compat.radio import packets as pk
from crazyarena.crazyswarm_compat.radio.air_queue import AirQueue, Share, is_request, share_of


def wire(packet):
    return bytes((packet.port << 4 | packet.channel,)) + packet.data


def position(x):
    (packet,) = pk.setpoint(c.Position([x, 0, 1]), 12, "cf1")
    return wire(packet)


STOP, FEED = wire(pk.emergency_stop(12)), wire(pk.emergency_watchdog(12))
OLD_STOP, OLD_FEED = wire(pk.emergency_stop(4)), wire(pk.emergency_watchdog(4))
TAKEOFF = wire(pk.high_level(c.Takeoff(1.0, 1.0), 12, "cf1"))
NOTIFY = wire(pk.notify_setpoints_stop())
ARM = wire(pk.arm(True, 12))
POSE = wire(pk.external_position([1.0, 2.0, 3.0]))
PARAM, PING = b"\x2d\x01\x00", wire(pk.ping(1))
ATTITUDE, NO_THRUST = b"\x3c" + bytes(12) + b"\x10\x27", b"\x3c" + bytes(14)


@pytest.mark.parametrize(
    ("packet", "share"),
    [
        (STOP, Share.STOP),
        (OLD_STOP, Share.STOP),
        (FEED, Share.WATCHDOG),
        (OLD_FEED, Share.WATCHDOG),
        (TAKEOFF, Share.FLIGHT),
        (NOTIFY, Share.FLIGHT),
        (ARM, Share.FLIGHT),
        (position(0.0), Share.FLIGHT),
        (ATTITUDE, Share.FLIGHT),
        (POSE, Share.POSE),
        (b"\x61\x09" + bytes(22), Share.POSE),
        (b"\x62" + bytes(28), Share.POSE),
        (PARAM, Share.REST),
        (PING, Share.REST),
    ],
)
def test_classes(packet, share):
    assert share_of(packet) is share


def test_the_most_urgent_goes_first_whatever_came_first():
    queue = AirQueue()
    packets = [PING, POSE, TAKEOFF, FEED, STOP]
    for packet in packets:
        queue.put(packet, 0.0)
    assert [queue.take().packet for _ in packets] == packets[::-1]
    assert queue.take() is None


def test_newer_setpoints_and_poses_replace_and_keep_their_place_in_the_line():
    queue = AirQueue()
    for k in range(5):
        queue.put(position(0.1 * k), float(k))
        queue.put(wire(pk.external_position([k, 0, 0])), float(k))
    waiting = queue.take()
    assert waiting.packet == position(0.4)
    assert waiting.since == 0.0
    assert queue.take().packet == wire(pk.external_position([4, 0, 0]))
    assert queue.take() is None
    assert queue.replaced[Share.FLIGHT] == queue.replaced[Share.POSE] == 4


def test_a_command_between_setpoints_keeps_its_place():
    queue = AirQueue()
    for packet in (position(0.0), NOTIFY, TAKEOFF, position(1.0), position(2.0)):
        queue.put(packet, 0.0)
    order = [queue.take().packet for _ in range(4)]
    assert order == [position(0.0), NOTIFY, TAKEOFF, position(2.0)]


def test_the_setpoint_that_unlocks_the_motors_is_never_replaced():
    queue = AirQueue()
    queue.put(NO_THRUST, 0.0)
    queue.put(ATTITUDE, 0.0)
    queue.put(ATTITUDE[:-1] + b"\x28", 0.0)
    assert queue.take().packet == NO_THRUST
    assert queue.take().packet == ATTITUDE[:-1] + b"\x28"


def test_positions_of_other_vehicles_do_not_replace_each_other():
    queue = AirQueue()
    first, second = b"\x62\x01" + bytes(6), b"\x62\x05" + bytes(6)
    for packet in (first, second, POSE):
        assert queue.put(packet, 0.0)
    assert {queue.take().packet for _ in range(3)} == {first, second, POSE}


def test_it_is_finite():
    queue = AirQueue()
    assert sum(queue.put(b"\x2d" + bytes((k,)), 0.0) for k in range(200)) == 64
    assert queue.put(STOP, 0.0)


@given(st.lists(st.binary(min_size=1, max_size=31), max_size=60))
def test_nothing_but_what_was_replaced_is_lost(packets):
    queue = AirQueue()
    for packet in packets:
        assert queue.put(packet, 0.0)
    out = []
    while (waiting := queue.take()) is not None:
        out.append(waiting.packet)
        is_request(waiting.packet)
    stops = sum(share_of(packet) is Share.STOP for packet in packets)
    lost = len(packets) - len(out)
    assert lost == sum(queue.replaced.values()) + max(0, stops - 1)
    assert set(out) <= set(packets)
