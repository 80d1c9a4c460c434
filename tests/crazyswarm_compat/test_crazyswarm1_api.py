"""One test for each row of Crazyswarm 1's tables of methods, attributes and flags."""

from __future__ import annotations

import argparse
import inspect
import math

import numpy as np
import pytest

from crazyarena.crazyswarm_compat import crazyswarm1, options
from crazyarena.crazyswarm_compat.joystick import Joystick
from crazyarena.crazyswarm_compat.options import CrazyswarmWarning
from crazyarena.crazyswarm_compat.timehelper import TimeHelper
from crazyarena.crazyswarm_compat.visualizers import VisNull

SIGNATURES = {
    "setGroupMask": "groupMask",
    "enableCollisionAvoidance": "others, ellipsoidRadii, bboxMin=, bboxMax=, horizonSecs=1.0, "
    "maxSpeed=2.0",
    "disableCollisionAvoidance": "",
    "takeoff": "targetHeight, duration, groupMask=0",
    "land": "targetHeight, duration, groupMask=0",
    "stop": "groupMask=0",
    "goTo": "goal, yaw, duration, relative=False, groupMask=0",
    "uploadTrajectory": "trajectoryId, pieceOffset, trajectory",
    "startTrajectory": "trajectoryId, timescale=1.0, reverse=False, relative=True, groupMask=0",
    "notifySetpointsStop": "remainValidMillisecs=100, groupMask=0",
    "position": "",
    "getParam": "name",
    "setParam": "name, value",
    "setParams": "params",
    "cmdFullState": "pos, vel, acc, yaw, omega",
    "cmdVelocityWorld": "vel, yawRate",
    "cmdStop": "",
    "cmdVel": "roll, pitch, yawrate, thrust",
    "cmdPosition": "pos, yaw=0.0",
    "setLEDColor": "r, g, b",
    "yaw": "",
    "velocity": "",
    "acceleration": "",
    "rpy": "",
    "rotBodyToWorld": "",
}
BROADCASTS = {
    "emergency": "",
    "takeoff": "targetHeight, duration, groupMask=0",
    "land": "targetHeight, duration, groupMask=0",
    "stop": "groupMask=0",
    "goTo": "goal, yaw, duration, groupMask=0",
    "startTrajectory": "trajectoryId, timescale=1.0, reverse=False, relative=True, groupMask=0",
    "setParam": "name, value",
}


def arguments(function):
    shown = []
    for parameter in list(inspect.signature(function).parameters.values())[1:]:
        if parameter.default is inspect.Parameter.empty:
            shown.append(parameter.name)
        elif isinstance(parameter.default, tuple):
            shown.append(f"{parameter.name}=")
        else:
            shown.append(f"{parameter.name}={parameter.default}")
    return ", ".join(shown)


@pytest.mark.parametrize("name", SIGNATURES)
def test_signature_of_vehicle(name):
    assert arguments(getattr(crazyswarm1.Crazyflie, name)) == SIGNATURES[name]


@pytest.mark.parametrize("name", BROADCASTS)
def test_signature_of_fleet(name):
    assert arguments(getattr(crazyswarm1.CrazyflieServer, name)) == BROADCASTS[name]


@pytest.fixture
def flying(swarm1):
    def make(args=""):
        swarm = swarm1(args)
        swarm.allcfs.takeoff(1.0, 2.0)
        swarm.timeHelper.sleep(2.5)
        return swarm.timeHelper, swarm.allcfs, *swarm.allcfs.crazyflies

    return make


class TestConstruction:
    def test_attributes(self, swarm1):
        swarm = swarm1()
        assert isinstance(swarm.timeHelper, TimeHelper)
        assert isinstance(swarm.allcfs, crazyswarm1.CrazyflieServer)
        assert isinstance(swarm.input, Joystick)
        assert [cf.id for cf in swarm.allcfs.crazyflies] == [1, 10]
        assert swarm.timeHelper.crazyflies == swarm.allcfs.crazyflies

    def test_default_file(self, tmp_path, monkeypatch):
        (tmp_path / "launch").mkdir()
        (tmp_path / "scripts").mkdir()
        text = "crazyflies: [{id: 7, channel: 80, initialPosition: [0, 1, 0], type: default}]"
        (tmp_path / "launch" / "crazyflies.yaml").write_text(text)
        monkeypatch.chdir(tmp_path / "scripts")
        swarm = crazyswarm1.Crazyswarm(args=["--sim", "--vis", "null"])
        assert swarm.allcfs.crazyflies[0].id == 7

    def test_command_line_is_the_default(self, swarm1, monkeypatch):
        monkeypatch.setattr("sys.argv", ["script.py", "--sim", "--vis", "null", "--dt", "0.25"])
        swarm = crazyswarm1.Crazyswarm("crazyflies: [{id: 1, initialPosition: [0, 0, 0]}]")
        assert swarm.timeHelper.dt == 0.25

    def test_parent_parser(self, capsys):
        parent = argparse.ArgumentParser(add_help=False)
        parent.add_argument("--laps", type=int)
        swarm = crazyswarm1.Crazyswarm(
            "crazyflies: [{id: 1, initialPosition: [0, 0, 0]}]",
            parent_parser=parent,
            args="--sim --vis null --laps 3 --something-else 1",
        )
        assert swarm.allcfs.crazyflies

    def test_flag_defaults(self):
        parsed = options.parse("--sim", None)
        assert (parsed.vis, parsed.dt, parsed.writecsv) == ("mpl", 0.1, False)
        assert (parsed.disturbance, parsed.maxvel, parsed.video) == (0.0, math.inf, None)
        assert parsed.backend == "ideal"
        assert options.parse("", None).backend == "radio"
        assert options.parse("--backend pybullet", None).sim

    def test_vispy_is_taken_as_mpl(self):
        with pytest.warns(CrazyswarmWarning, match="vispy"):
            assert options.parse("--sim --vis vispy", None).vis == "mpl"

    @pytest.mark.parametrize("flag", ["writecsv", "video film.mp4"])
    def test_simulation_flags_are_ignored_on_the_radio(self, flag):
        with pytest.warns(CrazyswarmWarning, match=flag.split()[0]):
            options.parse(f"--{flag}", None)


class TestTimeHelper:
    def test_time_is_the_sum_of_ticks(self, swarm1):
        time_helper = swarm1().timeHelper
        assert time_helper.time() == 0.0
        time_helper.sleep(2.5)
        expected = 0.0
        for _ in range(25):
            expected += 0.1
        assert time_helper.time() == expected

    def test_sleep_rounds_down_and_keeps_the_rest(self, swarm1):
        time_helper = swarm1().timeHelper
        time_helper.sleep(0.3)  # 0.3 / 0.1 is a little less than 3
        assert time_helper.time() == pytest.approx(0.2)
        assert time_helper.sleepResidual == pytest.approx(0.1)
        time_helper.sleep(0.05)
        assert time_helper.time() == pytest.approx(0.3)

    def test_sleep_for_rate(self, swarm1):
        time_helper = swarm1("--dt 0.05").timeHelper
        for _ in range(5):
            time_helper.sleepForRate(10)
        assert time_helper.time() == pytest.approx(0.5)

    def test_public_members(self, swarm1):
        time_helper = swarm1("--disturbance 0.5 --maxvel 2 --dt 0.02").timeHelper
        assert time_helper.isShutdown() is False
        assert isinstance(time_helper.visualizer, VisNull)
        assert (time_helper.dt, time_helper.t, time_helper.sleepResidual) == (0.02, 0.0, 0.0)
        assert (time_helper.disturbanceSize, time_helper.maxVel) == (0.5, 2.0)
        assert time_helper.output is None
        assert time_helper.videoWriter is None

    def test_limits_can_be_changed_in_flight(self, swarm1):
        swarm = swarm1()
        cf = swarm.allcfs.crazyflies[0]
        swarm.timeHelper.maxVel = 0.5
        cf.cmdVelocityWorld([2, 0, 0], 0)
        swarm.timeHelper.sleep(1.0)
        assert np.linalg.norm(cf.velocity()) == pytest.approx(0.5)

    def test_step(self, swarm1):
        swarm = swarm1()
        cf = swarm.allcfs.crazyflies[0]
        cf.cmdVelocityWorld([1, 0, 0], 0)
        swarm.timeHelper.step(0.37)
        assert swarm.timeHelper.time() == 0.37
        assert cf.position()[0] == pytest.approx(1.37)

    def test_observer_sees_the_state_before_each_tick(self, swarm1):
        swarm = swarm1()
        seen = []
        swarm.timeHelper.addObserver(lambda t, cfs: seen.append((t, cfs[0].position()[0])))
        swarm.allcfs.crazyflies[0].cmdVelocityWorld([1, 0, 0], 0)
        swarm.timeHelper.sleep(0.31)
        assert np.allclose(seen, [(0.0, 1.0), (0.1, 1.1), (0.2, 1.2)])

    def test_visualizer_is_updated_before_each_tick(self, swarm1):
        swarm = swarm1()
        times = []
        swarm.timeHelper.visualizer.update = lambda t, cfs: times.append(t)
        swarm.timeHelper.sleep(0.31)
        assert np.allclose(times, [0.0, 0.1, 0.2])


class TestVehicle:
    def test_attributes(self, swarm1):
        cf = swarm1().allcfs.crazyflies[1]
        assert (cf.id, cf.prefix, cf.groupMask, cf.trajectories) == (10, "/cf10", 0, {})
        assert cf.ledRGB == (0.5, 0.5, 1)
        assert cf.mode == cf.MODE_IDLE
        assert cf.planner.state == 0
        assert np.array_equal(cf.state.pos, cf.initialPosition)
        assert np.array_equal(cf.setState.pos, cf.initialPosition)

    def test_set_group_mask(self, flying):
        time_helper, _, a, b = flying()
        a.setGroupMask(0b101)
        # Own mask 0 only obeys mask 0; the rule also holds for commands to one vehicle.
        for cf in (a, b):
            cf.goTo([0, 0, 2], 0, 1.0, groupMask=0b100)
        time_helper.sleep(1.5)
        assert a.position()[2] == pytest.approx(2.0)
        assert b.position()[2] == pytest.approx(1.0)

    def test_takeoff_is_absolute_and_ignored_in_flight(self, flying):
        time_helper, _, a, _ = flying()
        a.takeoff(3.0, 1.0)
        time_helper.sleep(1.5)
        assert a.position()[2] == pytest.approx(1.0)

    def test_takeoff_turns_to_yaw_zero(self, swarm1):
        swarm = swarm1()
        cf = swarm.allcfs.crazyflies[0]
        cf.cmdPosition(cf.initialPosition, yaw=1.0)
        swarm.timeHelper.sleep(0.2)
        assert cf.yaw() == pytest.approx(1.0)
        cf.takeoff(1.0, 1.0)
        swarm.timeHelper.sleep(1.2)
        assert cf.yaw() == pytest.approx(0.0, abs=1e-9)

    def test_land_is_ignored_while_landing(self, flying):
        time_helper, _, a, _ = flying()
        a.land(0.1, 2.0)
        time_helper.sleep(1.0)
        a.land(0.9, 0.5)
        time_helper.sleep(1.5)
        assert a.position()[2] == pytest.approx(0.1)

    def test_stop(self, flying):
        _, _, a, _ = flying()
        a.stop()
        assert a.mode == a.MODE_IDLE
        with pytest.raises(ValueError, match="cf1: goTo"):
            a.goTo([0, 0, 1], 0, 1)

    def test_go_to_starts_from_the_present_setpoint(self, flying):
        time_helper, _, a, _ = flying("--dt 0.01")
        a.goTo([3, 0, 1], 0, 2.0)
        time_helper.sleep(1.0)
        before = a.velocity()
        a.goTo([1, 0, 1], 0, 2.0)
        time_helper.sleep(0.01)
        assert before[0] > 1.0
        assert a.velocity()[0] == pytest.approx(before[0], abs=0.05)

    def test_go_to_relative_adds_position_and_yaw(self, flying):
        time_helper, _, a, _ = flying()
        a.goTo([0.5, 0, 0], 0.3, 1.0, relative=True)
        time_helper.sleep(1.5)
        a.goTo([0, 0.5, 0], 0.0, 1.0, relative=True)
        time_helper.sleep(1.5)
        assert np.allclose(a.position(), [1.5, 0.5, 1.0])
        assert a.yaw() == pytest.approx(0.3)

    def test_go_to_turns_the_long_way(self, flying):
        time_helper, _, a, _ = flying()
        a.goTo([1, 0, 1], 6.2, 2.0)
        time_helper.sleep(1.0)
        assert a.yaw() == pytest.approx(3.1, abs=1e-6)
        time_helper.sleep(1.5)
        assert a.yaw() == pytest.approx(6.2)

    def test_go_to_before_takeoff(self, swarm1):
        with pytest.raises(ValueError, match="cf1: goTo"):
            swarm1().allcfs.crazyflies[0].goTo([0, 0, 1], 0, 1)

    def test_go_to_after_streaming(self, flying):
        time_helper, _, a, _ = flying()
        a.cmdPosition([1, 0, 1])
        with pytest.raises(ValueError, match="notifySetpointsStop"):
            a.goTo([0, 0, 1], 0, 1)
        a.notifySetpointsStop()
        a.goTo([0, 0, 1], 0, 1)
        time_helper.sleep(1.1)
        assert np.allclose(a.position(), [0, 0, 1])

    def test_streaming_hands_over_to_takeoff_land_and_trajectory(self, flying, figure8):
        time_helper, _, a, b = flying()
        a.cmdPosition([1, 0, 1.5])
        b.cmdPosition([0, 0, 1.5])
        time_helper.sleep(0.1)
        a.takeoff(2.0, 1.0)
        b.land(0.5, 1.0)
        time_helper.sleep(1.1)
        assert np.allclose([a.position()[2], b.position()[2]], [2.0, 0.5])
        a.uploadTrajectory(0, 0, figure8)
        a.cmdPosition([1, 0, 1])
        time_helper.sleep(0.1)
        a.startTrajectory(0)
        time_helper.sleep(figure8.duration + 0.1)
        assert np.allclose(a.position(), [1, 0, 1], atol=1e-5)

    def test_trajectory_absolute(self, flying, figure8):
        time_helper, _, a, _ = flying()
        a.uploadTrajectory(3, 11, figure8)
        assert a.trajectories[3] is figure8
        a.startTrajectory(3, relative=False)
        time_helper.sleep(figure8.duration / 4)
        assert np.allclose(a.position(), figure8.eval(figure8.duration / 4).pos, atol=1e-5)

    def test_trajectory_timescale_scales_velocity(self, flying, figure8):
        time_helper, _, a, _ = flying("--dt 0.01")
        a.uploadTrajectory(0, 0, figure8)
        for timescale in (1.0, 2.0):
            a.startTrajectory(0, timescale=timescale, relative=False)
            time_helper.sleep(timescale * 1.0)
            expected = figure8.eval(1.0)
            assert np.allclose(a.velocity(), expected.vel / timescale, atol=0.02)
            assert np.allclose(a.acceleration(), expected.acc / timescale**2, atol=1e-3)

    def test_trajectory_reverse_ends_at_its_first_point(self, flying, figure8):
        time_helper, _, a, _ = flying()
        a.uploadTrajectory(0, 0, figure8)
        a.startTrajectory(0, reverse=True, relative=False)
        time_helper.sleep(1.0)
        expected = figure8.eval(figure8.duration - 1.0).pos
        assert np.allclose(a.position(), expected, atol=1e-4)

    def test_trajectory_can_be_started_again(self, flying, figure8):
        time_helper, _, a, _ = flying()
        a.uploadTrajectory(0, 0, figure8)
        for _ in range(2):
            a.startTrajectory(0, relative=False)
            time_helper.sleep(1.0)
            assert np.allclose(a.position(), figure8.eval(1.0).pos, atol=1e-5)

    def test_position_is_a_copy(self, swarm1):
        cf = swarm1().allcfs.crazyflies[0]
        cf.position()[:] = 99
        assert np.array_equal(cf.position(), [1, 0, 0])

    def test_params(self, swarm1):
        cf = swarm1().allcfs.crazyflies[0]
        cf.setParam("ring/effect", 7)
        assert cf.getParam("ring/effect") == 7
        assert cf.getParam("ring.effect") == 7
        cf.setParams({"ctrlMel/kp_xy": 0.5, "my/own": 2})
        assert cf.getParam("ctrlMel/kp_xy") == 0.5
        assert cf.getParam("my/own") == 2

    def test_cmd_full_state(self, swarm1):
        swarm = swarm1()
        cf = swarm.allcfs.crazyflies[0]
        cf.cmdFullState([1, 2, 3], [0, 0, 0], [1, 0, 0], 0.5, [0.1, 0.2, 0.3])
        swarm.timeHelper.sleep(0.1)
        assert np.allclose(cf.position(), [1, 2, 3])
        assert cf.yaw() == 0.5
        assert np.allclose(cf.acceleration(), [1, 0, 0])
        assert np.allclose(cf.state.omega, [0.1, 0.2, 0.3])
        assert cf.mode == cf.MODE_LOW_FULLSTATE

    def test_cmd_position_yaw_rate(self, swarm1):
        swarm = swarm1()
        cf = swarm.allcfs.crazyflies[0]
        cf.cmdPosition([0, 0, 1], yaw=0.2)
        swarm.timeHelper.step(0.1)
        assert cf.state.omega[2] == pytest.approx(2.0)
        swarm.timeHelper.step(0.1)
        assert cf.state.omega[2] == pytest.approx(0.0)

    def test_cmd_stop_freezes(self, swarm1):
        swarm = swarm1()
        cf = swarm.allcfs.crazyflies[0]
        cf.cmdVelocityWorld([1, 0, 0], 0)
        swarm.timeHelper.sleep(0.5)
        cf.cmdStop()
        where = cf.position()
        swarm.timeHelper.sleep(0.5)
        assert np.array_equal(cf.position(), where)
        assert not cf.velocity().any()

    def test_cmd_vel_needs_dynamics(self, swarm1):
        with pytest.raises(ValueError, match=r"cf1: cmdVel.*--backend sim"):
            swarm1().allcfs.crazyflies[0].cmdVel(0, 0, 0, 30000)

    def test_set_led_color(self, swarm1):
        cf = swarm1().allcfs.crazyflies[0]
        cf.setLEDColor(1.0, 0.5, 0)
        assert cf.ledRGB == (1.0, 0.5, 0)
        values = [cf.getParam(f"ring/solid{name}") for name in ("Red", "Green", "Blue")]
        assert values == [255, 127, 0]

    def test_attitude_of_acceleration(self, swarm1):
        swarm = swarm1()
        cf = swarm.allcfs.crazyflies[0]
        rng = np.random.default_rng(1)
        for _ in range(20):
            acc, yaw = rng.uniform(-5, 5, 3), rng.uniform(-3, 3)
            cf.cmdFullState([0, 0, 1], [0, 0, 0], acc, yaw, [0, 0, 0])
            swarm.timeHelper.step(0.1)
            z_body = acc + np.array([0, 0, 9.81])
            z_body /= np.linalg.norm(z_body)
            y_body = np.cross(z_body, [np.cos(yaw), np.sin(yaw), 0])
            y_body /= np.linalg.norm(y_body)
            x_body = np.cross(y_body, z_body)
            assert np.allclose(cf.rotBodyToWorld(), np.column_stack([x_body, y_body, z_body]))
            expected = [np.arctan2(y_body[2], z_body[2]), np.arcsin(-x_body[2]), yaw]
            assert np.allclose(cf.rpy(), expected)


class TestFleet:
    def test_stop(self, flying):
        _, allcfs, a, b = flying()
        a.setGroupMask(1)
        allcfs.stop(groupMask=1)
        assert (a.mode, b.mode) == (a.MODE_IDLE, b.MODE_HIGH_POLY)

    def test_set_param(self, swarm1):
        allcfs = swarm1().allcfs
        allcfs.setParam("ring/effect", 7)
        assert [cf.getParam("ring/effect") for cf in allcfs.crazyflies] == [7, 7]

    def test_start_trajectory_honours_relative(self, flying, figure8):
        time_helper, allcfs, a, b = flying()
        for cf in (a, b):
            cf.uploadTrajectory(0, 0, figure8)
        allcfs.startTrajectory(0, relative=False)
        time_helper.sleep(1.0)
        assert np.allclose(a.position(), b.position())

    def test_server_can_be_made_by_hand(self):
        from pycrazyswarm.crazyflieSim import CrazyflieServer, TimeHelper

        time_helper = TimeHelper(VisNull(), 0.1, False, 0.0, maxVel=2.0, videopath=None)
        text = "crazyflies: [{id: 3, initialPosition: [0, 0, 0]}]"
        allcfs = CrazyflieServer(time_helper, text)
        allcfs.takeoff(1.0, 1.0)
        time_helper.sleep(1.2)
        assert allcfs.crazyfliesById[3].position()[2] == pytest.approx(1.0)
