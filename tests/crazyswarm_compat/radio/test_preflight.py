"""A vehicle is ready, or the error says what is wrong and what to do."""

import math
import threading
import time

import numpy as np
import pytest

from crazyarena.crazyswarm_compat import commands as c
from crazyarena.crazyswarm_compat.radio import Preparation, RadioOptions
from crazyarena.errors import BackendError
from crazyarena.types import Pose
from tests.waiting import eventually


@pytest.fixture
def feed():
    """Forward poses from a function at 100 Hz."""
    stop = threading.Event()
    threads = []

    def start(backend, poses):
        def run():
            while not stop.wait(0.01):
                backend.send_external_poses(poses())

        threads.append(threading.Thread(target=run, daemon=True))
        threads[-1].start()

    yield start
    stop.set()
    for thread in threads:
        thread.join()


def test_ready(world):
    hangar, backend = world(2)
    backend.prepare(Preparation(controller=2, params={"ctrlMel.kp_xy": 0.5}))
    for k in range(2):
        assert hangar.fleet.get_param(k, "stabilizer.estimator") == 2
        assert hangar.fleet.get_param(k, "stabilizer.controller") == 2
        assert hangar.fleet.get_param(k, "ctrlMel.kp_xy") == 0.5
        position = hangar.position(k + 1)
        assert hangar.fleet.get_param(k, "kalman.initialY") == pytest.approx(position[1], abs=1e-3)
        estimate = hangar.fleet.telemetry(k).state.position
        np.testing.assert_allclose(estimate, position, atol=0.05)
        assert hangar.info(k + 1) & 2  # armed


@pytest.mark.parametrize("deck", ["lighthouse", "flow"])
def test_ready_by_its_own_deck(deck, world):
    hangar, backend = world(2, fed=False, deck=deck)
    backend.prepare(Preparation(onboard=True))
    for k in range(2):
        assert hangar.info(k + 1) & 2  # armed
        estimate = hangar.fleet.telemetry(k).state.position
        np.testing.assert_allclose(estimate, hangar.position(k + 1), atol=0.1)


def test_without_a_deck_it_is_not_ready(world):
    _, backend = world(fed=False, deck=None)
    # Virtual vehicles carry a flow deck that sees nothing, but for those of a simulation build.
    with pytest.raises(BackendError, match=r"did not converge.*standard deviation"):
        backend.prepare(Preparation(onboard=True, convergence_timeout=2.0))


def test_no_poses(world):
    _, backend = world(fed=False)
    with pytest.raises(BackendError, match=r"cf1: no external poses are coming in \(none yet\)"):
        backend.prepare()


def test_poses_that_stopped(world):
    _, backend = world(fed=False)
    backend.send_external_poses({1: Pose(np.zeros(3))})
    time.sleep(0.6)
    with pytest.raises(BackendError, match=r"cf1: .*\(the last \d\.\d s ago\)"):
        backend.prepare()


def test_every_vehicle_that_is_not_ready_is_named(world):
    hangar, backend = world(3, fed=False)
    hangar.feed(backend, (2,))
    with pytest.raises(BackendError) as caught:
        backend.prepare()
    assert "cf1:" in str(caught.value)
    assert "cf2:" not in str(caught.value)
    assert "cf3:" in str(caught.value)
    backend.prepare(vehicles=[2])


def test_low_battery(world):
    hangar, backend = world()
    hangar.server.set_battery(3.4)
    eventually(lambda: (backend.telemetry(1).battery or 9.0) < 3.6, 5.0)
    with pytest.raises(BackendError, match=r"cf1: battery at 3\.\d\d V; at least 3\.80 V wanted"):
        backend.prepare()
    backend.prepare(Preparation(battery=3.2))


def test_locked(world):
    _, backend = world()
    backend.send(c.Emergency())
    eventually(lambda: backend.supervisor(1) is not None and backend.supervisor(1).locked, 5.0)
    with pytest.raises(BackendError, match=r"cf1: is locked .* off and on again"):
        backend.prepare()


def test_in_the_air(world):
    _, backend = world()
    backend.prepare()
    backend.send(c.Takeoff(0.5, 1.0))
    time.sleep(1.3)
    with pytest.raises(BackendError, match=r"cf1: is flying; .* land first"):
        backend.prepare()


def test_one_that_has_just_landed_is_waited_for(world):
    """The firmware says for two seconds after its motors stopped that it flies."""
    _, backend = world()
    backend.prepare()
    backend.send(c.Takeoff(0.3, 1.0))
    eventually(lambda: backend.supervisor(1).flying, 5.0)
    backend.send(c.Land(0.0, 1.0))
    time.sleep(1.3)
    backend.prepare()


def test_an_estimate_that_does_not_settle_at_the_pose(world, feed):
    """Poses that jump between two places, as with swapped bodies."""
    _, backend = world(fed=False)
    feed(backend, lambda: {1: Pose(np.array([3.0 * (int(time.monotonic() * 4) % 2), 0.0, 0.0]))})
    with pytest.raises(BackendError, match=r"cf1: .*(from the external pose|did not converge)"):
        backend.prepare(Preparation(convergence_timeout=1.5, position_tolerance=0.02))


def test_heading_against_the_axes(world, feed):
    """The vehicle believes the heading it was told last; here the poses keep turning."""
    _, backend = world(fed=False)

    def turning():
        half = 2.5 * time.monotonic()
        return {1: Pose(np.zeros(3), np.array([0.0, 0.0, math.sin(half), math.cos(half)]))}

    feed(backend, turning)
    with pytest.raises(BackendError, match="cf1: its heading is"):
        backend.prepare(Preparation(convergence_timeout=1.5, yaw_tolerance=math.radians(1)))


def test_without_telemetry(world):
    _, backend = world(options=RadioOptions(health_rate=0.0))
    with pytest.raises(BackendError, match="cf1: does not report its supervisor"):
        backend.prepare()


def test_a_parameter_that_does_not_exist(world):
    _, backend = world()
    with pytest.raises(BackendError, match=r"cf1: no parameter 'my\.gain'"):
        backend.prepare(Preparation(params={"my.gain": 1.0}))


def test_not_connected(world):
    hangar, backend = world(options=RadioOptions(link_timeout=0.3))
    hangar.server.cut(5.0)
    eventually(lambda: not backend.connected(1), 5.0)
    with pytest.raises(BackendError, match="cf1: not connected"):
        backend.prepare()
