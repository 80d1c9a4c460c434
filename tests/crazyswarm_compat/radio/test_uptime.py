"""A restart is noticed by the stamps of log data, and what a link does to them is none."""

from hypothesis import given
from hypothesis import strategies as st

from crazyarena.crazyswarm_compat.radio.uptime import Uptime

TICKS = 1 << 24


def stamps(booted, times):
    return [(round(1e3 * (time - booted)) % TICKS, time) for time in times]


def told(sequence):
    uptime = Uptime()
    return [index for index, (stamp, now) in enumerate(sequence) if uptime.restarted(stamp, now)]


@given(
    st.floats(-40_000.0, 0.0),
    st.lists(st.tuples(st.floats(0.05, 3.0), st.floats(0.0, 1.5)), max_size=60),
)
def test_delays_and_gaps_are_no_restart(booted, steps):
    sequence, time = [], 0.0
    for gap, delay in steps:
        time += gap
        arrived = max(time + delay, sequence[-1][1] if sequence else 0.0)  # links keep the order
        sequence.append((stamps(booted, [time])[0][0], arrived))
    assert told(sequence) == []


def test_what_waited_in_the_vehicle_is_no_restart():
    before = stamps(-30.0, [0.1 * k for k in range(20)])
    waited = [(stamp, 8.0) for stamp, _ in stamps(-30.0, [2.0 + 0.1 * k for k in range(10)])]
    after = stamps(-30.0, [8.0 + 0.1 * k for k in range(40)])
    assert told(before + waited + after) == []


def test_a_computer_that_lags_is_no_restart():
    lagging = [(stamp, now + 6.0) for stamp, now in stamps(-30.0, [0.1 * k for k in range(20, 90)])]
    before, after = stamps(-30.0, [0.1 * k for k in range(20)]), stamps(-30.0, [16.0, 16.1])
    assert told(before + lagging + after) == []


@given(st.floats(5.0, 10_000.0), st.floats(0.5, 20.0))
def test_a_restart_is_told_once(up, out):
    before = stamps(-up, [0.1 * k for k in range(20)])
    after = stamps(2.0 + 0.5 * out, [2.0 + out + 0.1 * k for k in range(40)])
    assert len(told(before + after)) == 1


def test_a_restart_long_ago_is_told_when_it_is_sure():
    before = stamps(-3.0, [0.1 * k for k in range(20)])
    after = stamps(4.0, [60.0 + 0.1 * k for k in range(40)])
    (index,) = told(before + after)
    assert 20 <= index < 40
