"""What Crazyswarm 1's own test suite asks of a simulator, at its tolerances."""

from __future__ import annotations

import re
import subprocess

import numpy as np
import pytest

from crazyarena.crazyswarm_compat.util import (
    check_ellipsoid_collisions,
    grid_yaml,
    poisson_disk_sample,
)

Z = 1.0
RADII = np.array([0.125, 0.125, 0.375])
FACING = """
crazyflies:
- {id: 1, channel: 100, initialPosition: [-1.0, 0.0, 0.0]}
- {id: 2, channel: 100, initialPosition: [1.0, 0.0, 0.0]}
"""


def airborne(swarm):
    swarm.allcfs.takeoff(targetHeight=Z, duration=1.0 + Z)
    swarm.timeHelper.sleep(1.5 + Z)
    return swarm.allcfs, swarm.timeHelper


def relative_path(time_helper, cf, duration):
    start, path = time_helper.time(), []
    while time_helper.time() - start < duration:
        path.append(cf.position() - cf.initialPosition)
        time_helper.sleep(time_helper.dt + 1e-6)
    return np.array(path)


def watch(time_helper, vehicles, until, radii=RADII):
    """Whether any two vehicles collided until the given time."""
    collided = False
    while time_helper.time() < until:
        positions = np.array([cf.position() for cf in vehicles])
        collided |= bool(check_ellipsoid_collisions(positions, radii).any())
        time_helper.sleep(time_helper.dt)
    return collided


class TestHighLevel:
    def test_take_off(self, swarm1):
        allcfs, _ = airborne(swarm1())
        for cf in allcfs.crazyflies:
            np.testing.assert_allclose(
                cf.position(), cf.initialPosition + np.array([0, 0, Z]), atol=1e-4
            )

    def test_go_to_arrives_with_the_very_last_tick(self, swarm1):
        allcfs, time_helper = airborne(swarm1())
        goals = [cf.initialPosition + np.array([1, 1, Z]) for cf in allcfs.crazyflies]
        for cf, goal in zip(allcfs.crazyflies, goals, strict=True):
            cf.goTo(goal, 0, 1.0)
        time_helper.sleep(1.0)
        for cf, goal in zip(allcfs.crazyflies, goals, strict=True):
            assert np.isclose(cf.position(), goal).all()

    def test_broadcast_go_to_is_relative(self, swarm1):
        allcfs, time_helper = airborne(swarm1())
        allcfs.goTo(np.ones(3), 0, 1.0)
        time_helper.sleep(2.0)
        for cf in allcfs.crazyflies:
            assert np.isclose(cf.position(), cf.initialPosition + np.array([1, 1, 2 * Z])).all()

    def test_landing(self, swarm1):
        allcfs, time_helper = airborne(swarm1())
        allcfs.land(targetHeight=0.02, duration=1.0 + Z)
        time_helper.sleep(1.0 + Z)
        for cf in allcfs.crazyflies:
            np.testing.assert_allclose(
                cf.position(), cf.initialPosition + np.array([0, 0, 0.02]), atol=1e-4
            )

    def test_trajectory_timescale(self, swarm1, figure8):
        swarm = swarm1()
        cf, time_helper = swarm.allcfs.crazyflies[0], swarm.timeHelper
        cf.uploadTrajectory(trajectoryId=100, pieceOffset=0, trajectory=figure8)
        cf.startTrajectory(100)
        time_helper.sleep(0.75 * figure8.duration)
        assert np.linalg.norm(cf.position() - cf.initialPosition) >= 0.5
        time_helper.sleep(figure8.duration)
        cf.startTrajectory(100, timescale=0.5)
        time_helper.sleep(0.75 * figure8.duration)
        assert np.linalg.norm(cf.position() - cf.initialPosition) <= 1e-3

    def test_trajectory_bounds(self, swarm1, figure8):
        swarm = swarm1()
        cf = swarm.allcfs.crazyflies[0]
        cf.uploadTrajectory(100, 0, figure8)
        cf.startTrajectory(100)
        x, y, _ = relative_path(swarm.timeHelper, cf, figure8.duration).T
        assert 0.9 < x.max() < 1.1
        assert -1.1 < x.min() < -0.9
        assert 0.4 < y.max() < 0.6
        assert -0.6 < y.min() < -0.4

    def test_trajectory_reverse(self, swarm1, figure8):
        swarm = swarm1()
        cf = swarm.allcfs.crazyflies[0]
        cf.uploadTrajectory(100, 0, figure8)
        cf.startTrajectory(100)
        forward = relative_path(swarm.timeHelper, cf, figure8.duration)
        cf.startTrajectory(100, reverse=True)
        backward = relative_path(swarm.timeHelper, cf, figure8.duration)
        assert len(forward) == len(backward)
        assert (np.linalg.norm(forward - backward[::-1], axis=1) < 0.2).all()

    def test_trajectory_broadcast(self, swarm1, figure8):
        swarm = swarm1()
        a, b = swarm.allcfs.crazyflies
        for cf in (a, b):
            cf.uploadTrajectory(100, 0, figure8)
        swarm.allcfs.startTrajectory(100)
        moved = 0.0
        while swarm.timeHelper.time() < figure8.duration:
            expected = b.initialPosition - a.initialPosition
            assert np.isclose(b.position() - a.position(), expected).all()
            moved = max(moved, np.linalg.norm(a.position() - a.initialPosition))
            swarm.timeHelper.sleep(swarm.timeHelper.dt + 1e-6)
        assert moved > 0.9

    def test_group_mask(self, swarm1):
        swarm = swarm1()
        allcfs, time_helper = swarm.allcfs, swarm.timeHelper
        a, b = allcfs.crazyflies
        a.setGroupMask(1)
        b.setGroupMask(2)
        allcfs.takeoff(Z, 1.0 + Z, groupMask=1)
        time_helper.sleep(1.5 + Z)
        rise = np.array([0, 0, Z])
        up_a, up_b = a.initialPosition + rise, b.initialPosition + rise
        np.testing.assert_allclose(a.position(), up_a, atol=1e-4)
        np.testing.assert_allclose(b.position(), b.initialPosition, atol=1e-4)
        allcfs.takeoff(Z, 1.0 + Z, groupMask=2)
        time_helper.sleep(1.5 + Z)
        np.testing.assert_allclose(a.position(), up_a, atol=1e-4)
        np.testing.assert_allclose(b.position(), up_b, atol=1e-4)


class TestLowLevel:
    @pytest.mark.parametrize("verb", ["full state", "position"])
    def test_setpoint_is_reached_from_the_ground(self, swarm1, verb):
        swarm = swarm1()
        cf = swarm.allcfs.crazyflies[0]
        goal = cf.initialPosition + np.array([1, 1, Z])
        if verb == "full state":
            cf.cmdFullState(goal, np.zeros(3), np.zeros(3), 0, np.zeros(3))
        else:
            cf.cmdPosition(goal, yaw=0.0)
        swarm.timeHelper.sleep(1.0)
        assert np.isclose(cf.position(), goal).all()

    def test_velocity(self, swarm1):
        swarm = swarm1()
        cf = swarm.allcfs.crazyflies[0]
        cf.cmdVelocityWorld(np.ones(3), yawRate=0)
        swarm.timeHelper.sleep(1.0)
        assert np.isclose(cf.velocity(), np.ones(3)).all()
        assert np.isclose(cf.position(), cf.initialPosition + 1.0).all()

    def test_velocity_with_disturbance(self, swarm1):
        swarm = swarm1("--disturbance 1.0")
        cf = swarm.allcfs.crazyflies[0]
        cf.cmdVelocityWorld(np.ones(3), yawRate=0)
        swarm.timeHelper.sleep(1.0)
        assert not np.isclose(cf.position(), cf.initialPosition + 1.0).any()

    def test_sleep_residual(self, swarm1):
        rng = np.random.default_rng(3)
        velocity = np.array([1.0, 2.0, 3.0])
        for _ in range(100):
            dt, step = 10 ** rng.uniform(-2, -0.5), rng.uniform(0.005, 0.5)
            swarm = swarm1(f"--dt {dt}")
            cf, time_helper = swarm.allcfs.crazyflies[0], swarm.timeHelper
            cf.cmdVelocityWorld(velocity, 0.0)
            elapsed = 0.0
            for _ in range(10):
                time_helper.sleep(step)
                elapsed += step
                assert -1e-9 <= elapsed - time_helper.time() < dt + 1e-9
            expected = cf.initialPosition + time_helper.time() * velocity
            assert np.isclose(cf.position(), expected).all()


class TestCollisionAvoidance:
    @pytest.fixture
    def facing(self, swarm1):
        def make(args=""):
            swarm = swarm1(args, FACING)
            return swarm, *swarm.allcfs.crazyflies

        return make

    @pytest.fixture
    def flying(self, facing):
        def make(args="", radii=RADII, **options):
            swarm, a, b = facing(args)
            airborne(swarm)
            if radii is not None:
                a.enableCollisionAvoidance([b], radii, **options)
                b.enableCollisionAvoidance([a, b], radii, **options)
            return swarm.timeHelper, a, b

        return make

    def test_velocity_mode_sidestep(self, facing):
        swarm, a, b = facing("--dt 0.05 --maxvel 1.0")
        a.enableCollisionAvoidance([b], RADII)
        b.enableCollisionAvoidance([a], RADII)
        a.cmdVelocityWorld([1.0, 0.0, 0.0], yawRate=0.0)
        b.cmdVelocityWorld([-1.0, 0.0, 0.0], yawRate=0.0)
        while not (a.position()[0] > 1.0 and b.position()[0] < -1.0):
            assert swarm.timeHelper.time() < 10.0
            assert not watch(swarm.timeHelper, (a, b), swarm.timeHelper.time() + 1e-3)

    def test_without_avoidance_they_collide(self, flying):
        time_helper, a, b = flying(radii=None)
        a.goTo([1.0, 0.0, 1.0], 0, 5.0)
        b.goTo([-1.0, 0.0, 1.0], 0, 5.0)
        assert watch(time_helper, (a, b), 10.0)

    def test_disabled_avoidance_lets_them_collide(self, flying):
        time_helper, a, b = flying()
        for cf in (a, b):
            cf.disableCollisionAvoidance()
        a.goTo([1.0, 0.0, 1.0], 0, 5.0)
        b.goTo([-1.0, 0.0, 1.0], 0, 5.0)
        assert watch(time_helper, (a, b), 10.0)

    def test_without_avoidance_crossing_paths_collide(self, flying):
        time_helper, a, b = flying(radii=None)
        a.goTo([1.0, 1.0, 1.0], 0, 5.0)
        b.goTo([-1.0, 1.0, 1.0], 0, 5.0)
        assert watch(time_helper, (a, b), 10.0)

    def test_go_to_does_not_collide(self, flying):
        time_helper, a, b = flying()
        a.goTo([1.0, 0.0, 1.0], 0, 5.0)
        b.goTo([-1.0, 0.0, 1.0], 0, 5.0)
        assert not watch(time_helper, (a, b), 10.0)

    def test_go_to_reaches_its_goal(self, flying):
        time_helper, a, b = flying()
        a.goTo([1.0, 0.0, 1.0], 0, 5.0)
        b.goTo([-1.0, 0.0, 1.0], 0, 5.0)
        time_helper.sleep(5)
        assert np.isclose(a.position(), [1.0, 0.0, 1.0]).all()
        assert np.isclose(b.position(), [-1.0, 0.0, 1.0]).all()

    def test_smaller_ellipsoid_passes_closer(self, flying):
        small = np.array([0.1, 0.1, 0.3])
        time_helper, a, b = flying(radii=small)
        a.goTo([1.0, 0.0, 1.0], 0, 5.0)
        b.goTo([-1.0, 0.0, 1.0], 0, 5.0)
        large_hit = small_hit = False
        while time_helper.time() < 10.0:
            positions = np.array([a.position(), b.position()])
            large_hit |= check_ellipsoid_collisions(positions, RADII).any()
            small_hit |= check_ellipsoid_collisions(positions, small).any()
            time_helper.sleep(time_helper.dt)
        assert large_hit
        assert not small_hit

    def test_crossing_paths(self, flying):
        time_helper, a, b = flying("--dt 0.01")
        a.goTo([1.0, 1.0, 1.0], 0, 5.0)
        b.goTo([-1.0, 1.0, 1.0], 0, 5.0)
        assert not watch(time_helper, (a, b), 10.0)
        assert np.isclose(a.position(), [1.0, 1.0, 1.0]).all()
        assert np.isclose(b.position(), [-1.0, 1.0, 1.0]).all()

    def test_position_setpoint_stays_valid(self, flying):
        time_helper, a, b = flying("--maxvel 1.0")
        a.cmdPosition([1.0, 0.0, 2.0], yaw=0.0)
        b.cmdPosition([-1.0, 0.0, 2.0], yaw=0.0)
        assert not watch(time_helper, (a, b), 10.0)
        assert np.isclose(a.position(), [1.0, 0.0, 2.0]).all()
        assert np.isclose(b.position(), [-1.0, 0.0, 2.0]).all()

    def test_random_goals(self, swarm1):
        swarm = swarm1(yaml=grid_yaml(3, 5, spacing=0.5))
        allcfs, time_helper = airborne(swarm)
        vehicles = allcfs.crazyflies
        n = len(vehicles)
        for cf in vehicles:
            cf.enableCollisionAvoidance(vehicles, RADII)
        np.random.seed(0)  # noqa: NPY002
        for _ in range(5):
            goals = poisson_disk_sample(n, dim=2, mindist=5 * RADII[0])
            heights = Z + 0.2 * np.random.uniform(-1.0, 1.0, size=n)  # noqa: NPY002
            goals = np.column_stack([goals, heights])
            for cf, goal in zip(vehicles, goals, strict=True):
                cf.goTo(goal, yaw=0.0, duration=5)
            assert not watch(time_helper, vehicles, time_helper.time() + 20.0)
            for cf, goal in zip(vehicles, goals, strict=True):
                np.testing.assert_allclose(cf.position(), goal, atol=1e-4)

    def test_bounding_box(self, flying):
        low, high = [-3, -3, -3], [5, 5, 5]
        time_helper, a, b = flying("--maxvel 1.0", bboxMin=low, bboxMax=high)
        inside, outside = np.array([4.0, 0.0, Z]), np.array([-4.0, 0.0, Z])
        a.cmdPosition(inside, yaw=0.0)
        b.cmdPosition(outside, yaw=0.0)
        while time_helper.time() < 10.0:
            assert (b.position() >= low).all()
            assert (b.position() <= high).all()
            time_helper.sleep(time_helper.dt)
        assert np.isclose(a.position(), inside).all()
        assert not np.isclose(b.position(), outside).all()
        assert b.position()[0] < -2.99

    def test_max_speed_zero(self, flying):
        time_helper, a, b = flying("--maxvel 1.0", maxSpeed=0.0)
        starts = a.position(), b.position()
        a.cmdPosition([1.0, 0.0, Z], yaw=0.0)
        b.cmdPosition([-1.0, 0.0, Z], yaw=0.0)
        while time_helper.time() < 10.0:
            time_helper.sleep(time_helper.dt)
            assert (a.velocity() == 0.0).all()
            assert (b.velocity() == 0.0).all()
        assert np.isclose(a.position(), starts[0]).all()
        assert np.isclose(b.position(), starts[1]).all()

    def test_max_speed_limit(self, flying):
        time_helper, a, b = flying("--maxvel 1.0", radii=None)
        a.enableCollisionAvoidance([b], RADII, maxSpeed=1.0)
        b.enableCollisionAvoidance([a], RADII, maxSpeed=3.0)
        a.cmdVelocityWorld([2.0, 0.0, 0.0], yawRate=0.0)
        b.cmdVelocityWorld([-2.0, 0.0, 0.0], yawRate=0.0)
        while not (a.position()[0] > 2.0 and b.position()[0] < -2.0):
            assert time_helper.time() < 10.0
            assert (np.abs(a.velocity()) < 1.2).all()
            assert (np.abs(b.velocity()) < 3.2).all()
            time_helper.sleep(time_helper.dt)


@pytest.mark.parametrize("yaw", np.linspace(-0.99 * np.pi, 0.99 * np.pi, 11))
def test_attitude_follows_acceleration(swarm1, yaw):
    swarm = swarm1()
    airborne(swarm)
    cf, time_helper = swarm.allcfs.crazyflies[0], swarm.timeHelper
    cf.goTo(np.zeros(3), yaw=yaw, duration=1.0, relative=True)
    time_helper.sleep(1.5)
    forward = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    left = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    for direction, axis, sign in ((forward, 1, 1), (-forward, 1, -1), (left, 0, -1), (-left, 0, 1)):
        cf.goTo(direction, yaw=0.0, duration=1.0, relative=True)
        time_helper.sleep(0.25)
        rpy = cf.rpy()
        assert rpy[axis] * sign > np.radians(20)
        assert abs(rpy[1 - axis]) < np.radians(0.001)
        assert abs(rpy[2] - yaw) < np.radians(0.001)
        time_helper.sleep(1.0)


def test_film(swarm1, tmp_path):
    image = pytest.importorskip("PIL.Image")
    path = tmp_path / "film.gif"
    swarm = swarm1(f"--dt {1 / 12} --vis mpl --video {path}")
    swarm.allcfs.takeoff(Z, 2.0)
    swarm.timeHelper.sleep(1.0)
    swarm.timeHelper._atexit()
    with image.open(path) as film:
        # Two equal frames in a row may be stored as one that lasts longer.
        milliseconds = 0
        for frame in range(film.n_frames):
            film.seek(frame)
            milliseconds += film.info["duration"]
    assert abs(milliseconds / 1e3 - swarm.timeHelper.time()) <= 0.1


def test_film_as_mp4(swarm1, tmp_path):
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
    path = tmp_path / "film.mp4"
    swarm = swarm1(f"--dt {1 / 12} --vis mpl --video {path}")
    swarm.allcfs.takeoff(Z, 2.0)
    swarm.timeHelper.sleep(1.0)
    swarm.timeHelper._atexit()
    frames, seconds = imageio_ffmpeg.count_frames_and_secs(str(path))
    assert frames == round(30 * swarm.timeHelper.time())
    found = subprocess.run(
        [imageio_ffmpeg.get_ffmpeg_exe(), "-i", path], capture_output=True, text=True
    ).stderr
    assert re.search(r"Video: h264 .*yuv420p.*30 fps", found)
    assert seconds == pytest.approx(swarm.timeHelper.time(), abs=0.1)


def test_yaml_text(swarm1):
    allcfs = swarm1().allcfs
    assert len(allcfs.crazyflies) == 2
    assert np.array_equal(allcfs.crazyfliesById[1].initialPosition, [1.0, 0.0, 0.0])
    assert np.array_equal(allcfs.crazyfliesById[10].initialPosition, [0.0, -1.0, 0.0])


def test_hardware_module_imports_without_ros():
    from pycrazyswarm.crazyflie import Crazyflie, CrazyflieServer, TimeHelper

    assert Crazyflie.takeoff
    assert CrazyflieServer.emergency
    assert TimeHelper().time() >= 0.0
