from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crazyarena.sim_backend.physics import competition_step as c
from crazyarena.sim_backend.physics import fleet
from crazyarena.sim_backend.physics.geometry import VEHICLE_REACH, make_workspace
from crazyarena.sim_backend.physics.rigid_body import FULL_PLANT_SIZE, P_MASS, competition_plant
from crazyarena.sim_backend.vehicles import default_rows

ARENA_PLANT = default_rows().plant[:FULL_PLANT_SIZE]


def row_of(positions):
    bodies = np.zeros((len(positions), c.BODY_SIZE))
    bodies[:, c.B_POS : c.B_POS + 3] = positions
    bodies[:, c.B_QUAT + 3] = 1.0
    return bodies


coordinate = st.floats(-0.15, 0.15)


@given(
    st.lists(st.tuples(coordinate, coordinate, coordinate), min_size=2, max_size=6, unique=True),
    st.integers(0, 2**32 - 1),
)
@settings(max_examples=40, deadline=None)
def test_contacts_keep_momentum_and_never_add_approach(positions, seed):
    bodies = row_of(positions)
    rng = np.random.default_rng(seed)
    bodies[:, c.B_VEL : c.B_VEL + 3] = rng.normal(0, 1, (len(bodies), 3))
    plants = np.array([ARENA_PLANT if k % 2 else competition_plant() for k in range(len(bodies))])
    masses = plants[:, P_MASS]
    before = masses @ bodies[:, c.B_VEL : c.B_VEL + 3]
    partner = np.zeros(len(bodies), np.int64)
    pairs = fleet.vehicle_contacts(bodies, plants, 0.001, partner, make_workspace())
    np.testing.assert_allclose(masses @ bodies[:, c.B_VEL : c.B_VEL + 3], before, atol=1e-12)
    assert (pairs > 0) == (partner >= 0).any()
    for i, j in enumerate(partner):
        if j >= 0:
            apart = bodies[i, c.B_POS : c.B_POS + 3] - bodies[j, c.B_POS : c.B_POS + 3]
            assert np.linalg.norm(apart) < 2 * VEHICLE_REACH + 0.01


def test_every_close_pair_of_a_large_fleet_is_found():
    rng = np.random.default_rng(8)
    bodies = row_of(rng.uniform(-1, 1, (100, 3)) * [3, 3, 0])  # all level, in one plane
    plants = np.tile(ARENA_PLANT, (100, 1))
    partner = np.zeros(100, np.int64)
    pairs = fleet.vehicle_contacts(bodies, plants, 0.001, partner, make_workspace())
    at = bodies[:, c.B_POS : c.B_POS + 2]
    gaps = np.linalg.norm(at[:, None] - at[None], axis=2)[np.triu_indices(100, 1)]
    # Prisms of 32 sides: between corner to corner and face to face.
    assert (gaps < 0.1205).sum() <= pairs <= (gaps < 0.124).sum()
    assert pairs > 3


def test_downwash_falls_off_below_and_beside():
    def push(below, beside, lift=1.0):
        forces = np.zeros((2, 3))
        lifts = np.array([lift, 1.0])
        fleet.downwash(row_of([[0, 0, 2], [beside, 0, 2 - below]]), lifts, forces)
        assert not forces[0].any()
        assert not forces[1, :2].any()
        return -forces[1, 2]

    assert push(1.0, 0.0) == pytest.approx(2267.18 * (0.0231348 / 4) ** 2)
    assert push(1.0, 0.0) > push(1.5, 0.0) > push(3.0, 0.0) > 0.0
    assert push(1.0, 0.0) > push(1.0, 0.05) > push(1.0, 0.1)
    assert push(1.0, 0.6) == 0.0
    assert push(1.0, 0.0, lift=1.5) == 1.5 * push(1.0, 0.0)
    assert push(1.0, 0.0, lift=0.0) == 0.0
    assert push(0.1, 0.0) == push(0.5, 0.0)  # the fit's pole is cut off
    assert push(0.6875, 0.0) == pytest.approx(push(0.6874, 0.0), rel=1e-3)  # and its wakeless gap
