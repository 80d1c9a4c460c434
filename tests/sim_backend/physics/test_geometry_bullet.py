"""Contacts, distances and rays as PyBullet sees them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from crazyarena.sim_backend.physics import geometry as g
from crazyarena.sim_backend.physics import scene as s
from crazyarena.sim_backend.physics.gjk import distance
from tests.sim_backend.physics.bullet_world import LEVEL_GATES, LEVEL_OBSTACLES, gate_rays

# A gate that also rolls and pitches: level files may ask for it.
GATES = [LEVEL_GATES[0], [2.0, -1.5, 0, 0.2, -0.15, 0.7, 1], *LEVEL_GATES[2:]]
LEVEL = (0.0, 0.0, 0.0, 1.0)


def attitude(rng, k):
    """Level with any yaw, moderately tilted, or anything, in turn."""
    yaw = rng.uniform(-np.pi, np.pi)
    if k % 3 == 0:
        return Rotation.from_euler("z", yaw).as_quat()
    if k % 3 == 1:
        return Rotation.from_euler("ZYX", [yaw, *rng.normal(0.0, 0.3, 2)]).as_quat()
    return Rotation.random(random_state=rng).as_quat()


def poses_near_surfaces(scene, count, seed):
    """Poses whose centre is 5 to 75 mm off the surface of some primitive."""
    rng = np.random.default_rng(seed)
    solid = np.flatnonzero(scene[:, s.S_KIND] != s.GROUP)
    found = 0
    while found < count:
        row = scene[rng.choice(solid)]
        half = row[s.S_HALF : s.S_HALF + 3]
        local = rng.uniform(-1, 1, 3) * (half + 0.07)
        axis = rng.integers(3)
        local[axis] = np.sign(local[axis]) * (half[axis] + rng.uniform(0.005, 0.075))
        rotation = row[s.S_ROTATION : s.S_ROTATION + 9].reshape(3, 3)
        position = row[s.S_CENTRE : s.S_CENTRE + 3] + rotation @ local
        if position[2] < 0.005:
            continue
        yield int(row[s.S_CODE]), position, attitude(rng, found)
        found += 1


def contact_doubtful(scene, work, band=0.5e-3):
    """True when some surface is within the band around the contact threshold."""
    gaps = [
        g.gap(scene, np.int64(i), work) for i in range(len(scene)) if scene[i, s.S_KIND] != s.GROUP
    ]
    return any(0.001 - band < gap < g.CONTACT_GAP + band for gap in [*gaps, g.ground_gap(work)])


def test_contacts_and_distances_agree(make_bullet):
    world = make_bullet(GATES)
    scene, work = s.build_scene(GATES, LEVEL_OBSTACLES), g.make_workspace()
    ground = s.ground_code(scene)
    touching = differing = 0
    for code, position, quaternion in poses_near_surfaces(scene, 3000, seed=1):
        world.place(position, quaternion)
        world.detect()
        theirs = world.contact()
        ours = g.first_contact(scene, ground, *position, *quaternion, work)
        touching += theirs >= 0
        if ours != theirs:
            g.place_vehicle(work, *position, *quaternion)
            assert contact_doubtful(scene, work), (position, quaternion, ours, theirs)
            differing += 1
        if code < 4:
            theirs = world.closest(code, 0.45)
            if theirs > -0.0015:  # beyond that the cores overlap
                ours = g.gate_distance(scene, code, 0.45, *position, *quaternion, work)
                assert ours == pytest.approx(theirs, abs=2e-4)
    assert 1000 < touching < 2000
    assert differing <= 3  # within the band, and rare there


def test_gate_visibility_agrees(make_bullet):
    world = make_bullet()
    scene, work = s.build_scene(LEVEL_GATES, []), g.make_workspace()
    rng = np.random.default_rng(2)
    seen = 0
    for k in range(1500):
        gate = k % 4
        x, y = LEVEL_GATES[gate][:2]
        position = np.array([x, y, 0.62]) + rng.uniform(-1, 1, 3) * [0.8, 0.8, 0.58]
        quaternion = attitude(rng, k)
        world.place(position, quaternion)
        exact = world.closest(gate, 0.6)
        ours = g.gate_in_range(scene, gate, 0.45, *position, *quaternion, work)
        seen += ours
        if abs(exact - 0.45) > 5e-4:
            assert ours == (exact < 0.45), (position, quaternion)
        if exact < 0.45:
            assert ours == (g.gate_distance(scene, gate, 0.45, *position, *quaternion, work) < 0.45)
    assert 300 < seen < 1200


def ray_doubtful(scene, gate, position, quaternion, work):
    """True when a ray passes, or starts, within 0.5 mm of where hits begin."""
    g.place_vehicle(work, *position, *quaternion)
    for offset in g.RAY_OFFSETS:
        start = g._place_ray(scene, gate, offset, work)
        d = distance(work, g.W_VEHICLE, work, g.W_OTHER, work, g.W_SIMPLEX)[0]
        if abs(d - g._RAY_MARGIN) < 0.5e-3:
            return True
        # The facets, which a point distance leaves out, take up to 0.3 mm more.
        if abs(g.point_distance(work, g.W_VEHICLE, *start) + 0.5e-3) < 0.8e-3:
            return True
    return False


def test_gate_rays_agree(make_bullet):
    world = make_bullet()
    scene, work = s.build_scene(LEVEL_GATES, LEVEL_OBSTACLES), g.make_workspace()
    rng = np.random.default_rng(3)
    hits = differing = 0
    for k in range(3000):
        gate = k % 4
        x, y, _, _, _, yaw, kind = LEVEL_GATES[gate]
        local = [rng.uniform(-0.23, 0.23), rng.uniform(-0.09, 0.09), rng.uniform(-0.28, 0.28)]
        position = np.array([x, y, 1.0 if kind == 0 else 0.525])
        position += Rotation.from_euler("z", yaw).apply(local)
        quaternion = attitude(rng, k)
        world.place(position, quaternion)
        world.detect()
        theirs = world.vehicle in world.ray_hits(*gate_rays(LEVEL_GATES[gate]))
        ours = g.gate_ray_hit(scene, gate, *position, *quaternion, work)
        hits += ours
        if ours != theirs:
            differing += 1
            assert ray_doubtful(scene, gate, position, quaternion, work), (position, quaternion)
    assert 800 < hits < 2200
    assert differing < 45


def test_gate_window_of_a_level_vehicle():
    """The figures of the competition contract, section 4.1."""
    scene, work = s.build_scene(LEVEL_GATES, []), g.make_workspace()
    gate = 3  # yaw 0: lateral is x, normal is y
    x, y = LEVEL_GATES[gate][:2]

    def passes(lateral, normal, vertical):
        at = (x + lateral, y + normal, 1.0 + vertical)
        return g.gate_ray_hit(scene, gate, *at, *LEVEL, work)

    assert passes(0.21, 0, 0)
    assert not passes(0.212, 0, 0)
    assert passes(-0.21, 0, 0)
    assert passes(0, 0.061, 0)
    assert not passes(0, 0.062, 0)
    assert passes(0, -0.061, 0)
    assert passes(0, 0, -0.174)
    assert not passes(0, 0, -0.1755)
    assert passes(0, 0, 0.2009)
    assert not passes(0, 0, 0.2015)


@pytest.mark.parametrize("tilt", [0.0, 0.35])
def test_rays_are_blocked_only_by_what_stands_in_the_gate(make_bullet, tilt):
    gates = [[0.0, 0.0, 0, tilt, 0, 0.4, 1]]
    for obstacle in ([2.0, 0, 0, 0, 0, 0], [0.05, 0.0, 0, 0, 0, 0]):
        scene, work = s.build_scene(gates, [obstacle]), g.make_workspace()
        world = make_bullet(gates, [obstacle])
        world.detect()
        theirs = any(body >= 0 for body in world.ray_hits(*gate_rays(gates[0])))
        assert g.gate_rays_blocked(scene, 0, work) == theirs


def test_ground_contact_of_the_start_pose():
    scene, work = s.build_scene([], []), g.make_workspace()
    g.place_vehicle(work, 0.0, 0.0, 0.03, *LEVEL)
    assert g.ground_gap(work) + s.MARGIN == pytest.approx(0.0175)
    assert g.first_contact(scene, 0, 0.0, 0.0, 0.03, *LEVEL, work) == g.NO_CONTACT
    assert g.first_contact(scene, 0, 0.0, 0.0, 0.0144, *LEVEL, work) == 0
    assert g.first_contact(scene, g.NO_GROUND, 0.0, 0.0, 0.0144, *LEVEL, work) == g.NO_CONTACT


def test_gates_come_before_obstacles_and_ground():
    gates, obstacles = [[0, 0, 0, 0, 0, 0, 1]], [[0.2, 0, 0, 0, 0, 0]]
    scene, work = s.build_scene(gates, obstacles), g.make_workspace()
    assert g.first_contact(scene, 2, 0.1, 0.0, 0.012, *LEVEL, work) == 0
    g.forget(work)
    assert g.first_contact(scene, 2, 0.3, 0.0, 0.012, *LEVEL, work) == 1
    g.forget(work)
    assert g.first_contact(scene, 2, 0.8, 0.0, 0.012, *LEVEL, work) == 2


def test_remembered_clearance_never_hides_a_contact():
    scene, work = s.build_scene(LEVEL_GATES, LEVEL_OBSTACLES), g.make_workspace()
    rng = np.random.default_rng(4)
    position = np.array([0.0, -2.0, 1.0])
    for _ in range(4000):
        position = np.clip(position + rng.normal(0, 0.05, 3), [-3, -3, 0.02], [3, 3, 1.5])
        remembered = g.first_contact(scene, 8, *position, *LEVEL, work)
        assert remembered == g.first_contact(scene, 8, *position, *LEVEL, g.make_workspace())
