"""What scripts and files of Crazyswarm 1 and 2 rely on, beyond the calls that fly."""

from __future__ import annotations

import re
import subprocess
import sys
import warnings
from types import SimpleNamespace

import numpy as np
import pytest

from crazyarena.clock import VirtualClock, WallClock
from crazyarena.crazyswarm_compat import launch
from crazyarena.crazyswarm_compat.config import load_crazyflies_2
from crazyarena.crazyswarm_compat.crazyswarm2 import Crazyswarm
from crazyarena.crazyswarm_compat.link_watch import LinkWatch
from crazyarena.crazyswarm_compat.options import CrazyswarmWarning
from crazyarena.crazyswarm_compat.server_files import (
    LinkLimits,
    read_motion_capture,
    read_server,
)
from crazyarena.crazyswarm_compat.timehelper import WallTimeHelper
from crazyarena.crazyswarm_compat.uav_trajectory import Polynomial4D, Trajectory
from crazyarena.errors import CommandError, InputError
from crazyarena.sim_backend.arena import ArenaFleet
from crazyarena.sim_backend.physics.arena_plant import AB_CHARGE, AP_CAPACITY

FLEET = """
robots:
  %s
robot_types:
  cf21: {connection: crazyflie}
"""
ROBOT = '%s: {uri: "%s", initial_position: [%d, 0, 0], type: cf21}'


def fleet_text(*uris):
    lines = [ROBOT % (f"cf_{'abcdef'[k]}", uri, k) for k, uri in enumerate(uris)]
    return FLEET % "\n  ".join(lines)


class TestMessages:
    def test_pose_by_key_and_by_attribute(self, swarm2):
        swarm = swarm2()
        cf = swarm.allcfs.crazyflies[0]
        assert cf.get_pose() == {}
        swarm.allcfs.takeoff(1.0, 1.0)
        swarm.timeHelper.sleep(1.5)
        pose = cf.get_pose()
        assert pose["position"].z == pose.position.z == pytest.approx(1.0)
        assert pose["orientation"].w == pytest.approx(1.0)
        assert cf.poseStamped["id"] == cf.poseStamped.header.frame_id == "world"
        assert cf.poseStamped["pose"].position.x == pytest.approx(1.0)
        assert cf.poseStamped["timestamp_sec"] == 1
        assert cf.poseStamped.header.stamp.nanosec == cf.poseStamped["timestamp_nsec"]
        assert cf.status["battery"] == cf.status.battery
        assert type(cf.status["id"]) is str
        with pytest.raises(AttributeError, match="no 'nothing'"):
            _ = pose.nothing

    def test_param_types_of_a_vehicle_and_of_all(self, swarm2):
        allcfs = swarm2("--backend sim").allcfs
        for types in (allcfs.crazyflies[0].paramTypeDict, allcfs.paramTypeDict):
            assert types["stabilizer.controller"] == 2
            assert types["ctrlMel.kp_xy"] == 3
        allcfs.close()


class TestNode:
    def test_timer_in_simulated_time(self, swarm2):
        swarm = swarm2("--dt 0.05")
        allcfs, fired = swarm.allcfs, []
        timer = allcfs.create_timer(0.1, lambda: fired.append(swarm.timeHelper.time()))
        swarm.timeHelper.sleep(1.0)
        np.testing.assert_allclose(fired, np.arange(1, 11) * 0.1, atol=1e-6)
        timer.cancel()
        assert timer.is_canceled()
        swarm.timeHelper.sleep(1.0)
        assert len(fired) == 10
        timer.reset()
        swarm.timeHelper.sleep(0.25)
        assert len(fired) == 12

    def test_timer_in_wall_time_is_not_held_up_by_the_looks_of_a_sleep(self):
        from crazyarena.crazyswarm_compat.ros_like import NodeLike

        helper = WallTimeHelper(WallClock())
        node = NodeLike()
        node._init_node(helper)
        fired = []
        node.create_timer(0.01, lambda: fired.append(helper.time()))
        helper.sleep(0.5)
        assert len(fired) > 20  # every 50 ms would be ten

    def test_a_callback_may_sleep(self, swarm2):
        swarm = swarm2()
        fired = []

        def callback():
            fired.append(1)
            swarm.timeHelper.sleep(0.2)

        swarm.allcfs.create_timer(0.1, callback)
        swarm.timeHelper.sleep(0.5)
        assert fired

    def test_clock_and_logger(self, swarm2, capsys):
        swarm = swarm2()
        swarm.timeHelper.sleep(1.5)
        now = swarm.allcfs.get_clock().now()
        assert now.nanoseconds == 1_500_000_000
        assert (now.to_msg().sec, now.to_msg().nanosec) == (1, 500_000_000)
        logger = swarm.allcfs.get_logger()
        logger.info("up")
        logger.warn("down")
        logger.debug("hidden")
        assert capsys.readouterr().err.splitlines() == [
            "[INFO] [1.500] [CrazyflieAPI]: up",
            "[WARN] [1.500] [CrazyflieAPI]: down",
        ]

    def test_a_wrong_period(self, swarm2):
        with pytest.raises(CommandError, match="create_timer: period is 0"):
            swarm2().allcfs.create_timer(0, print)


class TestAddresses:
    def test_the_same_last_byte_on_two_channels(self):
        text = fleet_text("radio://0/10/2M/E7E7E7E7E8", "radio://0/20/2M/E7E7E7E7E8")
        with pytest.warns(UserWarning, match=r"robots\.cf_b\.uri: the last byte .* that of cf_a"):
            swarm = Crazyswarm(crazyflies_yaml=text, args="--backend sim --vis null")
        allcfs = swarm.allcfs
        assert len(allcfs.crazyflies) == 2
        assert allcfs.crazyfliesById[0xE8] is allcfs.crazyfliesByName["cf_b"]
        allcfs.crazyfliesByName["cf_b"].takeoff(0.5, 1.0)
        swarm.timeHelper.sleep(1.5)
        heights = [cf.position[2] for cf in allcfs.crazyflies]
        np.testing.assert_allclose(heights, [0.0, 0.5], atol=0.1)
        allcfs.close()

    def test_three_of_them_and_a_number_that_is_taken(self):
        uris = [f"radio://0/{channel}/2M/E7E7E7E7E8" for channel in (10, 20, 30)]
        with pytest.warns(UserWarning, match="the last byte of its address"):
            fleet = load_crazyflies_2(fleet_text(*uris, "radio://0/10/2M/E7E7E7E7FF"))
        assert len({vehicle.id for vehicle in fleet.vehicles}) == 4
        assert all(0 <= vehicle.id <= 255 for vehicle in fleet.vehicles)

    @pytest.mark.parametrize("dongle", [0, 1])
    def test_one_link_for_two(self, dongle):
        text = fleet_text("radio://0/10/2M/E7E7E7E7E8", f"radio://{dongle}/10/2M/E7E7E7E7E8")
        with pytest.raises(InputError, match=r"robots\.cf_b\.uri: .*cf_a has this one"):
            load_crazyflies_2(text)


class TestTrajectories:
    rows = np.zeros((2, 33))
    rows[:, 0] = 3.0

    def load(self, tmp_path, header, rows=None):
        path = tmp_path / "pieces.csv"
        rows = self.rows if rows is None else rows
        lines = [",".join(map(str, row)) for row in rows]
        path.write_text("\n".join([*header, *lines]) + "\n", encoding="utf-8")
        trajectory = Trajectory()
        trajectory.loadcsv(path)
        return trajectory

    @pytest.mark.parametrize(
        "header", [[], ["duration,x^0,x^1"], ["Duration"], ["# made by hand"], [","]]
    )
    def test_csv_with_and_without_a_header(self, tmp_path, header):
        assert self.load(tmp_path, header).n_pieces() == 2

    def test_a_first_row_that_is_no_piece_is_not_taken_for_a_header(self, tmp_path):
        with pytest.raises(InputError, match="line 1: 5 columns"):
            self.load(tmp_path, ["1,2,3,4,5"])

    def test_32_pieces_fly_in_simulation(self, swarm1):
        # A straight line up and back in 40 pieces; a vehicle's memory ends at 31.
        trajectory = Trajectory()
        for k in range(40):
            z = 0.5 + 0.01 * k
            line = [z, 0.1] + [0.0] * 6
            trajectory.polynomials.append(
                Polynomial4D(0.1, [1.0] + [0.0] * 7, [0.0] * 8, line, [0.0] * 8)
            )
        trajectory.duration = 4.0
        swarm = swarm1("--backend sim")
        cf = swarm.allcfs.crazyflies[0]
        with pytest.warns(UserWarning, match=r"a real vehicle refuses it: 40 pieces"):
            cf.uploadTrajectory(0, 0, trajectory)
        cf.takeoff(0.5, 1.5)
        swarm.timeHelper.sleep(2.0)
        cf.startTrajectory(0, relative=False)
        swarm.timeHelper.sleep(4.5)
        assert cf.position()[2] == pytest.approx(0.9, abs=0.05)
        swarm.allcfs.close()


class TestParameters:
    @pytest.mark.parametrize("backend", ["ideal", "sim"])
    def test_one_that_the_firmware_lacks_is_a_warning(self, swarm1, backend):
        swarm = swarm1(f"--backend {backend}")
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            swarm.allcfs.setParam("no/such", 1)
        if backend == "sim":
            assert any("'no.such'" in str(w.message) for w in caught)
        swarm.allcfs.takeoff(0.5, 1.0)
        swarm.allcfs.close()


class TestFiles:
    @pytest.fixture
    def folder(self, tmp_path):
        (tmp_path / "crazyflies.yaml").write_text(
            fleet_text("radio://0/10/2M/E7E7E7E7E8"), encoding="utf-8"
        )
        return tmp_path

    @staticmethod
    def refused(folder):
        """The vehicle list has a link that cannot be, so that nothing is connected."""
        (folder / "crazyflies.yaml").write_text(
            fleet_text("radio://0/200/2M/E7E7E7E7E8"), encoding="utf-8"
        )
        return pytest.raises(InputError, match=r"uri: found .*; expected")

    def test_what_is_not_read_is_named(self, folder):
        (folder / "server.yaml").write_text(
            "/crazyflie_server: {ros__parameters: {sim: {backend: np, max_dt: 0},"
            " warnings: {communication: {publish_stats: true}}}}\n",
            encoding="utf-8",
        )
        with pytest.warns(CrazyswarmWarning, match="not read: sim.backend, sim.max_dt; --backend"):
            Crazyswarm(crazyflies_yaml=folder / "crazyflies.yaml", args="--sim --vis null")
        words = "not read: warnings.communication.publish_stats"
        with self.refused(folder), pytest.warns(CrazyswarmWarning, match=words):
            Crazyswarm(crazyflies_yaml=folder / "crazyflies.yaml", args="")

    def test_motion_capture_yaml_says_where_poses_come_from(self, folder, capsys):
        capture = folder / "motion_capture.yaml"
        text = "/motion_capture_tracking: {ros__parameters: {type: %s, hostname: 1.2.3.4%s}}\n"
        capture.write_text(text % ("vicon", ""), encoding="utf-8")
        assert read_motion_capture(folder) == ("vicon:1.2.3.4", None)
        with self.refused(folder):
            Crazyswarm(crazyflies_yaml=folder / "crazyflies.yaml", args="")
        assert "poses from --mocap vicon:1.2.3.4" in capsys.readouterr().err
        for args in ("--mocap none", "--mocap qualisys:10.0.0.1"):
            with self.refused(folder):
                Crazyswarm(crazyflies_yaml=folder / "crazyflies.yaml", args=args)
            assert "1.2.3.4" not in capsys.readouterr().err
        capture.write_text(text % ("optitrack", ", mode: libobjecttracker"), encoding="utf-8")
        spec, remark = read_motion_capture(folder)
        assert spec == "optitrack:1.2.3.4"
        assert "'libobjecttracker' is not read" in remark
        capture.write_text(text % ("mock", ""), encoding="utf-8")
        spec, remark = read_motion_capture(folder)
        assert spec is None
        assert "no poses of real vehicles" in remark
        capture.write_text(text % ("[1]", ""), encoding="utf-8")
        with pytest.raises(InputError, match=r"ros__parameters\.type: found \[1\]"):
            read_motion_capture(folder)

    def test_server_yaml_says_when_a_link_is_worth_a_warning(self, folder):
        assert read_server(folder, False) is None
        file = folder / "server.yaml"
        file.write_text(
            "/crazyflie_server:\n  ros__parameters:\n    warnings:\n      frequency: 2.0\n"
            "      motion_capture: {warning_if_rate_outside: [80.0, 120.0]}\n"
            "      communication: {max_unicast_latency: 10.0, min_unicast_ack_rate: 0.9}\n"
            "    firmware_params: {query_all_values_on_connect: true}\n",
            encoding="utf-8",
        )
        found = read_server(folder, False)
        assert found.limits == LinkLimits(0.5, (80.0, 120.0), pytest.approx(0.01), 0.9, None)
        assert found.read_all
        assert found.unread == ()
        for line, words in (
            ("frequency: 0", "warnings.frequency: found 0; expected a number above 0"),
            ("motion_capture: {warning_if_rate_outside: [80]}", "expected two numbers"),
            ("communication: {min_unicast_ack_rate: 90}", "expected a share from 0 to 1"),
        ):
            file.write_text(
                f"/crazyflie_server: {{ros__parameters: {{warnings: {{{line}}}}}}}\n",
                encoding="utf-8",
            )
            with pytest.raises(InputError, match=re.escape(words)):
                read_server(folder, False)


class Link:
    """A backend whose link is as bad as a test says."""

    latency, quality, sent, arrived = 0.004, 1.0, 0, 0

    def statistics(self, vehicle):
        return SimpleNamespace(
            latency_p50=self.latency, uplink_sent=self.sent, uplink_arrived=self.arrived
        )

    def telemetry(self, vehicle):
        return SimpleNamespace(link_quality=self.quality)


class TestLinkWatch:
    limits = LinkLimits(1.0, (80.0, 120.0), 0.01, 0.9, 0.9)

    def heard(self, watch, clock, seconds=1.05):
        clock.sleep_until(clock.now() + seconds)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            watch.check()
        return [str(w.message) for w in caught]

    def test_each_trouble_is_named_and_not_all_the_time(self):
        clock, link, poses = VirtualClock(), Link(), {1: SimpleNamespace(sent=0)}
        watch = LinkWatch(self.limits, link, {1: "cf1"}, clock, lambda: poses)

        def pass_time(rate):
            poses[1].sent += round(1.05 * rate)
            return self.heard(watch, clock)

        assert pass_time(100) == []
        assert pass_time(100) == []
        link.latency, link.quality = 0.034, 0.5
        link.sent, link.arrived = 100, 60
        assert pass_time(20) == [
            "cf1: round trip of 34 ms (server.yaml: 10)",
            "cf1: 50 % of the packets acknowledged (server.yaml: 90)",
            "cf1: 60 % of the packets arrive (server.yaml: 90)",
            "cf1: 20 poses a second (server.yaml: 80 to 120)",
        ]
        assert pass_time(20) == []
        for _ in range(8):
            pass_time(20)
        assert "cf1: round trip of 34 ms (server.yaml: 10)" in pass_time(20)

    def test_between_two_looks_it_does_not_look(self):
        clock, link = VirtualClock(), Link()
        watch = LinkWatch(self.limits, link, {1: "cf1"}, clock, None)
        link.latency = 0.5
        assert self.heard(watch, clock, 0.5) == []
        assert len(self.heard(watch, clock, 0.6)) == 1


class TestBattery:
    def test_low_then_empty_then_down(self):
        fleet = ArenaFleet([[0.0, 0.0, 0.0]])
        from crazyarena.crazyswarm_compat import commands as c

        for _ in range(200):
            fleet.external_truth()
            fleet.advance(10)
        rows = fleet.rows(0)
        rows.body[AB_CHARGE] = 0.92 * rows.plant[AP_CAPACITY]
        fleet.send(c.Takeoff(1.0, 2.0), 0)
        states, heights = [], []
        for _ in range(6000):
            fleet.external_truth()
            fleet.advance(10)
            states.append(fleet.telemetry(0).power_state)
            heights.append(fleet.bodies[0, 2])
        assert states[0] == 0
        assert 3 in states
        assert states.index(3) < states.index(4)
        assert states == sorted(states)
        assert heights[states.index(3)] > 0.8
        assert heights[-1] < 0.1

    def test_a_script_that_flies_until_the_battery_is_low(self, swarm2):
        swarm = swarm2("--backend sim")
        time_helper, cf = swarm.timeHelper, swarm.allcfs.crazyflies[0]
        rows = swarm.allcfs._link._fleet.rows(0)
        rows.body[AB_CHARGE] = 0.92 * rows.plant[AP_CAPACITY]
        cf.takeoff(0.5, 2.0)
        time_helper.sleep(2.5)
        for _ in range(100):
            if cf.get_status()["pm_state"] >= 3:
                break
            cf.goTo([0, 0, 0], 0, 1.0, relative=True)
            time_helper.sleep(1.0)
        else:
            pytest.fail("the battery never became low")
        cf.land(0.02, 2.0)
        time_helper.sleep(3.0)
        assert cf.position[2] < 0.1
        swarm.allcfs.close()


class TestRun:
    @pytest.fixture
    def checkout(self, tmp_path):
        """A folder of scripts with a pycrazyswarm of its own, and a neighbour."""
        (tmp_path / "pycrazyswarm").mkdir()
        (tmp_path / "pycrazyswarm" / "__init__.py").write_text(
            "raise ImportError('no rospy')\n", encoding="utf-8"
        )
        (tmp_path / "uav_trajectory.py").write_text("raise ImportError('theirs')\n")
        (tmp_path / "neighbour.py").write_text("NAME = 'neighbour'\n", encoding="utf-8")
        (tmp_path / "script.py").write_text(
            "import sys\n"
            "import neighbour, uav_trajectory\n"
            "import pycrazyswarm.util\n"
            "from pycrazyswarm import *\n"
            "if __name__ == '__main__':\n"
            "    print(neighbour.NAME, Crazyswarm.__module__, sys.argv)\n"
            "    sys.exit(7)\n",
            encoding="utf-8",
        )
        return tmp_path

    @pytest.mark.parametrize("inside", [True, False])
    def test_ours_first_and_the_other_neighbours(self, checkout, tmp_path_factory, inside):
        folder = checkout if inside else tmp_path_factory.mktemp("elsewhere")
        script = "script.py" if inside else str(checkout / "script.py")
        done = subprocess.run(
            [sys.executable, "-m", "crazyarena", "run", script, "--sim", "--vis", "null", "x"],
            cwd=folder,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 7, done.stderr
        assert done.stdout.startswith("neighbour crazyarena.crazyswarm_compat.crazyswarm1 ")
        assert done.stdout.rstrip().endswith(f"['{script}', '--sim', '--vis', 'null', 'x']")

    def test_no_such_script(self, tmp_path):
        with pytest.raises(InputError, match=r"nothing\.py: no such script"):
            launch.command(str(tmp_path / "nothing.py"), [])
