"""The ground station of a campaign flight over UDP, in virtual time."""

from __future__ import annotations

import threading
from types import SimpleNamespace

import numpy as np
import pytest

from crazyarena.clock import VirtualClock
from crazyarena.crazyswarm_compat import commands as c
from crazyarena.runner.campaign.plan import draw_plan
from crazyarena.runner.campaign.setting import MISSION
from crazyarena.runner.campaign.udp.station import Station


class Ground:
    """A rig in virtual time, with a guard that notes what it is told."""

    def __init__(self):
        self.clock = VirtualClock()
        self.backend = self.safeguard = self
        self.pipeline = SimpleNamespace(
            estimate=lambda body: SimpleNamespace(
                state=SimpleNamespace(position=np.array([0.0, 0.0, 1.0]))
            )
        )
        self.sent, self.answers, self.lateness = [], [], []
        self.taken = None
        self.done_at = None

    def send(self, command, vehicle):
        self.sent.append((self.clock.now(), command))

    def begin(self):
        self.begun = self.clock.now()

    def answered(self):
        self.answers.append(self.clock.now())

    def late(self, seconds):
        self.lateness.append(seconds)

    def verdict(self):
        return self.taken

    def end(self):
        self.done_at = self.clock.now()
        return self.taken is not None


def flown(fault, until=12.0, on_advance=lambda ground, now: None):
    """The station's side of a flight that takes off at 1 s."""
    ground, ended = Ground(), threading.Event()

    def advance(now):
        on_advance(ground, now)
        if now >= until:
            ended.set()

    ground.clock.on_advance(advance)
    plan = draw_plan(fault, 0)
    clock = ground.clock
    Station(fault, plan, ground, lambda stall: clock.sleep_until(clock.now() + stall)).fly(
        1.0, ended
    )
    return ground, 1.0 + plan.onset


def test_contestant_flies_the_circuit_and_lands():
    ground, _ = flown("mocap_freeze")
    circuit = draw_plan("mocap_freeze", 0).circuit
    streamed = [(t, m) for t, m in ground.sent if isinstance(m, c.FullState)]
    assert ground.begun == 1.0
    assert len(streamed) == pytest.approx(30 * MISSION, abs=2)
    for time, setpoint in streamed[::40]:
        np.testing.assert_allclose(setpoint.position, circuit.at(time - 1.0).position)
    landing = [m for t, m in ground.sent if t >= 1.0 + MISSION]
    assert [type(m) for m in landing] == [c.NotifySetpointsStop, c.Land]
    assert ground.done_at == pytest.approx(1.0 + MISSION, abs=0.04)


def test_contestant_goes_mad_at_the_onset():
    ground, onset = flown("nan")
    for time, setpoint in ground.sent:
        if isinstance(setpoint, c.FullState):
            assert np.isfinite(setpoint.position).all() == (time < onset)


def test_contestant_falls_silent_at_the_onset():
    ground, onset = flown("silent", until=8.0)
    assert max(ground.answers) < onset
    assert max(time for time, _ in ground.sent) < onset


def test_control_loop_is_late():
    ground, onset = flown("late_scheduler")
    before = round(30 * (onset - 1.0))
    assert max(ground.lateness[:before]) < 0.001
    # It sleeps through ticks, and says so.
    times = [time for time, m in ground.sent if isinstance(m, c.FullState)]
    assert max(np.diff(times)) > 0.05


def test_who_has_lost_the_vehicle_sends_nothing_more():
    def take(ground, now):
        if now >= 3.0:
            ground.taken = "fence"

    ground, _ = flown("wall", until=12.0, on_advance=take)
    assert max(time for time, _ in ground.sent) < 3.04
