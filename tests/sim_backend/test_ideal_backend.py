"""Order of work and of random draws of perfect tracking."""

from __future__ import annotations

import numpy as np
import pytest

from crazyarena.clock import VirtualClock
from crazyarena.crazyswarm_compat import commands as c
from crazyarena.crazyswarm_compat.backend import Backend
from crazyarena.crazyswarm_compat.config import load_crazyflies_1
from crazyarena.crazyswarm_compat.registry import InspectableBackend, SimOptions, open_backend

THREE = """
crazyflies:
- {id: 1, initialPosition: [0, 0, 0]}
- {id: 2, initialPosition: [1, 0, 0]}
- {id: 3, initialPosition: [2, 0, 0]}
"""


@pytest.fixture
def world():
    def make(**options):
        clock = VirtualClock()
        return clock, open_backend("ideal", load_crazyflies_1(THREE), clock, SimOptions(**options))

    return make


def test_protocols(world):
    _, backend = world()
    assert isinstance(backend, Backend)
    assert isinstance(backend, InspectableBackend)
    assert backend.vehicles == (1, 2, 3)


def test_three_normals_per_flying_vehicle_and_tick(world):
    clock, backend = world(disturbance=0.5)
    backend.send(c.VelocityWorld([1, 0, 0]), 1)
    backend.send(c.VelocityWorld([0, 1, 0]), 3)
    np.random.seed(7)  # noqa: NPY002
    clock.sleep_until(0.1)
    clock.sleep_until(0.2)
    found = [backend.state(1).vel, backend.state(3).vel]
    after = np.random.normal()  # noqa: NPY002
    np.random.seed(7)  # noqa: NPY002
    for _ in range(2):
        noise = [0.5 * np.random.normal(size=3) for _ in range(2)]  # noqa: NPY002
    assert np.allclose(found, [noise[0] + [1, 0, 0], noise[1] + [0, 1, 0]])
    assert after == np.random.normal()  # noqa: NPY002
    assert np.array_equal(backend.state(2).pos, [1, 0, 0])


def test_normals_are_drawn_without_disturbance_but_not_while_idle(world):
    clock, backend = world()
    np.random.seed(7)  # noqa: NPY002
    first = np.random.normal(size=4)  # noqa: NPY002
    np.random.seed(7)  # noqa: NPY002
    clock.sleep_until(1.0)
    assert np.random.normal() == first[0]  # noqa: NPY002
    np.random.seed(7)  # noqa: NPY002
    backend.send(c.Position([0, 0, 1]), 2)
    clock.sleep_until(1.1)
    assert np.random.normal() == first[3]  # noqa: NPY002


def test_speed_is_limited_before_noise(world):
    clock, backend = world(max_velocity=2.0, disturbance=0.1)
    backend.send(c.Position([10, 0, 0]), 1)
    np.random.seed(7)  # noqa: NPY002
    clock.sleep_until(0.1)
    np.random.seed(7)  # noqa: NPY002
    expected = np.array([2.0, 0, 0]) + 0.1 * np.random.normal(size=3)  # noqa: NPY002
    assert np.allclose(backend.state(1).vel, expected)
    assert np.allclose(backend.state(1).pos, 0.1 * expected)


def test_positions_of_others_are_those_of_the_tick_before(world):
    # All three fly side by side at one speed. If a vehicle saw where those before it in the
    # list have just gone, it would not find them at the same relative place as they find it.
    clock, backend = world()
    for vehicle in (1, 2, 3):
        backend.send(c.CollisionAvoidance(True, (0.2, 0.2, 0.6), max_speed=2.0), vehicle)
    backend.send(c.VelocityWorld([1, 0, 0]), 1)
    backend.send(c.VelocityWorld([-1, 0, 0]), 3)
    clock.sleep_until(0.1)
    a, b = backend.state(1), backend.state(3)
    assert np.allclose(a.vel, -b.vel)
    assert np.allclose(a.pos - [0, 0, 0], -(b.pos - [2, 0, 0]))


def test_avoidance_keeps_vehicles_level(world):
    clock, backend = world()
    backend.send(c.CollisionAvoidance(True, (0.1, 0.1, 0.3), max_speed=2.0), 1)
    backend.send(c.FullState([0, 0, 1], [0, 0, 0], [3, 0, 0], 0.4, [1, 2, 3]), 1)
    clock.sleep_until(0.1)
    state = backend.state(1)
    assert not state.acc.any()
    assert np.allclose(state.omega, [0, 0, 3])
    assert state.yaw == 0.4


def test_closed_backend_stands_still(world):
    clock, backend = world()
    backend.send(c.VelocityWorld([1, 0, 0]), 1)
    backend.close()
    backend.close()
    clock.sleep_until(1.0)
    assert np.array_equal(backend.state(1).pos, [0, 0, 0])


def test_construction_is_cheap_enough_for_many(world):
    swarms = [world() for _ in range(100)]
    for k, (clock, backend) in enumerate(swarms):
        backend.send(c.Position([k, 0, 0]), 1)
        clock.sleep_until(0.1)
    found = [backend.state(1).pos[0] for _, backend in swarms]
    assert np.allclose(found, np.arange(100))
