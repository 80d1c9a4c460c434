"""Threads that fetch a sleeper whose processor stands still."""

import multiprocessing
import os
import select
import threading
import time

import pytest

from crazyarena.runner.timing.libc import call
from crazyarena.runner.timing.lookouts import ASLEEP, GENERATION, Lookouts, as_timespec
from crazyarena.runner.timing.wakeup import StampedClock

PROCESSORS = os.sched_getaffinity(0)
several = pytest.mark.skipif(len(PROCESSORS) < 2, reason="needs two processors")


@pytest.fixture
def lookouts():
    lookouts = Lookouts()
    yield lookouts
    lookouts.close()
    assert os.sched_getaffinity(0) == PROCESSORS


def expect(lookouts, ahead):
    lookouts.expect(*as_timespec(time.monotonic() + ahead))


def readable(lookouts, timeout):
    return bool(select.select([lookouts.descriptor], [], [], timeout)[0])


@several
def test_a_sleeper_that_is_not_up_is_fetched(lookouts):
    for _ in range(20):
        expect(lookouts, 0.01)
        lookouts.orders[ASLEEP] = lookouts.orders[GENERATION]
        before = lookouts.fetched
        assert readable(lookouts, 20.0)
        lookouts.orders[ASLEEP] = 0
        # It is where its lookout is, and nowhere else.
        assert len(os.sched_getaffinity(0)) == 1
        lookouts.release()
        assert lookouts.fetched > before


@several
def test_who_is_up_is_left_alone(lookouts):
    expect(lookouts, 0.01)
    assert not readable(lookouts, 0.1)
    # Nor is it fetched for a deadline that is not there any more.
    stale = int(lookouts.orders[GENERATION])
    expect(lookouts, 0.01)
    lookouts.orders[ASLEEP] = stale
    assert not readable(lookouts, 0.1)
    assert lookouts.fetched == 0


@several
def test_a_new_deadline_replaces_the_old_one(lookouts):
    expect(lookouts, 3600.0)
    expect(lookouts, 0.01)
    lookouts.orders[ASLEEP] = lookouts.orders[GENERATION]
    assert readable(lookouts, 20.0)


@several
def test_how_late_a_processor_was_is_known_after_the_deadline(lookouts):
    assert lookouts.late_here() is None
    expect(lookouts, 0.02)
    assert lookouts.late_here() is None
    end = time.monotonic() + 20.0
    while (late := lookouts.late_here()) is None:
        assert time.monotonic() < end
    assert late >= 0.0
    assert 0.0 < lookouts.first_awake() < float("inf")
    expect(lookouts, 3600.0)
    assert lookouts.late_here() is None
    assert lookouts.first_awake() == float("inf")


def test_leaves_nothing_behind():
    threads, files = threading.active_count(), len(os.listdir("/proc/self/fd"))
    lookouts = Lookouts()
    expect(lookouts, 3600.0)
    lookouts.close()
    lookouts.close()
    assert (threading.active_count(), len(os.listdir("/proc/self/fd"))) == (threads, files)
    assert os.sched_getaffinity(0) == PROCESSORS


def test_one_processor_has_nobody_to_look_out():
    def alone():
        os.sched_setaffinity(0, {min(PROCESSORS)})
        lookouts = Lookouts()
        notes.append(lookouts.note)
        expect(lookouts, 0.0)
        notes.append(lookouts.late_here())
        lookouts.close()

    notes: list[object] = []
    thread = threading.Thread(target=alone)
    thread.start()
    thread.join()
    assert notes[0].startswith("nobody looks out")
    assert notes[1] is None


def occupy(processor, seconds, ready):
    """Let nothing else run on a processor for a while, as a hypervisor may."""
    os.sched_setaffinity(0, {processor})
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(60))
    ready.set()
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        pass


def may_occupy():
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(1))
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    except OSError:
        return False
    return True


@several
@pytest.mark.skipif(not may_occupy(), reason="needs real-time priorities")
def test_a_processor_that_stands_still_delays_nobody():
    context = multiprocessing.get_context("spawn")
    clock = StampedClock()
    stall = 0.3  # s
    with clock.watched() as note:
        assert note.startswith("lookouts on processors")
        (home,) = os.sched_getaffinity(0)
        ready = context.Event()
        process = context.Process(target=occupy, args=(home, stall, ready), daemon=True)
        process.start()
        # From another processor the start of the occupation can be waited for.
        os.sched_setaffinity(0, PROCESSORS - {home})
        assert ready.wait(30.0)
        deadline = clock.now() + 0.05
        clock.expect(deadline)
        # Only now, asleep, is it made to belong to the processor that stands still.
        me = threading.get_native_id()
        threading.Timer(0.01, os.sched_setaffinity, (me, {home})).start()
        late = clock.sleep_until(deadline)
        assert call("sched_getcpu")() != home
        assert late < 0.5 * (stall - 0.05)
        process.join()
    assert os.sched_getaffinity(0) == PROCESSORS
