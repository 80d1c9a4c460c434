"""``initial_info``: what a contestant is told before the first episode.

A plain dictionary; the two values that cost something are objects that get to work on use.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyarena.levels.contract import level_info
from crazyarena.levels.schema import Level
from crazyarena.runner.contestant.contract_2022 import symbolic
from crazyarena.runner.contestant.contract_2022.shims import CONTRACT


class Canvas:
    """A private PyBullet client, for controllers that draw.

    Used where PyBullet expects a client id; it connects when PyBullet first asks for the number.
    """

    def __init__(self) -> None:
        self._client: int | None = None

    def __index__(self) -> int:
        """Client id; 0 where PyBullet is not installed (drawing then does nothing)."""
        if self._client is None:
            try:
                import pybullet
            except ImportError:
                return 0
            if hasattr(pybullet, "IS_STAND_IN"):
                return 0
            self._client = pybullet.connect(pybullet.DIRECT)
        return self._client

    __int__ = __index__

    def __deepcopy__(self, memo: dict[int, Any]) -> Canvas:
        return self

    def close(self) -> None:
        """Disconnect; idempotent."""
        if self._client is not None:
            import pybullet

            pybullet.disconnect(self._client)
            self._client = None


def initial_info(level: Level, canvas: Canvas, start: NDArray[np.float64]) -> dict[str, Any]:
    """Build the dictionary.

    Parameters
    ----------
    level: what is flown; only nominal values are told.
    canvas: PyBullet client for ``pyb_client``.
    start: (12,) true state at the start, for ``constraint_values``.

    Attributes of ``symbolic_model``, and the functions in ``symbolic_constraints``, need CasADi:
    they raise DependencyMissing without it.
    """
    info = level_info(level)
    info["symbolic_model"] = symbolic.LazyModel(level)
    info["symbolic_constraints"] = symbolic.constraints(level) or {}
    if level.constraints.state:
        position = np.array([start[0], start[2], start[4]])
        low, high = np.array(level.arena.low), np.array(level.arena.high)
        info["constraint_values"] = np.round(np.concatenate([low - position, position - high]), 8)
    info["urdf_dir"] = str(CONTRACT)
    info["pyb_client"] = canvas
    return info
