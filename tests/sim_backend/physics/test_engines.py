"""The native engine against PyBullet: free flight, contacts, landings."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from crazyarena.errors import InputError
from crazyarena.sim_backend.physics import competition_step as c
from crazyarena.sim_backend.physics.engine import NativeEngine
from crazyarena.sim_backend.physics.geometry import NO_CONTACT
from crazyarena.sim_backend.physics.pybullet_engine import PyBulletEngine
from crazyarena.sim_backend.physics.rigid_body import (
    FULL_PLANT_SIZE,
    P_GRAVITY,
    P_MASS,
    P_ROTOR_X,
    P_YAW,
    competition_plant,
)
from crazyarena.sim_backend.vehicles import default_rows
from tests.optional import needs_pybullet
from tests.sim_backend.physics.bullet_world import LEVEL_GATES, LEVEL_OBSTACLES

GROUND = len(LEVEL_GATES) + len(LEVEL_OBSTACLES)
ARENA_PLANT = default_rows().plant[:FULL_PLANT_SIZE]
PLANTS = [(ARENA_PLANT, 0.001), (competition_plant(), 0.002)]


@pytest.fixture
def engines():
    """Builds engines that are closed after the test."""
    made = []

    def make(kind, *args, **options):
        made.append(kind(*args, **options))
        return made[-1]

    yield make
    for engine in made:
        engine.close()


def swaying_forces(body, plant, t):
    """Rotor forces of a rough attitude loop that sways about hover and yaws."""
    x, y, z, w = body[c.B_QUAT : c.B_QUAT + 4]
    p, q, r = body[c.B_OMEGA : c.B_OMEGA + 3]
    roll, pitch = 2 * (w * x + y * z), 2 * (w * y - x * z)
    tx = 2e-3 * (0.3 * np.sin(5 * t) - roll) - 2.5e-4 * p
    ty = 2e-3 * (0.3 * np.cos(4 * t) - pitch) - 2.5e-4 * q
    tz = 2e-4 * (1.5 * np.sin(t) - r)
    a, b = tx / plant[P_ROTOR_X] / 4, ty / plant[P_ROTOR_X] / 4
    lift = plant[P_MASS] * plant[P_GRAVITY] / 4 * (1.02 + 0.1 * np.sin(2 * t))
    spin = tz / plant[P_YAW] / 4
    return lift + np.array([a - b + spin, a + b - spin, -a + b + spin, -a - b - spin])


@needs_pybullet
@pytest.mark.parametrize(("plant", "dt"), PLANTS)
def test_free_flight_agrees(engines, plant, dt):
    native = engines(NativeEngine, plant, dt=dt)
    bullet = engines(PyBulletEngine, plant, dt=dt)
    rng = np.random.default_rng(5)
    turn = Rotation.from_euler("ZYX", [0.7, 0.1, -0.2]).as_quat()
    for engine in (native, bullet):
        engine.reset([[0, 0, 50.0]], [turn], [[1.0, 0.5, 0.2]], [[0.5, -0.3, 1.0]])
    travelled = []
    squares = []
    for k in range(round(3.0 / dt)):
        rotors = swaying_forces(native.bodies[0], plant, k * dt)
        wind = rng.uniform(-0.1, 0.1, 3)
        for engine in (native, bullet):
            engine.step(rotors, wind)
        offset = native.bodies[0, c.B_POS : c.B_POS + 3] - bullet.bodies[0, c.B_POS : c.B_POS + 3]
        squares.append(offset @ offset)
        travelled.append(native.bodies[0, c.B_POS : c.B_POS + 3].copy())
    assert np.ptp(travelled, axis=0).max() > 1.0
    # Two centimetres would do; the same equations in the same order agree to rounding.
    assert np.sqrt(np.mean(squares)) < 1e-9
    angle = Rotation.from_quat(native.bodies[0, c.B_QUAT : c.B_QUAT + 4]).inv()
    angle *= Rotation.from_quat(bullet.bodies[0, c.B_QUAT : c.B_QUAT + 4])
    assert angle.magnitude() < 1e-7


@needs_pybullet
def test_link_frames_lag_as_in_the_competition(engines):
    plant = competition_plant()
    bullet = engines(PyBulletEngine, plant, dt=c.DT, ground=False, link_frames=True)
    bullet.reset([[0, 0, 1.0]])
    body = np.zeros(c.BODY_SIZE)
    c.set_pose(body, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
    rng = np.random.default_rng(6)
    for k in range(1000):
        rotors = swaying_forces(body, plant, k * c.DT)
        wind = rng.uniform(-0.1, 0.1, 3)
        bullet.step(rotors, wind)
        c.step(body, plant, *np.sqrt(rotors / c.KF), *wind)
    end = slice(c.B_POS, c.B_OMEGA + 3)
    np.testing.assert_allclose(body[end], bullet.bodies[0, end], atol=1e-8)


def track_engines(engines, plant, dt):
    return [
        engines(kind, plant, LEVEL_GATES, LEVEL_OBSTACLES, dt)
        for kind in (NativeEngine, PyBulletEngine)
    ]


def first_contact(engine, rotors, steps):
    """(step, code) of the first contact, or (-1, NO_CONTACT)."""
    for k in range(steps):
        engine.step(rotors)
        if engine.contacts[0] != NO_CONTACT:
            return k, int(engine.contacts[0])
    return -1, NO_CONTACT


@needs_pybullet
@pytest.mark.parametrize(("plant", "dt"), PLANTS)
def test_same_object_is_hit_at_the_same_step(engines, plant, dt):
    native, bullet = track_engines(engines, plant, dt)
    rng = np.random.default_rng(7)
    solids = native.scene[native.scene[:, 0] != 2.0]
    hit = set()
    for _ in range(40):
        # From half a metre away at up to 6 m/s towards some beam, post or base.
        target = solids[rng.integers(len(solids)), 2:5] + rng.normal(0, 0.03, 3)
        away = rng.normal(size=3) * [1, 1, 0.4]
        start = target + 0.6 * away / np.linalg.norm(away)
        start[2] = max(start[2], 0.15)
        velocity = (target - start) / np.linalg.norm(target - start) * rng.uniform(1.5, 6.0)
        turn = Rotation.from_euler("ZYX", [rng.uniform(-3, 3), *rng.normal(0, 0.3, 2)]).as_quat()
        results = []
        for engine in (native, bullet):
            engine.reset([start], [turn], [velocity])
            rotors = np.full(4, plant[P_MASS] * plant[P_GRAVITY] / 4)
            results.append(first_contact(engine, rotors, round(0.4 / dt)))
        # A graze may begin a step earlier in one of them.
        assert abs(results[0][0] - results[1][0]) <= 1
        assert results[0][1] == results[1][1]
        hit.add(results[0][1])
    assert len(hit) >= 6


@needs_pybullet
@pytest.mark.parametrize(("plant", "dt"), PLANTS)
@pytest.mark.parametrize("rpy", [(0, 0, 0), (0.2, 0.1, 0.5), (3.1, 0.0, 0.3)])
def test_drop_comes_to_rest_where_bullet_rests(engines, plant, dt, rpy):
    turn = Rotation.from_euler("ZYX", rpy[::-1]).as_quat()
    ends = []
    for engine in track_engines(engines, plant, dt):
        engine.reset([[-2.0, -2.0, 0.15]], [turn])
        for _ in range(round(4.0 / dt)):
            engine.step(np.zeros(4))
        ends.append(engine.bodies[0].copy())
        assert engine.contacts[0] == GROUND
        assert np.abs(engine.bodies[0, c.B_VEL : c.B_VEL + 3]).max() < 5e-3
    native, bullet = ends
    assert native[c.B_POS + 2] == pytest.approx(bullet[c.B_POS + 2], abs=1e-4)
    assert native[c.B_POS + 2] == pytest.approx(0.0135, abs=1e-4)
    np.testing.assert_allclose(native[c.B_POS : c.B_POS + 2], [-2, -2], atol=0.02)


@needs_pybullet
@pytest.mark.parametrize(("plant", "dt"), PLANTS)
@pytest.mark.parametrize("velocity", [(1.0, 0.5, -0.2), (0.0, 2.0, -0.5), (0.8, 0.0, -0.6)])
def test_sliding_landing_stops_where_bullet_stops(engines, plant, dt, velocity):
    ends = []
    for engine in track_engines(engines, plant, dt):
        engine.reset([[-2.0, -2.0, 0.02]], None, [velocity])
        for _ in range(round(2.0 / dt)):
            engine.step(np.zeros(4))
        ends.append(engine.bodies[0, c.B_POS : c.B_POS + 3] - [-2, -2, 0])
    native, bullet = ends
    slid = np.hypot(*native[:2])
    assert slid > 0.01
    assert np.hypot(*(native - bullet)[:2]) < 0.03 + 0.15 * slid


@pytest.mark.parametrize("dt", [0.001, 0.002])
@pytest.mark.parametrize("speed", [1.0, 4.0, 8.0])
def test_nothing_flies_through_a_beam_or_a_pole(engines, dt, speed):
    plant = competition_plant()
    native = engines(NativeEngine, plant, LEVEL_GATES, LEVEL_OBSTACLES, dt)
    rotors = np.full(4, plant[P_MASS] * plant[P_GRAVITY] / 4)
    for target in ((0.225, 1.5, 1.0), (-0.5, 1.5, 1.225), (-0.5, 1.5, 0.5), (1.5, 0.0, 0.6)):
        target = np.array(target) - ([0.5, 0, 0] if target[0] == 0.225 else [0, 0, 0])
        native.reset([target - [0.0, 0.5, 0.0]], None, [[0.0, speed, 0.0]])
        for _ in range(round(0.8 / speed / dt)):
            native.step(rotors)
            ahead = native.bodies[0, c.B_POS + 1] - target[1]
            beside = np.abs(native.bodies[0, [c.B_POS, c.B_POS + 2]] - target[[0, 2]])
            assert ahead < 0.0 or beside.max() > 0.02
        assert np.linalg.norm(native.bodies[0, c.B_VEL : c.B_VEL + 3]) < 0.8 * speed


@needs_pybullet
def test_vehicles_block_each_other_in_both_engines(engines):
    plants = [ARENA_PLANT, ARENA_PLANT]
    for kind in (NativeEngine, PyBulletEngine):
        engine = engines(kind, plants, dt=0.001, ground=False)
        engine.reset([[0, 0, 1], [0.5, 0.01, 1.002]], None, [[1.0, 0, 0], [-1.0, 0, 0]])
        touched = False
        hover = ARENA_PLANT[P_MASS] * ARENA_PLANT[P_GRAVITY] / 4
        for _ in range(400):
            engine.step(np.full((2, 4), hover))
            touched |= engine.partners.tolist() == [1, 0]
        assert touched
        assert engine.bodies[0, c.B_POS] < engine.bodies[1, c.B_POS] - 0.1


def test_engine_refuses_bad_plants():
    row = ARENA_PLANT.copy()
    row[P_MASS] = -0.01
    with pytest.raises(InputError, match="mass"):
        NativeEngine(row)
    with pytest.raises(InputError, match="shape"):
        NativeEngine(row[:4])


@needs_pybullet
def test_camera_sees_the_track(engines):
    engine = engines(PyBulletEngine, ARENA_PLANT, LEVEL_GATES, LEVEL_OBSTACLES)
    engine.reset([[0, 0, 1.0]])
    picture = engine.image([3, -5, 2], [0, 0, 0.7], width=160, height=120)
    assert picture.shape == (120, 160, 3)
    red, green, blue = picture.reshape(-1, 3).astype(int).T
    orange = (red > green + 40) & (green > blue + 20)
    assert 50 < orange.sum() < 6000
