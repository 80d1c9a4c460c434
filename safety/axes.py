"""Names what is wrong with the axes of a camera system, from things that should be elsewhere."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

_NAMES = "xyz"
_SPREAD = 0.3  # m from the origin, at least: what lies there is the same in any axes


def explain_axes(seen: ArrayLike, wanted: ArrayLike, tolerance: float) -> str | None:
    """Which exchange or mirroring of axes puts everything where it should be.

    Parameters
    ----------
    seen, wanted: (n, 3) m, of the same things.
    tolerance: m that each may be off.

    Returns
    -------
    In words; None if the axes are right, or if no exchange of them explains it.
    """
    found, right = np.atleast_2d(np.asarray(seen)), np.atleast_2d(np.asarray(wanted))
    if len(found) == 0 or np.abs(right[:, :2]).max() < _SPREAD:
        return None
    if _off(found, right) <= tolerance:
        return None
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            if _off(found[:, order] * np.array(signs), right) <= tolerance:
                return _say(order, signs)
    return None


def _off(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.linalg.norm(a - b, axis=1).max())


def _say(order: Sequence[int], signs: Sequence[float]) -> str:
    axes = ", ".join(("-" if s < 0 else "") + _NAMES[i] for i, s in zip(order, signs, strict=True))
    matrix = np.eye(3)[list(order)] * np.array(signs)[:, None]
    kind = "mirrored" if np.linalg.det(matrix) < 0 else "turned"
    return f"the cameras' axes look {kind}: the arena's x, y, z are their {axes}"
