"""A distance is right when its closest points reach it and a plane between proves it."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from crazyarena.sim_backend.physics import gjk
from crazyarena.sim_backend.physics import scene as s

sizes = st.tuples(*[st.floats(0.0, 0.5)] * 3)
vectors = st.tuples(*[st.floats(-1.0, 1.0)] * 3)
kinds = st.sampled_from([s.BOX, s.CYLINDER])


def shape(kind, centre, turn, half) -> np.ndarray:
    row = np.zeros((1, s.ROW_SIZE))
    row[0, s.S_KIND] = kind
    row[0, s.S_CENTRE : s.S_CENTRE + 3] = centre
    row[0, s.S_ROTATION : s.S_ROTATION + 9] = Rotation.from_rotvec(turn).as_matrix().ravel()
    row[0, s.S_HALF : s.S_HALF + 3] = half
    return row


def reach(row, direction) -> float:
    """Support function in world coordinates."""
    centre = row[0, s.S_CENTRE : s.S_CENTRE + 3]
    return float(direction @ (centre + gjk.support(row, np.int64(0), *direction)))


@given(kinds, kinds, vectors, vectors, vectors, sizes, sizes)
@settings(max_examples=300, deadline=None)
def test_distance_has_a_certificate(kind_a, kind_b, centre, turn_a, turn_b, half_a, half_b):
    a = shape(kind_a, np.array(centre) * 2, turn_a, half_a)
    b = shape(kind_b, np.zeros(3), turn_b, half_b)
    zero = np.int64(0)
    scratch = np.zeros((gjk.SIMPLEX_ROWS, s.ROW_SIZE))
    d, nx, ny, nz, px, py, pz = gjk.distance(a, zero, b, zero, scratch, zero)
    if d > 1e-6:
        n = np.array([nx, ny, nz])
        point = np.array([px, py, pz]) + a[0, s.S_CENTRE : s.S_CENTRE + 3]
        # Both shapes lie on their side of a slab as wide as the distance ...
        assert abs(-reach(a, -n) - reach(b, n) - d) < 1e-5
        # ... and the closest point lies on A's face of it.
        assert abs(point @ n + reach(a, -n)) < 1e-5
    else:
        # No direction separates overlapping shapes.
        rng = np.random.default_rng(0)
        directions = rng.normal(size=(200, 3))
        directions /= np.linalg.norm(directions, axis=1)[:, None]
        assert max(-reach(a, -n) - reach(b, n) for n in directions) < 1e-5
