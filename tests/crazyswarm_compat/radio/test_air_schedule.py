"""The schedule of a dongle on simulated time, over cflib's dongle code and the virtual radio."""

import numpy as np
import pytest
import usb.core
from cflib.drivers.crazyradio import Crazyradio

from crazyarena.clock import VirtualClock
from crazyarena.crazyswarm_compat.radio import packets as pk
from crazyarena.crazyswarm_compat.radio.air_queue import Share
from crazyarena.crazyswarm_compat.radio.air_schedule import AirSchedule, DongleStatistics, in_pairs
from crazyarena.crazyswarm_compat.radio.air_watch import AirWatch
from crazyarena.crazyswarm_compat.radio.ground_link import GroundLink, Tuning
from crazyarena.crazyswarm_compat.radio.pose_cast import Channel, Member, PoseCast
from crazyarena.sim_backend.crazyradio.usb_backend import VirtualUsb
from crazyarena.types import Pose
from tests.sim_backend.crazyradio.on_air import Vehicle, air_with

STOP = b"\x9d\x03"
POSITION = b"\x7c\x07"


class Bench:
    """Vehicles, one dongle, and a clock that only the radio moves."""

    def __init__(self, count, **station):
        self.clock = VirtualClock()
        self.vehicles = [
            Vehicle(bytes.fromhex(f"e7e7e7e7{k + 1:02x}"), **station) for k in range(count)
        ]
        air = air_with(*self.vehicles, seed=3)
        self.radio = Crazyradio(device=usb.core.find(backend=VirtualUsb(air, self.clock)))
        self.statistics = DongleStatistics()
        self.schedule = AirSchedule(self.clock, self.statistics)
        self.lost = {}
        self.links = [
            GroundLink(Tuning(80, 2, tuple(v.station.address)), None, None) for v in self.vehicles
        ]

    def until(self, end, each=None):
        while self.clock.now() < end:
            if each is not None:
                each(self.clock.now())
            turn = self.schedule.choose(self.links, self.clock.now())
            if isinstance(turn, float):
                self.clock.sleep_until(self.clock.now() + max(turn, 1e-4))
                continue
            _, why = self.schedule.carry_out(turn, self.radio)
            if why is not None:
                self.lost[self.links.index(turn.link)] = why

    def settle(self):
        self.until(self.clock.now() + 0.2)
        assert all(link.safe for link in self.links)
        for vehicle in self.vehicles:
            vehicle.got.clear()


def test_requests_are_answered_and_packets_come_in_order():
    bench = Bench(2)
    bench.settle()
    for k in range(20):
        bench.vehicles[1].receiver.say(bytes((0x52, k)))
    bench.links[0].queue.put(b"\x5d\x03", bench.clock.now())
    bench.until(bench.clock.now() + 0.1)
    assert [packet[:2] for packet in bench.vehicles[0].got] == [b"\x5d\x03"] or (
        bench.vehicles[0].got[0][1:] == b"\x03"
    )
    got = [bench.links[1].incoming.get_nowait().data[0] for _ in range(20)]
    assert got == list(range(20))
    assert bench.links[1].incoming.empty()


@pytest.mark.parametrize("loss", [0.0, 0.2])
def test_a_stop_reaches_eight_vehicles_at_once_through_full_traffic(loss):
    bench = Bench(8, loss=loss, ack_loss=loss)
    bench.until(0.5)
    asked = 1.0

    def traffic(now):
        for link in bench.links:
            link.queue.put(POSITION + bytes(16), now)
            link.queue.put(b"\x60" + bytes(12), now)
            link.queue.put(b"\xfc\xca\0\0\0\0", now)
        if now >= asked:
            for link in bench.links:
                if link not in stopped:
                    stopped.append(link)
                    link.queue.put(STOP, now)

    stopped = []
    bench.until(asked, traffic)
    for vehicle in bench.vehicles:
        vehicle.got.clear()
    arrived = {}

    def watch(now):
        traffic(now)
        for index, vehicle in enumerate(bench.vehicles):
            stopped_now = any(p[0] >> 4 == 9 and p[1:] == STOP[1:] for p in vehicle.got)
            if index not in arrived and stopped_now:
                arrived[index] = now

    bench.until(asked + 0.2, watch)
    assert len(arrived) == 8
    # One exchange each, after the one under way; more with losses.
    assert max(arrived.values()) - asked < (0.02 if loss == 0.0 else 0.06)


def test_what_falls_when_everything_is_asked_for():
    """Setpoints get through; poses are thinned but never gone; the rest waits."""
    bench = Bench(6)
    bench.settle()

    def traffic(now):
        for link in bench.links:
            link.queue.put(POSITION + bytes(16), now)
            link.queue.put(b"\x60" + bytes(12), now)

    begin, before = bench.clock.now(), dict(bench.statistics.exchanges)
    bench.until(begin + 2.0, traffic)
    shares = {share: n - before[share] for share, n in bench.statistics.exchanges.items()}
    for vehicle in bench.vehicles:
        poses = sum(packet[0] >> 4 == 6 for packet in vehicle.got) / 2.0
        setpoints = sum(packet[0] >> 4 == 7 for packet in vehicle.got) / 2.0
        assert poses > 15
        assert setpoints > 2 * poses
    assert shares[Share.POLL] < 0.05 * sum(shares.values())


def test_a_silent_vehicle_is_told_of_and_costs_the_others_little():
    bench = Bench(3)
    bench.settle()
    bench.vehicles[0].station.in_range = False
    begin = bench.clock.now()
    bench.until(begin + 3.0)
    assert list(bench.lost) == [0]
    assert "too many packets lost" in bench.lost[0]
    assert bench.statistics.unanswered < 100
    bench.vehicles[0].station.in_range = True
    bench.until(bench.clock.now() + 0.5)
    assert bench.vehicles[0].receiver.counters.heard > 10


def test_packed_poses_reach_everybody_in_few_transfers():
    bench = Bench(5)
    bench.settle()
    channel = Channel(bench.schedule, 80, 2)
    channel.members += [Member(10 + k, k + 1) for k in range(5)]
    cast = PoseCast([channel], rate=100.0)
    poses = {10 + k: Pose(np.array([0.1 * k, 0.0, 1.0])) for k in range(5)}
    poses[13] = Pose(np.array([0.0, 0.0, 1.0]), np.full(4, np.nan))
    served = cast.send(poses, bench.clock.now())
    assert served == {10, 11, 12, 14}  # a position alone goes by itself
    assert cast.send(poses, bench.clock.now()) == served  # too soon for another
    bench.until(bench.clock.now() + 0.02)
    expected = {1, 2, 3, 5}
    for vehicle in bench.vehicles:
        frames = [packet for packet in vehicle.got if packet[:2] == b"\x61\x09"]
        ids = {frame[2 + 11 * k] for frame in frames for k in range((len(frame) - 2) // 11)}
        assert ids == expected
    assert bench.statistics.broadcasts == 1
    assert bench.radio.send_packet(b"\xff").ack is not None  # acknowledgements are on again


def test_two_vehicles_are_not_worth_a_broadcast():
    bench = Bench(2)
    channel = Channel(bench.schedule, 80, 2, [Member(1, 1), Member(2, 2)])
    assert PoseCast([channel], 100.0).send({1: Pose(np.zeros(3))}, 0.0) == set()


def test_the_same_last_byte_on_one_channel_is_served_once():
    bench = Bench(3)
    members = [Member(1, 1), Member(2, 2), Member(3, 3), Member(4, 1)]
    channel = Channel(bench.schedule, 80, 2, members)
    poses = {k: Pose(np.zeros(3)) for k in (1, 2, 3, 4)}
    assert PoseCast([channel], 100.0).send(poses, 0.0) == {1, 2, 3}


def test_pairs():
    assert in_pairs([b"a" * 24, b"b" * 24, b"c" * 13]) == [b"a" * 24 + b"b" * 24, b"c" * 13]
    assert in_pairs([b"a" * 24, b"b" * 13]) == [b"a" * 24, b"b" * 13]
    # Together they fit into one packet, so that the dongle would not split them.
    assert in_pairs([b"a" * 13, b"b" * 13]) == [b"a" * 13, b"b" * 13]


def test_logs_give_way_by_steps_and_come_back():
    statistics = DongleStatistics()
    watch = AirWatch(statistics, lambda: 0)
    told = []
    now = 1.0

    def second(busy, polls):
        nonlocal now
        statistics.busy += busy
        statistics.exchanges[Share.FLIGHT] += 100 - polls
        statistics.exchanges[Share.POLL] += polls
        now += 1.0
        told.extend(watch.look(now))

    watch.look(now)
    second(1.0, 50)
    assert told == []  # half of it had nothing to say
    for _ in range(4):
        second(1.0, 2)
    assert [verdict.divisor for verdict in told] == [2, 4]
    for _ in range(12):
        second(0.9, 80)
    assert [verdict.divisor for verdict in told] == [2, 4, 2, 1]


def test_thinned_poses_are_told_of_once_and_when_they_are_over():
    statistics = DongleStatistics()
    watch = AirWatch(statistics, lambda: 0)
    watch.look(1.0)
    verdicts = []
    for now in range(2, 8):
        statistics.broadcasts += 50
        statistics.overtaken += 50 if now < 5 else 0
        verdicts += watch.look(float(now))
    assert [(v.what, v.fallen) for v in verdicts] == [("poses", 0.5), ("poses", 0.0)]


def test_packable_ids_are_those_of_the_addresses():
    (packet,) = pk.packed_poses([(0x1E7, Pose(np.zeros(3)))])
    assert packet.data[1] == 0xE7
