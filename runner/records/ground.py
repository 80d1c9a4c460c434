"""What a flight is drawn over, seen from above: arena, gates, obstacles and goal of any contract.

Plain: the process that draws loads nothing else with it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from crazyarena.sim_backend.physics.sizes import BASE_WIDTH, BEAM_LENGTH, OBSTACLE_RADIUS

if TYPE_CHECKING:
    from crazyarena.levels.lsy.schema import LsyLevel
    from crazyarena.levels.schema import Arena, Level

Array = NDArray[np.float64]

_ABOVE_FLOOR = 0.1  # m, that an arena reaches below the floor where its level says nothing


@dataclass
class Ground:
    """Where a flight takes place.

    name: of the level. low, high: its corners (3,) m. arena: its limits, where margins are wanted.
    gates: for each its ends from above (2, 2) m, where it truly stands; nominal: where the level
    file has those that stand elsewhere. order: which gate is to be passed when, by number.
    obstacles: (m, 2) m; radius: of one, foot: side of its foot, m, or 0. goal: x, y, radius in m.
    """

    name: str
    low: tuple[float, ...]
    high: tuple[float, ...]
    gates: list[Array]
    nominal: list[Array]
    obstacles: Array
    radius: float
    order: list[int]
    foot: float = 0.0
    goal: tuple[float, float, float] | None = None
    arena: Arena | None = None


def ground_of(level: Level, gates: Array, obstacles: Array) -> Ground:
    """Of a level whose gates (n, 7) and obstacles (m, 6) truly stand there."""
    nominal = [
        gate_line(row)
        for row, true in zip((np.array(g.row) for g in level.track.gates), gates, strict=True)
        if not np.allclose(row[[0, 1, 5]], true[[0, 1, 5]])
    ]
    goal = level.goal
    return Ground(
        level.name,
        level.arena.low,
        level.arena.high,
        [gate_line(row) for row in gates],
        nominal,
        np.array(obstacles[:, :2]),
        OBSTACLE_RADIUS,
        list(range(len(gates))),
        BASE_WIDTH,
        (goal.position[0], goal.position[1], goal.tolerance),
        level.arena,
    )


def lsy_ground(level: LsyLevel, gates: Array, nominal: Array, obstacles: Array) -> Ground:
    """Of a level of lsy_drone_racing, with the limits of its real race.

    gates: (n, 7) centres and quaternions, true; nominal: where they are told to be. obstacles:
    (m, >= 2), tops.
    """
    from crazyarena.levels.schema import Arena
    from crazyarena.sim_backend.physics.successor_scene import POLE_RADIUS

    limits = level.env.track.safety_limits
    low, high = limits.pos_limit_low, limits.pos_limit_high
    arena = Arena(low=(low[0], low[1], min(low[2], -_ABOVE_FLOOR)), high=high)
    true, told = _lines(gates), _lines(nominal)
    return Ground(
        level.name,
        arena.low,
        arena.high,
        true,
        [a for a, b in zip(told, true, strict=True) if not np.allclose(a, b)],
        np.array(obstacles[:, :2]),
        POLE_RADIUS,
        [abs(number) - 1 for number in level.env.track.order],
        arena=arena,
    )


def gate_line(row: Array) -> Array:
    """Ends (2, 2) of a gate (7,) of a level of ours from above, m."""
    half = BEAM_LENGTH / 2
    along = half * np.array([math.cos(row[5]), math.sin(row[5])])
    return np.stack([row[:2] - along, row[:2] + along])


def _lines(gates: Iterable[Array]) -> list[Array]:
    """Ends of gates (n, 7: centre, quaternion), which are flown through along their x, from
    above."""
    from scipy.spatial.transform import Rotation

    from crazyarena.sim_backend.physics.successor_scene import GATE_OUTSIDE

    found = []
    for gate in gates:
        along = Rotation.from_quat(gate[3:7]).apply([0.0, GATE_OUTSIDE / 2, 0.0])[:2]
        found.append(np.stack([gate[:2] - along, gate[:2] + along]))
    return found
