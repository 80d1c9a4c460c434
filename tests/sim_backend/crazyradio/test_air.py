"""Who hears whom, and what is lost."""

import pytest

from crazyarena.sim_backend.crazyradio.air import BROADCAST, Frame, InUse, Unplugged
from crazyarena.sim_backend.crazyradio.air_time import Rate, on_air
from tests.sim_backend.crazyradio.on_air import ADDRESS, Vehicle, air_with

SERIAL = "E7E7000001"


def _frame(payload=b"\x30x", channel=80, rate=Rate.M2, address=ADDRESS, **changes):
    return Frame(channel, rate, address, payload, **changes)


@pytest.mark.parametrize(
    "wrong", [{"channel": 81}, {"rate": Rate.M1}, {"address": bytes.fromhex("e7e7e7e702")}]
)
def test_only_the_right_channel_rate_and_address_are_heard(wrong):
    vehicle = Vehicle()
    air = air_with(vehicle)
    assert not air.exchange(SERIAL, _frame(**wrong), 0.0).acked
    assert vehicle.got == []
    assert air.exchange(SERIAL, _frame(), 1.0).acked
    assert vehicle.got == [b"\x30x"]


def test_an_acknowledged_frame_takes_its_time():
    outcome = air_with(Vehicle()).exchange(SERIAL, _frame(b"\x30" + bytes(29)), 0.0)
    # Two turn-rounds, thirty bytes up, three down.
    expected = 2 * 130e-6 + on_air(30, Rate.M2) + on_air(3, Rate.M2)
    assert outcome.duration == pytest.approx(expected)
    assert outcome.retries == 0
    assert outcome.strong


def test_nobody_there_takes_every_attempt_and_every_wait():
    outcome = air_with().exchange(SERIAL, _frame(b"\xff", retries=3, ack_wait=500e-6), 0.0)
    assert outcome.duration == pytest.approx(4 * (130e-6 + on_air(1, Rate.M2) + 500e-6))
    assert (outcome.acked, outcome.retries) == (False, 3)


def test_loss_is_of_single_attempts_and_shows_as_time():
    vehicle = Vehicle(loss=0.2, ack_loss=0.2)
    air = air_with(vehicle)
    outcomes = [air.exchange(SERIAL, _frame(b"\xff"), 0.01 * k) for k in range(4000)]
    share = sum(not outcome.acked for outcome in outcomes) / len(outcomes)
    # An attempt fails with 1 - 0.8², all four with its fourth power.
    assert share == pytest.approx(0.36**4, abs=0.006)
    times = [sum(o.duration for o in outcomes if o.retries == n and o.acked) for n in (0, 1)]
    assert times[1] > 0
    slow = [o.duration for o in outcomes if o.acked and o.retries == 2]
    fast = [o.duration for o in outcomes if o.acked and o.retries == 0]
    assert min(slow) > max(fast) + 2 * 500e-6


def test_loss_over_time_noise_and_range():
    vehicle = Vehicle(loss=lambda now: 1.0 if 5.0 <= now < 6.0 else 0.0)
    air = air_with(vehicle)
    acked = [air.exchange(SERIAL, _frame(), t).acked for t in (4.9, 5.5, 6.1)]
    assert acked == [True, False, True]
    air.noise = lambda channel, now: 1.0 if channel == 80 else 0.0
    assert not air.exchange(SERIAL, _frame(), 7.0).acked
    air.noise = None
    vehicle.station.in_range = False
    assert not air.exchange(SERIAL, _frame(), 8.0).acked
    vehicle.station.in_range, vehicle.station.silent_until = True, 9.0
    assert not air.exchange(SERIAL, _frame(), 8.5).acked
    assert air.exchange(SERIAL, _frame(), 9.0).acked


def test_a_broadcast_reaches_every_vehicle_of_its_channel_and_nobody_answers():
    near = [Vehicle(bytes.fromhex(f"e7e7e7e70{k}")) for k in (1, 2)]
    far = Vehicle(bytes.fromhex("e7e7e7e703"), channel=90)
    air = air_with(*near, far)
    outcome = air.exchange(SERIAL, _frame(address=BROADCAST, acked=False), 0.0)
    assert not outcome.acked
    assert [vehicle.got for vehicle in near] == [[b"\x30x"], [b"\x30x"]]
    assert far.got == []
    # With acknowledgements on, the dongle repeats what nobody answers.
    air.exchange(SERIAL, _frame(address=BROADCAST, retries=3), 1.0)
    assert len(near[0].got) == 5


def test_two_dongles_on_neighbouring_channels_collide():
    air = air_with(Vehicle(), Vehicle(channel=81), serials=("A", "B"))
    air.exchange("A", _frame(channel=81), 0.0)
    outcome = air.exchange("B", _frame(), 0.0001)
    assert outcome.acked
    assert outcome.retries > 0
    assert air.counters.collisions > 0
    air.exchange("A", _frame(channel=90), 1.0)
    assert air.exchange("B", _frame(), 1.0001).retries == 0


def test_dongles_are_plugged_and_held():
    air = air_with(Vehicle(), serials=("A", "B"))
    air.plug("A", False)
    assert air.dongles() == ("B",)
    with pytest.raises(Unplugged):
        air.exchange("A", _frame(), 0.0)
    with pytest.raises(Unplugged):
        air.claim("C")
    air.claim("B", "one", now=0.0, lease=2.0)
    with pytest.raises(InUse):
        air.claim("B", "two", now=1.0, lease=2.0)
    air.release("B", "two")
    with pytest.raises(InUse):
        air.claim("B", "two", now=1.0, lease=2.0)
    air.claim("B", "two", now=3.0, lease=2.0)  # the first has said nothing for too long
    air.release("B", "two")
    air.claim("B", "one", now=3.5, lease=2.0)
