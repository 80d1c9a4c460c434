"""What the original simulators get wrong, each done right."""

from __future__ import annotations

import numpy as np
import pytest


@pytest.fixture
def flying(swarm1):
    swarm = swarm1()
    swarm.allcfs.takeoff(1.0, 2.0)
    swarm.timeHelper.sleep(2.5)
    return swarm.timeHelper, swarm.allcfs, swarm.allcfs.crazyflies[0]


def test_landed_vehicle_stays_and_takes_off_again(flying):
    time_helper, allcfs, cf = flying
    allcfs.land(0.02, 2.0)
    time_helper.sleep(5.0)
    assert np.allclose(cf.position(), [1, 0, 0.02])
    assert not cf.velocity().any()
    assert cf.mode == cf.MODE_IDLE
    allcfs.takeoff(0.5, 1.0)
    time_helper.sleep(1.1)
    assert np.allclose(cf.position(), [1, 0, 0.5])


def test_stopped_vehicle_stands_still(flying):
    time_helper, allcfs, cf = flying
    cf.goTo([0, 0, 1], 0, 2.0)
    time_helper.sleep(1.0)
    allcfs.stop()
    where = cf.position()
    for _ in range(5):
        time_helper.sleep(time_helper.dt)
        assert np.array_equal(cf.position(), where)


def test_yaw_rate_is_in_degrees_and_integrates(flying):
    time_helper, _, cf = flying
    cf.cmdVelocityWorld([0, 0, 0], yawRate=30.0)
    time_helper.sleep(2.0)
    assert cf.yaw() == pytest.approx(np.radians(60), abs=np.radians(3.1))
    assert cf.state.omega[2] == pytest.approx(np.radians(30))


def test_set_param_can_be_read_back(flying):
    _, allcfs, cf = flying
    allcfs.setParam("ring/effect", 7)
    assert cf.getParam("ring/effect") == 7


def test_emergency_locks(flying):
    time_helper, allcfs, cf = flying
    cf.goTo([0, 0, 1], 0, 2.0)
    time_helper.sleep(1.0)
    allcfs.emergency()
    where = cf.position()
    with pytest.warns(UserWarning, match="cf1: cmdPosition: ignored; the emergency stop locks"):
        cf.cmdPosition([5, 5, 5])
    time_helper.sleep(1.0)
    assert np.array_equal(cf.position(), where)


def test_notify_setpoints_stop_hovers_in_place(flying):
    time_helper, _, cf = flying
    cf.cmdVelocityWorld([1, 0, 0], 0)
    time_helper.sleep(0.5)
    cf.notifySetpointsStop()
    where = cf.position()
    time_helper.sleep(0.5)
    assert np.allclose(cf.position(), where)
    assert cf.mode == cf.MODE_HIGH_POLY


def test_stretched_trajectory_is_held_where_it_ends(flying, figure8):
    time_helper, _, cf = flying
    half = type(figure8)()
    half.polynomials = figure8.polynomials[:5]
    half.duration = sum(piece.duration for piece in half.polynomials)
    cf.uploadTrajectory(0, 0, half)
    for timescale in (0.5, 2.0):
        cf.startTrajectory(0, timescale=timescale, relative=False)
        time_helper.sleep(half.duration * timescale + 0.5)
        assert np.allclose(cf.position(), half.eval(half.duration).pos, atol=1e-5)


def test_log_is_written(swarm1, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    swarm = swarm1("--writecsv")
    swarm.allcfs.takeoff(1.0, 1.0)
    swarm.timeHelper.sleep(1.0)
    swarm.timeHelper.close()
    data = swarm.timeHelper.output.data
    assert data[1].shape == (10, 7)
    # Rows hold the state before each tick: the first one is the start, on the ground.
    assert np.allclose(data[10][0], [0, 0, -1, 0, 0, 0, 0])
    header, *lines = (tmp_path / "logcf1.csv").read_text().splitlines()
    assert header == "t,x,y,z,roll,pitch,yaw"
    written = np.array([[float(value) for value in line.split(",")] for line in lines])
    assert np.allclose(written, data[1])


def test_mask_reaches_notify_setpoints_stop(flying):
    _, _, cf = flying
    cf.setGroupMask(1)
    cf.cmdPosition([1, 0, 1])
    cf.notifySetpointsStop(100, groupMask=2)
    assert cf.mode == cf.MODE_LOW_POSITION
    cf.notifySetpointsStop(100, groupMask=1)
    assert cf.mode == cf.MODE_HIGH_POLY
