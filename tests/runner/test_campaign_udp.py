"""The fault campaign over the virtual radio: its two processes in virtual time, and flights."""

from __future__ import annotations

import json
import math
import threading
from dataclasses import asdict
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

from crazyarena.clock import VirtualClock
from crazyarena.crazyswarm_compat import commands as c
from crazyarena.errors import InputError
from crazyarena.levels import load_level
from crazyarena.mocap.camera_model import CameraModel
from crazyarena.mocap.sim_source import SimSource
from crazyarena.runner import campaign_field, campaign_station, campaign_udp
from crazyarena.runner.campaign import _BOOT, _MISSION, FAULTS, Flight, failures
from crazyarena.runner.campaign_field import ArenaCameras, FaultyRadio, Field
from crazyarena.runner.campaign_plan import draw_plan
from crazyarena.runner.campaign_station import Station
from crazyarena.runner.cli import make_app
from crazyarena.safety.events import Action, SafetyEvent
from crazyarena.safety.fence import Fence
from crazyarena.safety.monitors import LOCKED
from crazyarena.sim_backend.crtp.faults import Faults
from crazyarena.types import Pose

ARENA = load_level("level0").arena


@pytest.mark.parametrize(("fault", "seed"), [("wall", 1), ("mocap_jump", 3)])
def test_it_is_the_flight_of_the_simulation(fault, seed):
    plan, flight = draw_plan(fault, seed), Flight(fault, seed, load_level("level0"))
    assert plan.onset == pytest.approx(flight.onset - _BOOT)
    assert plan.mellinger == flight.mellinger
    np.testing.assert_array_equal(plan.plant, flight.plant)
    for time in (0.0, 1.0, 5.0):
        there = flight.circuit.at(time)
        np.testing.assert_array_equal(plan.circuit.at(time).position, there.position)
    assert plan.rng.getstate() == flight.rng.getstate()


def test_every_fault_has_its_place():
    struck = campaign_field.STRIKES | campaign_station.STRIKES | {campaign_udp.KILLED}
    assert struck == set(campaign_udp.UDP_FAULTS)
    assert set(FAULTS) - struck == {"identity_swap", "tilt"}
    both = campaign_field.STRIKES & campaign_station.STRIKES
    assert both == {"radio_cut_at_wall"}


# The far side


class Vehicle:
    """A fleet of one that is where the test puts it."""

    def __init__(self):
        self.state = SimpleNamespace(position=np.array([0.0, 0.0, 0.03]), velocity=np.zeros(3))
        self.motors = np.zeros(4)
        self.info = 0

    def true_state(self, index):
        return self.state

    def rows(self, index):
        return SimpleNamespace(motors=self.motors)

    def supervisor_info(self, index):
        return self.info


class Server:
    def __init__(self):
        self.links = [SimpleNamespace(faults=Faults())]

    def set_faults(self, **changes):
        for name, value in changes.items():
            setattr(self.links[0].faults, name, value)


def far_side(fault):
    """The far side of a flight with this fault, at time 0."""
    clock, vehicle, server = VirtualClock(), Vehicle(), Server()
    source = SimSource(clock, None, CameraModel(rate=100.0), 1)
    cameras = ArenaCameras(source, clock)
    plan = draw_plan(fault, 0)
    reports = []
    field = Field(
        fault,
        plan,
        Fence.from_arena(ARENA),
        clock,
        vehicle,
        cameras,
        FaultyRadio(server),
        reports.append,
    )

    def watch(until):
        while clock.now() < until - 1e-9:
            clock.sleep_until(clock.now() + 0.004)
            field.look()

    def see():
        """Poses of the next few frames."""
        seen = []
        while len(seen) < 5 and clock.now() < 60.0:
            clock.sleep_until(clock.now() + 0.01)
            while cameras.next_exposure <= clock.now():
                cameras.expose(cameras.next_exposure, {"cf1": Pose(np.array([1.0, 0.0, 1.0]))})
            seen += [frame.bodies["cf1"].position for frame in cameras.frames()]
        return seen

    return SimpleNamespace(
        field=field,
        plan=plan,
        vehicle=vehicle,
        faults=server.links[0].faults,
        reports=reports,
        watch=watch,
        see=see,
    )


def test_the_report_is_of_what_truly_happened():
    far = far_side("wall")
    far.watch(0.5)
    far.field.begin(1.0)
    onset = 1.0 + far.plan.onset
    far.watch(2.0)
    far.vehicle.state.position[2] = 1.0
    far.vehicle.motors[:] = 30000.0
    far.watch(onset - 0.5)
    far.vehicle.state.velocity[0] = 1.5
    far.watch(onset + 0.5)
    far.vehicle.state.position[0] = ARENA.high[0] + 0.2
    far.watch(onset + 1.0)
    far.vehicle.state.position[0] = ARENA.high[0] - 0.5
    far.vehicle.motors[:] = 0.0
    far.watch(onset + 3.0)
    assert not far.reports, "it still falls"
    far.vehicle.state.velocity[0] = 0.0
    far.vehicle.info = LOCKED
    far.watch(onset + 5.0)
    (report,) = far.reports
    assert report["excursion"] == pytest.approx(0.2)
    assert report["safe_after"] == pytest.approx(1.0, abs=0.01)
    assert report["speed"] == pytest.approx(1.5)
    assert report["locked"]
    assert far.faults == Faults(), "a fault of the ground station's"


def test_a_flight_that_does_not_end_is_reported():
    far = far_side("silent")
    far.field.begin(0.0)
    far.vehicle.state.position[2] = 1.0
    far.vehicle.motors[:] = 30000.0
    far.watch(40.0)
    (report,) = far.reports
    assert report["safe_after"] is None


def test_the_radio_is_cut_at_its_time():
    far = far_side("radio_cut")
    far.field.begin(1.0)
    far.watch(0.99 + far.plan.onset)
    assert far.faults.cut_until == -math.inf
    far.watch(1.01 + far.plan.onset)
    assert far.faults.cut_until == math.inf
    assert far.field.link.cut


def test_packets_are_lost():
    far = far_side("radio_loss")
    far.field.begin(0.0)
    far.watch(far.plan.onset + 0.01)
    assert 0.2 <= far.faults.loss <= 0.7


def test_the_radio_comes_and_goes():
    far = far_side("radio_burst")
    far.field.begin(0.0)
    far.watch(far.plan.onset)
    states = set()
    for _ in range(300):
        far.watch(far.field.clock.now() + 0.01)
        states.add(far.field.link.cut)
    assert states == {True, False}


def test_the_cameras_freeze():
    far = far_side("mocap_freeze")
    far.field.begin(0.0)
    before = far.see()
    assert not np.array_equal(before[0], before[1])
    far.watch(far.plan.onset + 0.01)
    seen = far.see()
    np.testing.assert_array_equal(seen[2], seen[3])


# The ground station


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
    assert len(streamed) == pytest.approx(30 * _MISSION, abs=2)
    for time, setpoint in streamed[::40]:
        np.testing.assert_allclose(setpoint.position, circuit.at(time - 1.0).position)
    landing = [m for t, m in ground.sent if t >= 1.0 + _MISSION]
    assert [type(m) for m in landing] == [c.NotifySetpointsStop, c.Land]
    assert ground.done_at == pytest.approx(1.0 + _MISSION, abs=0.04)


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


# What became of it


@pytest.mark.parametrize(
    ("safe_after", "locked", "end"),
    [(None, False, "flying"), (1.0, True, "cut"), (1.0, False, "landed")],
)
def test_outcome(safe_after, locked, end):
    report = {"excursion": 0.05, "safe_after": safe_after, "locked": locked, "speed": 1.0}
    outcome = campaign_udp._outcome("wall", 3, 2.5, report, [])
    assert (outcome.end, outcome.rule, outcome.action) == (end, "", 0)
    assert outcome.safe == (end != "flying")
    assert failures([outcome], 1.0) == ([] if outcome.safe else [outcome])


def test_events_survive_the_way_between_processes():
    event = SafetyEvent("fence", Action.WARN, 0.1, 0.0, Action.HOLD, 2.0, 1, "east")
    cut = SafetyEvent("fence", Action.CUT, 0.6, 0.5, Action.CUT, 2.5, 1)
    told = json.loads(json.dumps([asdict(event), asdict(cut)]))
    report = {"excursion": 0.6, "safe_after": 2.0, "locked": False, "speed": 1.0}
    outcome = campaign_udp._outcome("wall", 0, 1.0, report, told)
    assert outcome.events == [event, cut]
    assert (outcome.rule, outcome.action, outcome.end) == ("fence", Action.CUT, "cut")


def test_a_fault_that_is_not_flown_over_udp_is_refused(tmp_path):
    with pytest.raises(InputError, match="identity_swap"):
        campaign_udp.run_campaign(["identity_swap"], 1)
    arguments = ["fault-campaign", "--udp", "--fault", "tilt", "--out", str(tmp_path)]
    result = CliRunner().invoke(make_app(), arguments)
    assert result.exit_code == 2
    assert "radio_cut" in result.output


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.timeout(600)  # the first flight compiles
@pytest.mark.parametrize(
    ("fault", "end"),
    [("nan", "landed"), ("radio_cut", "cut"), ("killed_process", "cut"), ("wall", "landed")],
)
def test_flights_end_safely(fault, end):
    outcomes = campaign_udp.run_campaign([fault], 1)
    assert failures(outcomes, 0.5) == []
    (outcome,) = outcomes
    assert outcome.end == end
    assert 0.0 < outcome.safe_after < 14.0
    if fault == "killed_process":
        assert 0.8 < outcome.safe_after < 1.3
        assert not outcome.rule, "nobody was left to take over"
    else:
        assert outcome.rule
        assert outcome.events
