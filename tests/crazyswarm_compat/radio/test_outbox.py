"""What is sent next: traffic classes, hand-over between stream and high-level commander."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crazyarena.crazyswarm_compat.radio.budget import Budget
from crazyarena.crazyswarm_compat.radio.lanes import HighLevelItem, Job, Lane
from crazyarena.crazyswarm_compat.radio.outbox import Outbox, OutboxOptions
from crazyarena.crazyswarm_compat.radio.packets import Packet

STOP = Packet(9, 1, b"\x03")
FEED = Packet(9, 1, b"\x04")
NOTIFY = (7, 1)
GO_TO, LAND, MASK, START = 12, 8, 0, 13


def setpoint(number):
    return (Packet(7, 0, bytes((6, number))),)


def pose(number):
    return (Packet(6, 1, bytes((8, number))),)


class Bench:
    """An outbox and a vehicle that answers when told to, in simulated time."""

    def __init__(self, release=lambda silent, kind: None, budget=None, **options):
        self.now = 0.0
        self.results = []
        self.released = []

        def noted(silent, kind):
            self.released.append((round(self.now, 3), silent, kind))
            return release(silent, kind)

        self.budget = budget or Budget()
        self.box = Outbox(OutboxOptions(**options), self.budget, noted)

    def command(self, code, takes_over=True, upload=None):
        done = lambda result, why: self.results.append((code, result, why))  # noqa: E731
        item = HighLevelItem(Packet(8, 0, bytes((code, 0, 0))), str(code), takes_over, done, upload)
        self.box.command(item, self.now)

    def stream(self, number, kind="full"):
        self.box.setpoint(setpoint(number), kind, self.now)

    def next(self):
        """Packets of the next job that is due now, None if there is none."""
        job = self.box.poll(self.now)
        if not isinstance(job, Job):
            assert job > 0
            return None
        self.box.sent(job, True)
        if job.action is not None:
            job.action()
        for _ in job.packets:
            self.budget.spend(self.now)
        return job

    def all(self):
        """Every packet that is due now, as (port, channel, data)."""
        packets = []
        while (job := self.next()) is not None:
            packets += job.packets
        return packets

    def run(self, until, answer=None, step=0.001):
        """Send what becomes due; ``answer(packet)`` gives the vehicle's answer to high-level
        commands, None for none. Returns (time, packet)."""
        sent = []
        while self.now < until:
            for packet in self.all():
                sent.append((round(self.now, 4), packet))
                if packet.port == 8 and answer is not None:
                    code = answer(packet)
                    if code is not None:
                        self.box.answer(packet.data[0], code, self.now)
            self.now += step
        return sent


def agree(_):
    return 0


class TestOrder:
    def test_most_urgent_first(self):
        bench = Bench()
        bench.box.rest(0.0, (Packet(2, 2, b"x"),))
        bench.box.extpose(pose(1), 0.0)
        bench.stream(1)
        bench.box.feed_watchdog(FEED, 0.0)
        lanes = []
        while (job := bench.next()) is not None:
            lanes.append(job.lane)
        assert lanes == [Lane.WATCHDOG, Lane.SETPOINT, Lane.EXTPOSE, Lane.REST]

    def test_emergency_overtakes_everything_and_drops_what_flies(self):
        bench = Bench()
        bench.stream(1)
        bench.command(GO_TO)
        bench.box.emergency(STOP, 0.0)
        assert bench.next().packets == (STOP,)
        assert bench.results == [(GO_TO, None, "emergency stop")]
        # Nor does anything that flies leave afterwards.
        bench.stream(2)
        bench.command(LAND)
        later = bench.run(2.0)
        assert {packet for _, packet in later} == {STOP}
        assert bench.box.counters[Lane.SETPOINT].snapshot().dropped == 2

    def test_emergency_is_repeated_until_the_vehicle_is_locked(self):
        bench = Bench(emergency_repeats=5, emergency_interval=0.01)
        bench.box.emergency(STOP, 0.0)
        times = [t for t, _ in bench.run(0.5)]
        assert times[:5] == pytest.approx([0, 0.01, 0.02, 0.03, 0.04], abs=2e-3)
        assert 3 <= len(times[5:]) <= 5
        bench.box.emergency_confirmed()
        assert bench.run(3.0) == []

    def test_emergency_outlasts_a_dead_link(self):
        bench = Bench(emergency_repeats=3)
        bench.box.emergency(STOP, 0.0)
        while bench.now < 60.0:
            job = bench.box.poll(bench.now)
            if isinstance(job, Job):
                bench.box.sent(job, False)
            bench.now += 0.1
        assert STOP in [packet for _, packet in bench.run(61.0)]

    def test_newest_wins(self):
        bench = Bench()
        for number in range(5):
            bench.stream(number)
            bench.box.extpose(pose(number), 0.0)
        assert bench.all() == [*setpoint(4), *pose(4)]
        for lane in (Lane.SETPOINT, Lane.EXTPOSE):
            statistics = bench.box.counters[lane].snapshot()
            assert (statistics.offered, statistics.sent, statistics.overwritten) == (5, 1, 4)

    def test_rest_is_in_order_and_bounded(self):
        bench = Bench(capacity=3, rest_rate=1000.0)
        accepted = [bench.box.rest(0.0, (Packet(2, 2, bytes((k,))),)) for k in range(5)]
        assert accepted == [True, True, True, False, False]
        assert [p.data[0] for _, p in bench.run(0.1)] == [0, 1, 2]
        assert bench.box.counters[Lane.REST].snapshot().dropped == 2

    def test_external_poses_are_limited_to_their_rate(self):
        bench = Bench(extpose_rate=50.0)
        sent = 0
        for k in range(240):  # two seconds of a 120 Hz source
            bench.now = k / 120
            bench.box.extpose(pose(k % 256), bench.now)
            sent += len(bench.all())
        assert sent == pytest.approx(100, abs=3)

    def test_what_has_grown_old_is_not_sent(self):
        bench = Bench()
        bench.stream(1)
        bench.box.extpose(pose(1), 0.0)
        bench.command(GO_TO)
        bench.command(LAND)
        bench.now = 5.0
        # The hand-over of the first command is still awaited when the others expire.
        sent = bench.run(8.0)
        assert all(packet.port != 7 or packet.channel == 1 for _, packet in sent)
        assert not any(packet.port in (6, 8) for _, packet in sent)
        assert [result for _, result, _ in bench.results] == [None, None]

    def test_ages_are_counted(self):
        bench = Bench()
        bench.stream(1)
        bench.now = 0.05
        bench.all()
        assert bench.box.counters[Lane.SETPOINT].snapshot().max_age == pytest.approx(0.05)


class TestBudget:
    def test_scarce_air_time_goes_to_setpoints(self):
        budget = Budget(100.0, 4.0)
        bench = Bench(budget=budget, setpoint_rate=1000.0, extpose_rate=1000.0, rest_rate=1000.0)
        counts = dict.fromkeys(Lane, 0)
        for k in range(4000):
            bench.now = k * 1e-3
            if k % 12 == 0:  # 83 setpoints a second leave little room
                bench.stream(k % 256)
            bench.box.extpose(pose(k % 256), bench.now)
            bench.box.rest(bench.now, (Packet(2, 2, b"x"),))
            while (job := bench.next()) is not None:
                counts[job.lane] += 1
        assert counts[Lane.SETPOINT] == pytest.approx(333, abs=15)
        assert sum(counts.values()) <= 4 * 100 + 10
        assert counts[Lane.EXTPOSE] > counts[Lane.REST]

    def test_shared_between_vehicles(self):
        budget = Budget(200.0, 8.0)
        benches = [Bench(budget=budget, extpose_rate=1000.0) for _ in range(4)]
        sent = 0
        for k in range(2000):
            for bench in benches:
                bench.now = k * 1e-3
                bench.box.extpose(pose(k % 256), bench.now)
                sent += len(bench.all())
        assert sent == pytest.approx(400, abs=12)


class TestHandOver:
    def test_command_first_then_the_end_of_the_stream(self):
        bench = Bench()
        bench.stream(1)
        bench.all()
        bench.command(GO_TO)
        (first,) = bench.all()
        assert (first.port, first.data[0]) == (8, GO_TO)
        assert bench.all() == []  # nothing before the vehicle has answered
        bench.box.answer(GO_TO, 0, 0.0)
        assert [(p.port, p.channel) for p in bench.all()] == [NOTIFY]
        assert bench.results == [(GO_TO, 0, "")]

    def test_also_the_first_command_of_a_connection(self):
        # Whoever was connected before may have streamed.
        bench = Bench()
        bench.command(GO_TO)
        sent = bench.run(0.2, agree)
        assert [(p.port, p.channel) for _, p in sent] == [(8, 0), NOTIFY, NOTIFY, NOTIFY]
        # The next one needs none.
        bench.command(LAND)
        assert [p.port for _, p in bench.run(0.4, agree)] == [8]

    def test_a_lost_command_is_repeated_and_the_stream_not_ended_before(self):
        bench = Bench()
        bench.stream(1)
        bench.all()
        bench.command(GO_TO)
        answers = iter([None, None, 0])
        sent = bench.run(0.5, lambda packet: next(answers))
        assert [(p.port, p.channel) for _, p in sent] == [(8, 0)] * 3 + [NOTIFY] * 3
        assert bench.box.counters[Lane.COMMAND].snapshot().repeated == 4

    def test_a_refused_command_does_not_end_the_stream(self):
        bench = Bench(stream_timeout=math.inf)
        bench.stream(1)
        bench.all()
        bench.command(GO_TO)
        sent = bench.run(0.5, lambda packet: 16)
        assert [(p.port, p.channel) for _, p in sent] == [(8, 0)]
        assert bench.results == [(GO_TO, 16, "")]

    def test_an_unanswered_command_is_given_up(self):
        bench = Bench(ack_tries=4, ack_timeout=0.05, stream_timeout=math.inf)
        bench.command(GO_TO)
        sent = bench.run(1.0)
        assert len(sent) == 4
        assert bench.results == [(GO_TO, None, "not answered after 4 tries")]

    def test_declaring_the_stream_over_waits_for_the_command(self):
        # Alone it would stop the motors within 10 ms.
        bench = Bench()
        bench.stream(1)
        bench.all()
        bench.box.setpoints_over(100, bench.now)
        assert bench.run(0.05) == []
        bench.command(LAND)
        sent = bench.run(0.1, agree)
        assert [(p.port, p.channel) for _, p in sent][:2] == [(8, 0), NOTIFY]
        assert bench.released == []

    def test_declaring_twice_or_without_a_stream_does_nothing(self):
        bench = Bench()
        bench.command(GO_TO)
        bench.run(0.2, agree)
        bench.box.setpoints_over(100, bench.now)
        assert bench.run(1.0, agree) == []
        assert bench.released == []

    def test_a_new_setpoint_takes_the_vehicle_back(self):
        bench = Bench()
        bench.stream(1)
        bench.all()
        bench.command(GO_TO)
        bench.all()
        bench.stream(2)
        bench.box.answer(GO_TO, 0, bench.now)
        bench.now += 0.01
        assert bench.all() == [*setpoint(2)]
        assert bench.run(0.2, agree) == []

    def test_commands_before_the_new_setpoint_are_dropped(self):
        bench = Bench()
        bench.stream(1)
        bench.all()
        bench.command(GO_TO)
        bench.command(LAND)
        bench.all()
        bench.stream(2)
        bench.now += 0.01
        assert bench.all() == [*setpoint(2)]
        bench.box.answer(GO_TO, 0, bench.now)
        assert bench.run(0.2, agree) == []
        assert bench.results == [(LAND, None, "a streamed setpoint came after it")]

    def test_a_setpoint_that_was_overtaken_by_a_command_is_not_sent(self):
        bench = Bench()
        bench.stream(1)
        bench.command(GO_TO)
        assert [p.port for p in bench.all()] == [8]

    def test_the_mask_ends_no_stream(self):
        bench = Bench()
        bench.stream(1)
        bench.command(MASK, takes_over=False)
        assert [(p.port, p.channel) for p in bench.all()] == [(7, 0), (8, 0)]
        bench.box.answer(MASK, 0, bench.now)
        assert bench.all() == []

    def test_silence_hands_over_before_the_firmware_acts(self):
        hold = HighLevelItem(Packet(8, 0, bytes((GO_TO, 0, 0))), "hold", True, lambda *_: None)
        bench = Bench(release=lambda silent, kind: hold)
        bench.stream(1, kind="full")
        sent = bench.run(2.0, agree)
        assert [(p.port, p.channel) for _, p in sent] == [(7, 0), (8, 0), NOTIFY, NOTIFY, NOTIFY]
        assert bench.released == [(0.4, True, "full")]
        # Level-out is at 0.5 s, the lock at 2 s.
        assert sent[2][0] < 0.5

    def test_silence_of_a_parked_vehicle_only_ends_the_stream(self):
        bench = Bench()
        bench.stream(1, kind="cut")
        sent = bench.run(2.0)
        assert [(p.port, p.channel) for _, p in sent] == [(7, 0), NOTIFY, NOTIFY, NOTIFY]

    def test_a_steady_stream_is_left_alone(self):
        bench = Bench()
        packets = []
        for k in range(100):
            bench.stream(k)
            packets += bench.run((k + 1) / 30)
        assert all((p.port, p.channel) == (7, 0) for _, p in packets)
        assert bench.released == []

    @settings(max_examples=200)
    @given(
        st.lists(
            st.sampled_from(["stream", "goto", "over", "answer", "refuse", "wait", "pose"]),
            max_size=40,
        )
    )
    def test_the_stream_is_never_ended_without_an_accepted_command(self, script):
        """Ending it without a running plan cuts the motors."""
        bench = Bench(
            release=lambda silent, kind: HighLevelItem(
                Packet(8, 0, bytes((LAND, 0, 0))), "land", True, lambda *_: None
            )
        )
        accepted = False
        for act in script:
            if act == "stream":
                bench.stream(1)
            elif act == "goto":
                bench.command(GO_TO)
            elif act == "over":
                bench.box.setpoints_over(50, bench.now)
            elif act == "pose":
                bench.box.extpose(pose(1), bench.now)
            elif act == "wait":
                bench.now += 0.11
            elif act in ("answer", "refuse"):
                awaiting = bench.box._awaiting
                if awaiting is not None:
                    code = 0 if act == "answer" else 16
                    accepted |= code == 0
                    bench.box.answer(awaiting.item.packet.data[0], code, bench.now)
            for packet in bench.all():
                if (packet.port, packet.channel) == (7, 0):
                    accepted = False  # a setpoint stops the plan
                if (packet.port, packet.channel) == NOTIFY:
                    assert accepted
            bench.now += 0.001


class TestUploads:
    def test_a_start_waits_for_its_upload(self):
        bench = Bench()
        bench.box.upload_begins(5)
        bench.command(START, upload=5)
        assert bench.run(3.0, agree) == []
        bench.box.upload_ends(5, bench.now)
        sent = bench.run(3.1, agree)
        assert (sent[0][1].port, sent[0][1].data[0]) == (8, START)

    def test_a_landing_does_not_wait_for_it(self):
        bench = Bench()
        bench.box.upload_begins(5)
        bench.command(START, upload=5)
        bench.command(LAND)
        sent = bench.run(0.2, agree)
        assert sent[0][1].data[0] == LAND
        assert bench.results[0][:2] == (START, None)
        # It must not start after the landing either.
        bench.box.upload_ends(5, bench.now)
        assert bench.run(1.0, agree) == []


class TestRenewal:
    def test_a_new_connection_forgets_what_waited(self):
        bench = Bench()
        bench.stream(1)
        bench.command(GO_TO)
        bench.box.rest(0.0, (Packet(2, 2, b"x"),))
        bench.box.reset()
        assert bench.all() == []
        assert bench.results == [(GO_TO, None, "the link was renewed")]

    def test_unlocked_after_a_reboot(self):
        bench = Bench()
        bench.box.emergency(STOP, 0.0)
        bench.run(0.3)
        bench.box.unlock()
        bench.stream(1)
        assert bench.all() == [*setpoint(1)]
