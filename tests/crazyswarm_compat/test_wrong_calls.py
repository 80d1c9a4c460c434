"""Every wrong call is refused, and the message names the vehicle and the argument."""

from __future__ import annotations

import math

import numpy as np
import pytest

from crazyarena.clock import VirtualClock, WallClock
from crazyarena.crazyswarm_compat import commands as c
from crazyarena.crazyswarm_compat.checks import check
from crazyarena.crazyswarm_compat.config import load_crazyflies_1
from crazyarena.crazyswarm_compat.options import CrazyswarmWarning, parse
from crazyarena.crazyswarm_compat.registry import open_backend
from crazyarena.crazyswarm_compat.uav_trajectory import Polynomial4D, Trajectory
from crazyarena.errors import BackendError, CommandError, InputError
from tests.optional import needs_pybullet

NAN, INF = math.nan, math.inf
ZERO = [0.0, 0.0, 0.0]

CALLS = {
    "height is nan": (lambda cf: cf.takeoff(NAN, 1), "cf1: takeoff: targetHeight"),
    "height is text": (lambda cf: cf.takeoff("high", 1), "cf1: takeoff: targetHeight"),
    "negative duration": (lambda cf: cf.takeoff(1, -1), "cf1: takeoff: duration is -1"),
    "infinite duration": (lambda cf: cf.land(0, INF), "cf1: land: duration"),
    "mask too large": (lambda cf: cf.land(0, 1, groupMask=256), "cf1: land: groupMask is 256"),
    "goal is nan": (lambda cf: cf.goTo([NAN, 0, 1], 0, 1), "cf1: goTo: goal"),
    "goal of two": (lambda cf: cf.goTo([0, 1], 0, 1), "cf1: goTo: goal"),
    "goal of text": (lambda cf: cf.goTo("abc", 0, 1), "cf1: goTo: goal"),
    "ragged goal": (lambda cf: cf.goTo([[0], [1, 2], 3], 0, 1), "cf1: goTo: goal"),
    "yaw is nan": (lambda cf: cf.goTo(ZERO, NAN, 1), "cf1: goTo: yaw"),
    "go-to duration": (lambda cf: cf.goTo(ZERO, 0, -0.1), "cf1: goTo: duration"),
    "mask is fractional": (lambda cf: cf.setGroupMask(1.5), "cf1: setGroupMask: groupMask"),
    "stop mask": (lambda cf: cf.stop(-1), "cf1: stop: groupMask"),
    "notify": (lambda cf: cf.notifySetpointsStop(-1), "cf1: notifySetpointsStop: remainValid"),
    "timescale": (lambda cf: cf.startTrajectory(0, timescale=0), "cf1: startTrajectory: timescale"),
    "trajectory id": (lambda cf: cf.startTrajectory(-1), "cf1: startTrajectory: trajectoryId"),
    "full state": (
        lambda cf: cf.cmdFullState(ZERO, ZERO, [0, 0, INF], 0, ZERO),
        "cf1: cmdFullState: acc",
    ),
    "position": (lambda cf: cf.cmdPosition([0, NAN, 0]), "cf1: cmdPosition: pos"),
    "velocity": (lambda cf: cf.cmdVelocityWorld([0, NAN, 0], 0), "cf1: cmdVelocityWorld: vel"),
    "yaw rate": (lambda cf: cf.cmdVelocityWorld(ZERO, NAN), "cf1: cmdVelocityWorld: yawRate"),
    "thrust": (lambda cf: cf.cmdVel(0, 0, 0, 70000), "cf1: cmdVel: thrust is 70000"),
    "colour": (lambda cf: cf.setLEDColor(0, 2, 0), "cf1: setLEDColor: g is 2"),
    "parameter name": (lambda cf: cf.setParam("ring", 1), "cf1: parameter name is 'ring'"),
    "parameter value": (lambda cf: cf.setParam("a/b", NAN), r"cf1: setParam: value of a\.b"),
    "radii": (
        lambda cf: cf.enableCollisionAvoidance([], [0.1, 0, 0.1]),
        "cf1: enableCollisionAvoidance: ellipsoidRadii",
    ),
    "box": (
        lambda cf: cf.enableCollisionAvoidance([], [1, 1, 1], bboxMin=[0, 0, NAN]),
        "cf1: enableCollisionAvoidance: bboxMin",
    ),
    "horizon": (
        lambda cf: cf.enableCollisionAvoidance([], [1, 1, 1], horizonSecs=0),
        "cf1: enableCollisionAvoidance: horizonSecs",
    ),
}


@pytest.fixture
def swarm(swarm1):
    swarm = swarm1()
    swarm.allcfs.takeoff(1, 1)
    swarm.timeHelper.sleep(1.2)
    return swarm


@pytest.mark.parametrize("case", CALLS)
def test_refused(swarm, case):
    call, message = CALLS[case]
    cf = swarm.allcfs.crazyflies[0]
    with pytest.raises(CommandError, match=message):
        call(cf)
    # A refused command must leave no trace.
    where = cf.position()
    swarm.timeHelper.sleep(0.5)
    assert np.allclose(cf.position(), where)


def test_broadcast_names_everybody(swarm):
    with pytest.raises(CommandError, match="all vehicles: goTo: goal"):
        swarm.allcfs.goTo([0, NAN, 0], 0, 1)


def test_unknown_id(swarm):
    with pytest.raises(KeyError, match="no vehicle with id 99; the fleet has 1, 10"):
        swarm.allcfs.crazyfliesById[99]
    assert swarm.allcfs.crazyfliesById.get(99) is None


def test_unknown_trajectory_is_a_key_error(swarm, figure8):
    cf = swarm.allcfs.crazyflies[0]
    cf.uploadTrajectory(4, 0, figure8)
    with pytest.raises(KeyError) as caught:
        cf.startTrajectory(5)
    message = "cf1: startTrajectory: trajectory 5 has not been uploaded; known are [4]"
    assert str(caught.value) == message
    assert isinstance(caught.value, CommandError)


def pieces(count, size=8):
    trajectory = Trajectory()
    zero = [0.0] * 8
    trajectory.polynomials = [
        Polynomial4D(1.0, zero, [0.0] * size, zero, zero) for _ in range(count)
    ]
    return trajectory


def test_memory_holds_31_pieces(swarm):
    cf = swarm.allcfs.crazyflies[0]
    cf.uploadTrajectory(0, 0, pieces(31))
    # A simulation takes more, and says what a vehicle would do.
    with pytest.warns(UserWarning, match=r"cf1: uploadTrajectory: a real .*holds 31 pieces"):
        cf.uploadTrajectory(0, 0, pieces(32))
    with pytest.warns(UserWarning, match=r"cf1: uploadTrajectory: .*end at piece 33"):
        cf.uploadTrajectory(1, 32, pieces(1))
    with pytest.raises(CommandError, match=r"cf1: uploadTrajectory: .*holds 256 pieces"):
        cf.uploadTrajectory(1, 255, pieces(2))


def test_piece_of_wrong_shape(swarm):
    with pytest.raises(CommandError, match=r"cf1: uploadTrajectory: piece 0, py has shape \(7,\)"):
        swarm.allcfs.crazyflies[0].uploadTrajectory(0, 0, pieces(2, size=7))


def test_not_a_trajectory(swarm):
    with pytest.raises(CommandError, match=r"cf1: uploadTrajectory: .* has no polynomials"):
        swarm.allcfs.crazyflies[0].uploadTrajectory(0, 0, [1, 2, 3])


def test_overlapping_trajectories_are_pointed_out(swarm):
    cf = swarm.allcfs.crazyflies[0]
    cf.uploadTrajectory(0, 0, pieces(5))
    cf.uploadTrajectory(1, 5, pieces(5))
    with pytest.warns(UserWarning, match=r"cf1: uploadTrajectory: trajectory 2 .* trajectory 1 "):
        cf.uploadTrajectory(2, 9, pieces(5))


def test_unknown_parameter(swarm):
    with pytest.warns(CrazyswarmWarning, match=r"cf1: no parameter 'no\.such'"):
        assert swarm.allcfs.crazyflies[0].getParam("no/such") is None


@pytest.mark.parametrize("duration", [-0.1, NAN, INF])
def test_sleep(swarm, duration):
    with pytest.raises(CommandError, match=r"timeHelper\.sleep: duration"):
        swarm.timeHelper.sleep(duration)


@pytest.mark.parametrize("rate", [0, -5, NAN])
def test_sleep_for_rate(swarm, rate):
    with pytest.raises(CommandError, match=r"timeHelper\.sleepForRate: rate"):
        swarm.timeHelper.sleepForRate(rate)


def test_observer_must_be_callable(swarm):
    with pytest.raises(CommandError, match="addObserver: 3"):
        swarm.timeHelper.addObserver(3)


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ("--sim --dt 0", "--dt: found 0.0"),
        ("--sim --dt nan", "--dt: found nan"),
        ("--sim --disturbance -1", "--disturbance: found -1.0"),
        ("--sim --maxvel 0", "--maxvel: found 0.0"),
        ("--sim --backend radio", "--sim: contradicts --backend radio"),
        ("--sim --vis null --video a.gif", "--video: found --vis null"),
    ],
)
def test_flags(flags, message):
    with pytest.raises(InputError, match=message):
        parse(flags, None)


def test_unknown_backend():
    fleet = load_crazyflies_1("crazyflies: []")
    with pytest.raises(InputError, match="--backend: found 'gazebo'; expected one of ideal"):
        open_backend("gazebo", fleet, VirtualClock())


def test_simulation_needs_a_virtual_clock():
    fleet = load_crazyflies_1("crazyflies: []")
    with pytest.raises(BackendError, match="needs a virtual clock"):
        open_backend("ideal", fleet, WallClock())


def test_not_a_command():
    with pytest.raises(CommandError, match="cf1: 'fly' is not a command"):
        check("fly", "cf1")


def test_backend_checks_what_is_sent_to_it_directly():
    fleet = load_crazyflies_1("crazyflies: [{id: 3, initialPosition: [0, 0, 0]}]")
    backend = open_backend("ideal", fleet, VirtualClock())
    with pytest.raises(CommandError, match="cf3: goTo: goal"):
        backend.send(c.GoTo([0, NAN, 0], 0, 1), 3)
    with pytest.raises(CommandError, match="no vehicle with id 4; the fleet has 3"):
        backend.send(c.Stop(), 4)
    with pytest.raises(CommandError, match=r"uploadTrajectory: trajectory is .*\(n, 33\)"):
        backend.send(c.UploadTrajectory(0, 0, np.zeros((2, 32))), 3)
    with pytest.raises(CommandError, match="uploadTrajectory: piece 1"):
        backend.send(c.UploadTrajectory(0, 0, np.eye(2, 33)), 3)


# The calls that scripts most often get wrong, on everything that simulates.

BACKENDS = ["ideal", "sim", pytest.param("pybullet", marks=[pytest.mark.slow, needs_pybullet])]


@pytest.fixture(params=BACKENDS)
def anywhere(request, swarm1):
    swarm = swarm1(f"--backend {request.param}")
    swarm.allcfs.takeoff(1, 1)
    swarm.timeHelper.sleep(1.5)
    yield swarm
    swarm.allcfs.close()


def test_wrong_calls_name_the_vehicle_on_every_backend(anywhere, figure8):
    first, second = anywhere.allcfs.crazyflies
    with pytest.raises(KeyError, match="no vehicle with id 99; the fleet has 1, 10"):
        anywhere.allcfs.crazyfliesById[99]
    with pytest.raises(CommandError, match=r"no vehicle with id 99; the fleet has 1, 10"):
        first._backend.send(c.Stop(), 99)
    with pytest.raises(CommandError, match="cf1: goTo: goal"):
        first.goTo([0, NAN, 1], 0, 1)
    with pytest.raises(CommandError, match="cf10: goTo: duration is -1"):
        second.goTo([0, 0, 1], 0, -1)
    with pytest.warns(UserWarning, match=r"cf1: uploadTrajectory: a real .*holds 31 pieces"):
        first.uploadTrajectory(6, 0, pieces(32))
    with pytest.raises(CommandError, match=r"cf1: uploadTrajectory: piece 0, py has shape \(7,\)"):
        first.uploadTrajectory(0, 0, pieces(2, size=7))
    first.uploadTrajectory(4, 0, figure8)
    with pytest.raises(KeyError, match=r"cf1: startTrajectory: trajectory 5 has not been uploaded"):
        first.startTrajectory(5)
    with pytest.warns(UserWarning, match=r"cf1: uploadTrajectory: trajectory 6 .* trajectory 4 "):
        first.uploadTrajectory(6, 3, pieces(2))
    with pytest.warns(CrazyswarmWarning, match=r"cf10: no parameter 'no\.such'"):
        assert second.getParam("no/such") is None
    anywhere.allcfs.setParam("ring/effect", 7)
    assert second.getParam("ring/effect") == 7
    # None of it has moved anybody.
    anywhere.timeHelper.sleep(0.5)
    assert np.allclose([first.position(), second.position()], [[1, 0, 1], [0, -1, 1]], atol=0.05)


@pytest.mark.parametrize(
    "call",
    [
        lambda cf: cf.takeoff(1, 1),
        lambda cf: cf.goTo([0, 0, 1], 0, 1),
        lambda cf: cf.land(0.02, 1),
        lambda cf: cf.startTrajectory(4),
        lambda cf: cf.cmdPosition([0, 0, 1]),
        lambda cf: cf.cmdVelocityWorld([0, 0, 1], 0),
        lambda cf: cf.cmdFullState([0, 0, 1], ZERO, ZERO, 0, ZERO),
        lambda cf: cf.notifySetpointsStop(),
        lambda cf: cf.stop(),
    ],
)
@pytest.mark.parametrize("backend", ["ideal", "sim"])
def test_everything_after_an_emergency_is_ignored_with_a_warning(swarm1, figure8, backend, call):
    swarm = swarm1(f"--backend {backend}")
    cf, _ = swarm.allcfs.crazyflies
    cf.uploadTrajectory(4, 0, figure8)
    for delay in (0.0, 2.0):
        swarm.allcfs.emergency()
        swarm.timeHelper.sleep(delay)
        where = cf.position()
        with pytest.warns(UserWarning, match=r"cf1: \w+: ignored; the emergency stop locks"):
            call(cf)
        swarm.timeHelper.sleep(0.5)
        assert np.allclose(cf.position(), where)
    swarm.allcfs.close()


def test_what_the_firmware_refuses_is_said(swarm1):
    swarm = swarm1("--backend sim")
    cf, _ = swarm.allcfs.crazyflies
    with pytest.warns(CrazyswarmWarning, match=r"cf1: uploadTrajectory: refused; .* 0 to 30"):
        cf.uploadTrajectory(100, 0, pieces(1))
    with pytest.raises(KeyError, match="trajectory 100 has not been uploaded; known are none"):
        cf.startTrajectory(100)
    swarm.allcfs.close()


def test_unknown_parameters_are_pointed_out(swarm1):
    swarm = swarm1("--backend sim")
    with pytest.warns(CrazyswarmWarning, match=r"cf10: setParam: ignored; no parameter 'no\.such'"):
        swarm.allcfs.crazyflies[1].setParam("no/such", 1)
    swarm.allcfs.close()


def test_a_crashed_vehicle_says_why_it_does_not_fly(swarm1):
    swarm = swarm1("--backend sim")
    cf, other = swarm.allcfs.crazyflies
    swarm.allcfs.takeoff(1, 1)
    swarm.timeHelper.sleep(1.5)
    for _ in range(20):
        cf.cmdVel(0, 0, 0, 40000)
        swarm.timeHelper.sleep(0.05)
    swarm.timeHelper.sleep(5.0)  # of silence: the commander gives up
    with pytest.warns(CrazyswarmWarning, match="cf1: goTo: ignored; the vehicle has locked itself"):
        cf.goTo([0, 0, 1], 0, 1)
    other.goTo([0, -1, 1.2], 0, 1)
    swarm.timeHelper.sleep(1.5)
    assert np.allclose(other.position(), [0, -1, 1.2], atol=0.05)
    swarm.allcfs.close()
