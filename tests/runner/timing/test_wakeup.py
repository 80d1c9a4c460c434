"""The clock that knows when it was woken."""

import contextlib
import math
import os
import signal
import threading

import pytest

from crazyarena.runner.timing.wakeup import StampedClock


@pytest.fixture(scope="module")
def clock():
    return StampedClock()


@pytest.mark.parametrize("watched", [False, True])
def test_sleeps_until_the_deadline_and_tells_who_was_late(clock, watched):
    if watched:
        with clock.watched():
            keep_ticks(clock)
    else:
        keep_ticks(clock)


def keep_ticks(clock):
    known = 0
    for _ in range(30):
        deadline = clock.now() + 0.005
        late = clock.sleep_until(deadline)
        assert clock.now() >= deadline
        # Put aside until the deadline has passed, it does not sleep.
        if not math.isnan(clock.machine_late):
            known += 1
            assert 0.0 <= clock.standstill <= clock.machine_late <= late
    assert known


def test_a_deadline_that_has_passed_is_nobodys_sleep(clock):
    late = clock.sleep_until(clock.now() - 0.5)
    assert late >= 0.5
    assert math.isnan(clock.machine_late)


def test_our_own_delay_is_not_put_down_to_the_machine(clock):
    with clock.watched():
        deadline = clock.now() + 0.02
        clock.expect(deadline)
        while clock.now() < deadline + 0.1:
            pass
        late = clock.sleep_until(deadline)
    assert late >= 0.1
    # Unknown where there is no lookout; a machine that stood still meanwhile is the rest.
    assert math.isnan(clock.machine_late) or clock.machine_late <= late


def test_dozes_until_something_arrives(clock):
    read, write = os.pipe()
    try:
        begin = clock.now()
        clock.expect(begin + 60.0)
        os.write(write, b"x")
        clock.doze(begin + 60.0, read)
        assert clock.now() - begin < 30.0
        os.read(read, 1)
        until = clock.now() + 0.02
        clock.doze(until, read)
        assert clock.now() >= until
    finally:
        os.close(read)
        os.close(write)


@pytest.mark.parametrize("watched", [False, True])
def test_a_signal_is_heard_in_its_sleep(clock, watched):
    class Heard(Exception):
        pass

    def hear(number, frame):
        raise Heard

    before = signal.signal(signal.SIGUSR1, hear)
    main = threading.main_thread().ident
    ringing = threading.Timer(0.05, signal.pthread_kill, (main, signal.SIGUSR1))
    try:
        ringing.start()
        begin = clock.now()
        with clock.watched() if watched else contextlib.nullcontext(), pytest.raises(Heard):
            clock.sleep_until(begin + 60.0)
        assert clock.now() - begin < 30.0
    finally:
        ringing.join()
        signal.signal(signal.SIGUSR1, before)
