"""Helpers that Crazyswarm scripts import: collision test, random and regular formations."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

# Slightly below 2 so that touching ellipsoids do not count, at finite tracking accuracy.
_COLLIDING_DISTANCE = 1.97


def check_ellipsoid_collisions(positions: ArrayLike, radii: ArrayLike) -> NDArray[np.bool_]:
    """Tell which of ``positions`` (n, 3) m overlap another, for ellipsoids of ``radii`` (3,) m."""
    scaled = np.asarray(positions, dtype=np.float64) / np.asarray(radii, dtype=np.float64)
    distance = np.linalg.norm(scaled[:, None, :] - scaled[None, :, :], axis=2)
    np.fill_diagonal(distance, np.inf)
    return (distance < _COLLIDING_DISTANCE).any(axis=1)


def poisson_disk_sample(n: int, dim: int, mindist: float) -> NDArray[np.float64]:
    """Draw ``n`` points (n, dim), pairwise at least ``mindist`` m apart, by throwing darts.

    Uses the global NumPy generator, as scripts seed that one.
    """
    size = (1.25 * n) ** (1.0 / dim) * mindist
    points: list[NDArray[np.float64]] = []
    while len(points) < n:
        dart = size * np.random.uniform(-0.5, 0.5, dim)  # noqa: NPY002
        if all(np.linalg.norm(dart - point) >= mindist for point in points):
            points.append(dart)
    return np.array(points)


def grid_yaml(rows: int, cols: int, spacing: float = 0.5) -> str:
    """Text of a crazyflies.yaml: ids 0..rows*cols-1 on a grid around the origin, z = 0."""
    lines = ["crazyflies:"]
    for index in range(rows * cols):
        row, col = divmod(index, cols)
        x = spacing * (row - (rows - 1) / 2)
        y = spacing * (col - (cols - 1) / 2)
        lines.append(
            f"- {{id: {index}, channel: 100, type: default, initialPosition: [{x}, {y}, 0.0]}}"
        )
    return "\n".join(lines) + "\n"
