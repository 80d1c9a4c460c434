"""One test for each row of Crazyswarm2's tables of methods and attributes."""

from __future__ import annotations

import inspect
import math

import numpy as np
import pytest

from crazyarena.crazyswarm_compat import crazyswarm2
from crazyarena.crazyswarm_compat.joystick import Joystick
from crazyarena.crazyswarm_compat.options import CrazyswarmWarning

SIGNATURES = {
    "setGroupMask": ["groupMask"],
    "emergency": [],
    "takeoff": ["targetHeight", "duration", ("groupMask", 0)],
    "land": ["targetHeight", "duration", ("groupMask", 0)],
    "goTo": ["goal", "yaw", "duration", ("relative", False), ("groupMask", 0)],
    "startTrajectory": [
        "trajectoryId",
        ("timescale", 1.0),
        ("reverse", False),
        ("relative", True),
        ("groupMask", 0),
    ],
    "notifySetpointsStop": [("remainValidMillisecs", 100), ("groupMask", 0)],
    "uploadTrajectory": ["trajectoryId", "pieceOffset", "trajectory"],
    "arm": [("arm", True)],
    "getParam": ["name"],
    "setParam": ["name", "value"],
    "cmdFullState": ["pos", "vel", "acc", "yaw", "omega"],
    "cmdPosition": ["pos", ("yaw", 0.0)],
    "cmdHover": ["vx", "vy", "yaw_rate", "z_distance"],
    "get_status": [],
    "get_pose": [],
    "get_position": [],
}
BROADCASTS = {
    "emergency": [],
    "takeoff": ["targetHeight", "duration", ("groupMask", 0)],
    "land": ["targetHeight", "duration", ("groupMask", 0)],
    "goTo": ["goal", "yaw", "duration", ("groupMask", 0)],
    "startTrajectory": SIGNATURES["startTrajectory"],
    "arm": [("arm", True)],
    "setParam": ["name", "value"],
    "cmdFullState": ["pos", "vel", "acc", "yaw", "omega"],
}


def arguments(function):
    return [
        p.name if p.default is inspect.Parameter.empty else (p.name, p.default)
        for p in list(inspect.signature(function).parameters.values())[1:]
    ]


@pytest.mark.parametrize("name", SIGNATURES)
def test_signature_of_vehicle(name):
    assert arguments(getattr(crazyswarm2.Crazyflie, name)) == SIGNATURES[name]


@pytest.mark.parametrize("name", BROADCASTS)
def test_signature_of_fleet(name):
    assert arguments(getattr(crazyswarm2.CrazyflieServer, name)) == BROADCASTS[name]


@pytest.fixture
def flying(swarm2):
    swarm = swarm2()
    swarm.allcfs.takeoff(1, 2)
    swarm.timeHelper.sleep(2.5)
    return swarm.timeHelper, swarm.allcfs, *swarm.allcfs.crazyflies


def test_construction_without_arguments(tmp_path, monkeypatch, swarm2):
    (tmp_path / "config").mkdir()
    (tmp_path / "config" / "crazyflies.yaml").write_text(
        "robots: {cf5: {enabled: true, uri: 'radio://0/80/2M/E7E7E7E705', "
        "initial_position: [0, 1, 0], type: a}}\nrobot_types: {a: {}}"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["script.py", "--sim", "--vis", "null"])
    swarm = crazyswarm2.Crazyswarm()
    assert list(swarm.allcfs.crazyfliesByName) == ["cf5"]
    assert isinstance(swarm.input, Joystick)
    assert not hasattr(swarm.timeHelper, "rclpy")


def test_simulation_without_any_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", [str(tmp_path / "script.py"), "--sim", "--vis", "null"])
    with pytest.warns(CrazyswarmWarning, match=r"no crazyflies\.yaml found"):
        swarm = crazyswarm2.Crazyswarm()
    assert len(swarm.allcfs.crazyflies) == 1


class TestTime:
    def test_sleep_is_exact(self, swarm2):
        time_helper = swarm2().timeHelper
        time_helper.sleep(0.3)
        assert time_helper.time() == pytest.approx(0.3)
        time_helper.sleep(0.123)
        assert time_helper.time() == pytest.approx(0.423)
        assert time_helper.isShutdown() is False

    def test_rate_keeps_absolute_deadlines(self, swarm2):
        time_helper = swarm2().timeHelper
        for lap in range(30):
            time_helper.sleep(0.01 if lap % 2 else 0.02)
            time_helper.sleepForRate(30)
        assert time_helper.time() == pytest.approx(0.02 + 1.0, abs=1e-6)


class TestVehicle:
    def test_attributes(self, swarm2):
        cf = swarm2().allcfs.crazyflies[1]
        assert (cf.prefix, cf.uri) == ("/cfa", "radio://0/80/2M/E7E7E7E70A")
        assert np.array_equal(cf.initialPosition, [0, -1, 0])
        assert (cf.status, cf.position) == ({}, [0.0, 0.0, 0.0])
        assert (cf.pose, cf.poseStamped) == ({}, {})

    def test_position_is_refreshed_while_sleeping(self, flying):
        _, _, a, _ = flying
        assert isinstance(a.position, list)
        assert np.allclose(a.position, [1, 0, 1])
        assert a.get_position() == a.position
        assert np.allclose([a.get_pose().position.z, a.get_pose().orientation.w], [1, 1])
        assert a.poseStamped.header.frame_id == "world"
        assert a.poseStamped.header.stamp.sec == 2

    def test_group_mask(self, flying):
        time_helper, allcfs, a, b = flying
        a.setGroupMask(2)
        assert a.getParam("hlCommander.groupmask") == 2
        allcfs.land(0.1, 1, groupMask=2)
        time_helper.sleep(1.2)
        assert np.allclose([a.position[2], b.position[2]], [0.1, 1.0])

    def test_emergency_of_one(self, flying):
        time_helper, _, a, b = flying
        a.emergency()
        with pytest.warns(UserWarning, match="cf1: goTo: ignored"):
            a.goTo([0, 0, 1], 0, 1)
        b.goTo([0, 0, 2], 0, 1)
        time_helper.sleep(1.2)
        assert np.allclose(a.position, [1, 0, 1])
        assert np.allclose(b.position, [0, 0, 2])
        assert a.get_status()["supervisor"] & 64

    def test_go_to(self, flying):
        time_helper, allcfs, a, b = flying
        a.goTo([0, 0, 1], 1, 1)
        b.goTo([0, 1, 0], 0, 1, relative=True)
        time_helper.sleep(1)
        assert np.allclose(a.position, [0, 0, 1])
        assert np.allclose(b.position, [0, 0, 1])
        allcfs.goTo([1, 1, 1], 0, 1)
        time_helper.sleep(1)
        assert np.allclose(b.position, [1, 1, 2])

    def test_trajectory(self, flying, figure8):
        time_helper, allcfs, a, b = flying
        for cf in (a, b):
            cf.uploadTrajectory(0, 0, figure8)
        a.startTrajectory(0, timescale=2.0, relative=False)
        b.startTrajectory(0, reverse=True)
        time_helper.sleep(2.0)
        assert np.allclose(a.position, figure8.eval(1.0).pos, atol=1e-5)
        allcfs.startTrajectory(0, relative=False)
        time_helper.sleep(1.0)
        assert np.allclose(a.position, b.position)

    def test_arm(self, swarm2):
        swarm = swarm2()
        a, b = swarm.allcfs.crazyflies
        a.arm(True)
        swarm.allcfs.arm()
        swarm.allcfs.takeoff(1, 1)
        swarm.timeHelper.sleep(1)
        assert np.allclose([a.position[2], b.position[2]], 1)
        b.arm(False)
        swarm.timeHelper.sleep(0.1)
        assert a.get_status()["supervisor"] & 16
        assert not b.get_status()["supervisor"] & 16

    def test_params(self, swarm2):
        allcfs = swarm2().allcfs
        a, b = allcfs.crazyflies
        a.setParam("led.bitmask", 128.7)
        assert a.getParam("led.bitmask") == 128
        assert isinstance(a.getParam("led.bitmask"), int)
        allcfs.setParam("colAv.horizon", 2)
        assert [cf.getParam("colAv.horizon") for cf in (a, b)] == [2.0, 2.0]
        assert isinstance(b.getParam("colAv.horizon"), float)

    def test_unknown_param(self, swarm2):
        a = swarm2().allcfs.crazyflies[0]
        with pytest.warns(CrazyswarmWarning, match=r"cf1: no parameter 'no\.such'"):
            assert math.isnan(a.getParam("no.such"))
        with pytest.warns(CrazyswarmWarning, match=r"cf1: no parameter 'no\.such'"):
            a.setParam("no.such", 1)

    def test_param_types(self, swarm2):
        types = swarm2().allcfs.paramTypeDict
        assert (types["led.bitmask"], types["colAv.horizon"]) == (2, 3)

    def test_collision_avoidance_is_a_parameter(self, flying):
        time_helper, allcfs, a, b = flying
        for axis in "XYZ":
            allcfs.setParam(f"colAv.ellipsoid{axis}", 0.2)
        allcfs.setParam("colAv.maxSpeed", 2.0)
        allcfs.setParam("colAv.enable", 1)
        a.goTo([0, -1, 1], 0, 4)
        b.goTo([1, 0, 1], 0, 4)
        nearest = np.inf
        for _ in range(60):
            time_helper.sleep(0.1)
            nearest = min(nearest, np.linalg.norm(np.subtract(a.position, b.position)))
        assert nearest > 0.39
        assert np.allclose(a.position, [0, -1, 1])

    def test_cmd_full_state(self, swarm2):
        swarm = swarm2()
        swarm.allcfs.cmdFullState([1, 2, 3], [0, 0, 0], [0, 0, 0], 1, [0, 0, 0])
        swarm.timeHelper.sleep(0.1)
        for cf in swarm.allcfs.crazyflies:
            assert np.allclose(cf.position, [1, 2, 3])

    def test_cmd_position_and_hand_over(self, swarm2):
        swarm = swarm2()
        a, _ = swarm.allcfs.crazyflies
        a.cmdPosition([1, 0, 2], 1)
        swarm.timeHelper.sleep(0.2)
        assert np.allclose(a.position, [1, 0, 2])
        assert 2 * math.atan2(a.pose.orientation.z, a.pose.orientation.w) == pytest.approx(1.0)
        a.notifySetpointsStop()
        a.goTo([0, 0, 1], 0, 1)
        swarm.timeHelper.sleep(1)
        assert np.allclose(a.position, [0, 0, 1])

    def test_cmd_hover(self, swarm2):
        swarm = swarm2("--dt 0.01")
        a, _ = swarm.allcfs.crazyflies
        a.cmdPosition([0, 0, 1], math.pi / 2)
        swarm.timeHelper.sleep(0.1)
        a.cmdHover(1, 0, 0, 0.5)
        swarm.timeHelper.sleep(1)
        assert np.allclose(a.position, [0, 1, 0.5])
        # Counter-clockwise is positive: from facing +y to facing -x.
        a.cmdHover(0, 0, math.pi / 2, 0.5)
        swarm.timeHelper.sleep(1)
        a.cmdHover(1, 0, 0, 0.5)
        swarm.timeHelper.sleep(1)
        assert np.allclose(a.position, [-1, 1, 0.5], atol=1e-6)

    def test_status(self, swarm2):
        swarm = swarm2()
        a, _ = swarm.allcfs.crazyflies
        assert a.get_status() == {}
        swarm.timeHelper.sleep(1.5)
        status = a.get_status()
        assert set(status) == {
            "id", "timestamp_sec", "timestamp_nsec", "supervisor", "battery", "pm_state", "rssi",
            "num_rx_broadcast", "num_tx_broadcast", "num_rx_unicast", "num_tx_unicast",
        }  # fmt: skip
        assert (status["id"], status["timestamp_sec"]) == ("world", 1)
        assert status["timestamp_nsec"] == pytest.approx(5e8, abs=10)
        assert status["supervisor"] & 8
        assert not status["supervisor"] & 16
        assert 3.0 < status["battery"] <= 4.3

    def test_log_and_viewer_see_the_fleet(self, swarm2, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        swarm = swarm2("--writecsv")
        swarm.allcfs.takeoff(1, 1)
        swarm.timeHelper.sleep(1)
        swarm.timeHelper.close()
        rows = np.loadtxt(tmp_path / "logcf10.csv", delimiter=",", skiprows=1)
        assert rows.shape == (10, 7)
        assert rows[-1, 3] > 0.9


def test_fleet_by_name_and_id(swarm2):
    allcfs = swarm2().allcfs
    assert [cf.prefix for cf in allcfs.crazyflies] == ["/cf1", "/cfa"]
    assert allcfs.crazyfliesByName["cfa"] is allcfs.crazyfliesById[10]


def test_broadcast_emergency(swarm2):
    swarm = swarm2()
    swarm.allcfs.takeoff(1, 1)
    swarm.timeHelper.sleep(0.5)
    swarm.allcfs.emergency()
    before = [cf.position for cf in swarm.allcfs.crazyflies]
    swarm.timeHelper.sleep(1)
    assert [cf.position for cf in swarm.allcfs.crazyflies] == before
