"""Vehicles of one fleet meet: contact, downwash, and lock step only where it is needed."""

from __future__ import annotations

import warnings
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crazyarena.crazyswarm_compat import commands as c
from crazyarena.crazyswarm_compat.crazyswarm1 import Crazyswarm
from crazyarena.crazyswarm_compat.options import CrazyswarmWarning
from crazyarena.sim_backend import arena
from crazyarena.sim_backend.arena import ArenaFleet, SensorNoise
from crazyarena.sim_backend.arena_kernel import DT
from crazyarena.sim_backend.physics import competition_step as cs
from crazyarena.sim_backend.physics import fleet as kernels
from crazyarena.sim_backend.physics.arena_plant import ARENA_BODY_SIZE
from crazyarena.sim_backend.physics.scene import MARGIN
from crazyarena.sim_backend.physics.sizes import VEHICLE_HALF_LENGTH
from crazyarena.sim_backend.trace import TRACE_SIZE
from tests.optional import needs_pybullet

RADIUS = 0.06  # m, of a vehicle; contacts begin some millimetres outside


def fly(fleet, seconds, step=10):
    """Pass time with a perfect camera system at 100 Hz; positions (frames, n, 3)."""
    track = []
    for _ in range(round(100 * seconds)):
        fleet.external_truth()
        for _ in range(0, 10, step):
            fleet.advance(step)
        track.append(fleet.bodies[:, :3].copy())
    return np.array(track)


def airborne(positions, heights, **options):
    fleet = ArenaFleet(positions, **options)
    fly(fleet, 0.5)
    for i, height in enumerate(heights):
        fleet.set_param(i, "stabilizer.controller", 2)
        fleet.set_param(i, "ctrlMel.mass", 0.0319)
        fleet.send(c.Takeoff(height, 1.5), i)
    fly(fleet, 2.5)
    return fleet


def test_a_head_on_collision_is_felt_and_reported_once():
    fleet = airborne([[-0.5, 0, 0], [0.5, 0, 0]], [1, 1], ids=(7, 3))
    assert fleet.contacts == []
    begin = fleet.time
    fleet.send(c.GoTo([0.5, 0, 1], 0.0, 2.0), 0)
    fleet.send(c.GoTo([-0.5, 0, 1], 0.0, 2.0), 1)
    track = fly(fleet, 1.2)
    apart = np.linalg.norm(track[:, 0] - track[:, 1], axis=1)
    # Upright cylinders side by side: never into each other.
    upright = np.abs(track[:, 0, 2] - track[:, 1, 2]) < 0.01
    assert apart[upright].min() > 2 * RADIUS - 0.003
    first = fleet.contacts[0]
    assert (first.first, first.second) == (7, 3)
    frame = int(np.argmax(apart < 2 * RADIUS + 0.02))
    assert first.time - begin == pytest.approx(0.01 * frame, abs=0.03)
    # Each goes 1 m in 2 s, and is in the middle of it: 35/16 of the mean speed.
    assert 1.5 < first.speed < 2.4
    times = [told.time for told in fleet.contacts]
    assert all(late - early > 0.1 for early, late in pairwise(times))


def test_vehicles_that_pass_report_nothing():
    fleet = airborne([[-0.5, 0, 0], [0.5, 0.2, 0]], [1, 1])
    fleet.send(c.GoTo([0.5, 0, 1], 0.0, 2.0), 0)
    fleet.send(c.GoTo([-0.5, 0.2, 1], 0.0, 2.0), 1)
    track = fly(fleet, 2.5)
    assert fleet.contacts == []
    np.testing.assert_allclose(track[-1, :, 0], [0.5, -0.5], atol=0.05)


def test_a_vehicle_dropped_on_a_parked_one_wakes_and_tilts_it():
    fleet = ArenaFleet([[0, 0, 0], [3, 0, 0]])
    fleet.advance(1000)
    still = fleet.bodies[0].copy()
    fleet.advance(100)
    np.testing.assert_array_equal(fleet.bodies[0], still)  # asleep
    fleet.place(1, [0.08, 0, 0.4])
    fleet.advance(1000)
    assert [(told.first, told.second) for told in fleet.contacts][:1] == [(1, 2)]
    assert fleet.contacts[0].speed == pytest.approx(np.sqrt(2 * 9.81 * 0.36), rel=0.1)
    assert np.abs(fleet.bodies[0, :3] - still[:3]).max() > 0.005
    assert np.isfinite(fleet.bodies).all()


def test_a_stack_at_rest_is_one_contact():
    fleet = ArenaFleet([[0, 0, 0], [0, 0, 3 * (VEHICLE_HALF_LENGTH + MARGIN) + 0.001]])
    fleet.advance(3000)
    assert len(fleet.contacts) == 1
    height = fleet.bodies[1, 2] - fleet.bodies[0, 2]
    assert height == pytest.approx(2 * (VEHICLE_HALF_LENGTH + MARGIN), abs=0.002)


def test_downwash_pushes_the_lower_vehicle_down():
    def sag(downwash):
        fleet = airborne([[0, 0, 0], [0.3, 0, 0]], [0.6, 1.6], downwash=downwash)
        before = fleet.bodies[0, 2]
        fleet.send(c.GoTo([0, 0, 1.6], 0.0, 1.5), 1)
        return before - fly(fleet, 3.0)[:, 0, 2].min()

    assert sag(False) < 0.002
    # 0.076 N over what the controller answers an error with: kp_z, and some of its integral.
    assert 0.02 < sag(True) < 0.15


def test_parked_vehicles_make_no_wake():
    fleet = ArenaFleet([[0, 0, 0], [0, 0, 0.6]], downwash=True)
    fleet.advance(100)
    alone = ArenaFleet([[0, 0, 0], [2.0, 0, 0.6]])
    alone.advance(100)
    np.testing.assert_array_equal(fleet.bodies[0], alone.bodies[0])


@pytest.mark.parametrize("downwash", [False, True])
def test_lock_step_changes_nothing_where_it_is_not_needed(monkeypatch, downwash):
    def everybody(bodies, span, wakes, near, members):
        near[:] = 1
        members[:] = np.arange(len(bodies))
        return len(bodies)

    def run(step, threads=1):
        fleet = ArenaFleet(
            [[-0.6, 0, 0], [0.6, 0, 0], [0, 2.0, 0], [0.4, 0.1, 0], [0, -1.0, 0]],
            noise=SensorNoise(gyro=0.2, accelerometer=0.01, force=0.001),
            rng=np.random.default_rng(3),
            threads=threads,
            downwash=downwash,
        )
        traces = np.zeros((5, 10, TRACE_SIZE))
        together = set()
        for frame in range(300):
            fleet.external_truth()
            if frame == 30:
                for i in range(4):  # the last one stays parked
                    fleet.send(c.Takeoff(0.5 + 0.2 * (i == 2), 1.0), i)
            if frame == 150:
                fleet.send(c.GoTo([0.6, 0, 0.5], 0.0, 1.2), 0)
                fleet.send(c.GoTo([-0.6, 0, 0.5], 0.0, 1.2), 1)
            for k in range(0, 10, step):
                fleet.advance(step, traces[:, k : k + step])
            together.add(int(fleet._near.sum()))
        fleet.close()
        told = [(round(meeting.time / DT), meeting.first) for meeting in fleet.contacts]
        state = [fleet.bodies, fleet.memory, fleet._queues, traces]
        return b"".join(part.tobytes() for part in state), told, together

    state, told, together = run(10)
    assert told
    assert together & {0, 2, 3}  # there was something to leave out
    threaded, *_ = run(10, threads=2)
    assert threaded == state
    monkeypatch.setattr(arena.neighbours, "find_near", everybody)
    locked, told_locked, _ = run(10)
    assert told_locked == told
    assert locked == state


def test_lock_step_does_not_depend_on_the_length_of_a_call():
    def run(step):
        fleet = airborne([[-0.3, 0, 0], [0.3, 0, 0]], [0.5, 0.5])
        fleet.send(c.GoTo([0.3, 0, 0.5], 0.0, 1.0), 0)
        fly(fleet, 1.0, step)
        assert fleet.contacts
        return fleet.bodies.tobytes() + fleet.memory.tobytes(), fleet.contacts

    assert run(10) == run(1)


coordinate = st.floats(-0.5, 0.5)
speed = st.floats(-3.0, 3.0)
direction = st.tuples(*[st.floats(-1.0, 1.0)] * 3)


@given(
    st.lists(st.tuples(coordinate, coordinate, coordinate), min_size=2, max_size=6),
    st.lists(st.tuples(speed, speed, speed), min_size=6, max_size=6),
    st.lists(direction, min_size=6, max_size=6),
    st.booleans(),
)
@settings(max_examples=200, deadline=None)
def test_nobody_left_alone_can_be_reached(positions, velocities, ways, wakes):
    n = len(positions)
    bodies = np.zeros((n, ARENA_BODY_SIZE))
    bodies[:, cs.B_POS : cs.B_POS + 3] = positions
    bodies[:, cs.B_VEL : cs.B_VEL + 3] = velocities[:n]
    near, members = np.zeros(n, np.uint8), np.zeros(n, np.int64)
    count = kernels.find_near(bodies, 0.011, wakes, near, members)
    assert members[:count].tolist() == np.flatnonzero(near).tolist()
    # Everybody goes wherever its speed and any impact may take it within 10 ms.
    changes = np.array(ways[:n])
    norms = np.maximum(np.linalg.norm(changes, axis=1, keepdims=True), 1e-9)
    changes = changes / np.maximum(norms, 1.0) * 0.999 * kernels.SURGE
    bodies[:, cs.B_VEL : cs.B_VEL + 3] += changes
    bodies[:, cs.B_POS : cs.B_POS + 3] += 0.010 * bodies[:, cs.B_VEL : cs.B_VEL + 3]
    for i in range(n):
        for j in range(n):
            if i == j or near[i]:
                continue
            if wakes:
                assert kernels.wake_force(bodies, i, j) == 0.0
                assert kernels.wake_force(bodies, j, i) == 0.0
            gap = np.linalg.norm(bodies[i, :3] - bodies[j, :3])
            assert gap > 2 * kernels.VEHICLE_REACH + kernels.CONTACT_GAP


YAML = """
crazyflies:
- {id: 1, channel: 100, initialPosition: [-0.5, 0, 0]}
- {id: 4, channel: 100, initialPosition: [0.5, 0, 0]}
"""


@pytest.mark.parametrize(
    "backend", ["sim", pytest.param("pybullet", marks=[pytest.mark.slow, needs_pybullet])]
)
def test_a_script_learns_of_contacts(backend):
    swarm = Crazyswarm(YAML, args=f"--backend {backend} --vis null")
    swarm.allcfs.takeoff(1.0, 2.0)
    swarm.timeHelper.sleep(3.0)
    first, second = swarm.allcfs.crazyflies
    begin = swarm.timeHelper.time()
    first.goTo([0.5, 0, 1], 0, 2.0)
    second.goTo([-0.5, 0, 1], 0, 2.0)
    with pytest.warns(CrazyswarmWarning, match=r"cf1 and cf4 touched at \d\.\d\d s \(.* m/s\)"):
        swarm.timeHelper.sleep(1.5)
    contact = swarm.allcfs.contacts[0]
    assert (contact.first, contact.second) == (1, 4)
    assert contact.time - begin == pytest.approx(0.97, abs=0.05)
    swarm.allcfs.close()


def test_no_contacts_with_perfect_tracking():
    swarm = Crazyswarm(YAML, args="--sim --vis null")
    swarm.allcfs.takeoff(1.0, 2.0)
    swarm.timeHelper.sleep(3.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        swarm.allcfs.crazyflies[0].goTo([0.5, 0, 1], 0, 2.0)
        swarm.timeHelper.sleep(3.0)
    assert swarm.allcfs.contacts == ()


@pytest.mark.parametrize(
    "backend", ["sim", pytest.param("pybullet", marks=[pytest.mark.slow, needs_pybullet])]
)
def test_downwash_flag(backend):
    def lowest(flags):
        swarm = Crazyswarm(YAML, args=f"--backend {backend} --vis null {flags}")
        low, high = swarm.allcfs.crazyflies
        low.takeoff(0.6, 2.0)
        high.takeoff(1.6, 2.0)
        swarm.timeHelper.sleep(2.5)
        high.goTo([-0.5, 0, 1.6], 0, 2.0)
        swarm.timeHelper.sleep(3.0)
        swarm.allcfs.close()
        return low.position()[2]

    assert lowest("--downwash") < lowest("") - 0.02


def test_downwash_without_forces_is_pointed_out():
    with pytest.warns(CrazyswarmWarning, match="--downwash: perfect tracking knows no forces"):
        Crazyswarm(YAML, args="--sim --vis null --downwash")


def test_a_hundred_vehicles_fly_in_one_fleet():
    grid = [[0.5 * (i % 10), 0.5 * (i // 10), 0.0] for i in range(100)]
    fleet = ArenaFleet(grid, threads=2)
    fly(fleet, 0.3)
    for i in range(100):
        fleet.set_param(i, "ctrlMel.mass", 0.0319)
        assert fleet.send(c.Takeoff(0.5, 1.0), i) == 0
    fly(fleet, 3.0)
    fleet.close()
    np.testing.assert_allclose(fleet.bodies[:, :2], np.array(grid)[:, :2], atol=0.01)
    np.testing.assert_allclose(fleet.bodies[:, 2], 0.5, atol=0.03)
    assert fleet.contacts == []
