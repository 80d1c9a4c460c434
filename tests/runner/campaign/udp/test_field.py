"""The far side of a campaign flight over UDP, in virtual time."""

from __future__ import annotations

import json
import math
from types import SimpleNamespace

import numpy as np
import pytest

from crazyarena.clock import VirtualClock
from crazyarena.levels import load_level
from crazyarena.mocap.camera_model import CameraModel
from crazyarena.mocap.sim_source import SimSource
from crazyarena.runner.campaign.plan import draw_plan
from crazyarena.runner.campaign.udp.devices import ArenaCameras, FaultyRadio
from crazyarena.runner.campaign.udp.field import Field
from crazyarena.safety.fence import Fence
from crazyarena.safety.monitors import LOCKED
from crazyarena.sim_backend.crtp.faults import Faults
from crazyarena.types import Pose

ARENA = load_level("level0").arena


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
        """Places in the next few frames of something that flies along x at 1 m/s."""
        seen = []
        while len(seen) < 5 and clock.now() < 60.0:
            clock.sleep_until(clock.now() + 0.01)
            while cameras.next_exposure <= clock.now():
                time = cameras.next_exposure
                cameras.expose(time, {"cf1": Pose(np.array([time, 0.0, 1.0]))})
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
    far.vehicle.state.position[2] = 0.05
    far.vehicle.state.velocity[0] = 0.0
    far.vehicle.info = LOCKED
    far.watch(onset + 5.0)
    report = json.loads(json.dumps(far.reports))[0]
    assert len(far.reports) == 1
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


def test_the_cameras_hang_back_and_catch_up():
    far = far_side("mocap_hiccup")
    far.field.begin(0.0)
    before = np.diff([place[0] for place in far.see()])
    np.testing.assert_allclose(before, 0.01, atol=0.003)
    far.watch(far.plan.onset + 0.01)
    steps = np.diff([place[0] for _ in range(40) for place in far.see()])
    assert np.sum(np.abs(steps) < 0.003) > 5
    assert np.sum(np.abs(steps - 0.01) < 0.003) > 5
    assert steps.max() > 0.05
