"""Ticks on absolute deadlines, and whose fault a late one is."""

import math

import pytest

from crazyarena.clock import VirtualClock
from crazyarena.runner.timing.scheduler import Scheduler
from crazyarena.runner.timing.wakeup import StampedClock


def test_deadlines_are_absolute():
    clock = VirtualClock()
    clock.sleep_until(5.0)
    scheduler = Scheduler(clock, 30.0)
    for _ in range(3000):
        scheduler.wait()
    assert clock.now() == 5.0 + 3000 / 30.0
    assert scheduler.step == 3000
    assert scheduler.lateness.max() == 0.0
    assert len(scheduler.lateness) == 3000


def test_late_wake_ups_are_recorded_and_whole_periods_skipped():
    class Slow:
        time = 0.0

        def now(self):
            return self.time

        def sleep_until(self, deadline):
            self.time = max(self.time, deadline)
            return self.time - deadline

    clock = Slow()
    scheduler = Scheduler(clock, 10.0)
    clock.time = 0.15
    assert scheduler.wait() == pytest.approx(0.05)
    assert (scheduler.step, scheduler.skipped) == (1, 0)
    clock.time = 0.55
    scheduler.wait()
    assert (scheduler.step, scheduler.skipped) == (5, 3)
    scheduler.wait()
    assert clock.time == pytest.approx(0.6)


class Told(StampedClock):
    """A clock that is as late as it is told to be."""

    def __init__(self):
        super().__init__()
        self.time = 0.0
        self.late = 0.0
        self.blamed = math.nan

    def now(self):
        return self.time

    def sleep_until(self, deadline):
        self.time = deadline + self.late
        self.machine_late = self.blamed
        self.standstill = 0.5 * self.blamed
        return self.late


@pytest.mark.parametrize(
    ("blamed", "own"), [(0.34, 0), (0.26, 0), (0.24, 1), (0.05, 3), (math.nan, 3)]
)
def test_what_the_machine_caused_is_not_ours(blamed, own):
    clock = Told()
    scheduler = Scheduler(clock, 10.0)
    clock.late, clock.blamed = 0.35, blamed
    scheduler.wait()
    assert (scheduler.step, scheduler.skipped, scheduler.skipped_own) == (4, 3, own)
    machine, ours = scheduler.shares
    if math.isnan(blamed):
        assert len(machine) == len(ours) == 0
    else:
        assert machine[0] == pytest.approx(blamed)
        assert ours[0] == pytest.approx(0.35 - blamed)
        assert scheduler.standstill[0] == pytest.approx(0.5 * blamed)
    clock.late = 0.0
    scheduler.wait()
    assert (scheduler.step, scheduler.skipped, scheduler.skipped_own) == (5, 3, own)
