"""lsy_drone_racing's simulation with several drones on one track.

Drones do not push or blow at each other there: what they do to each other is to touch. Each flies
in a :class:`~crazyarena.sim_backend.successor.SuccessorWorld` of its own; contacts between them are
looked for afterwards, at every tick, and stand in the traces of both.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from crazyarena.levels.lsy.draw import LsyDraw
from crazyarena.levels.lsy.schema import LsyLevel
from crazyarena.sim_backend.physics.successor_scene import (
    DRONE_HALF,
    NO_CONTACT,
    SOLID_SIZE,
    boxes_overlap,
    place_drone,
)
from crazyarena.sim_backend.successor import SuccessorWorld
from crazyarena.sim_backend.trace import TR_CONTACT, TR_POS, TR_QUAT

Array = NDArray[np.float64]

_REACH = 2.0 * float(np.linalg.norm(DRONE_HALF))  # m, centre to centre: no contact beyond


class SuccessorRace:
    """The simulation of a race; :meth:`reset` before the first :meth:`step`."""

    def __init__(self, level: LsyLevel) -> None:
        self._worlds = [SuccessorWorld(level) for _ in range(level.drones)]
        track = level.env.track
        self._first_code = len(track.gates) + len(track.obstacles)
        self._boxes = np.zeros((2, SOLID_SIZE))

    def reset(self, draws: Sequence[LsyDraw]) -> None:
        """Place every drone as drawn (:meth:`~crazyarena.levels.lsy.draw.LsyRandom.race`)."""
        for world, draw in zip(self._worlds, draws, strict=True):
            world.reset(draw)

    @property
    def states(self) -> list[Array]:
        """(13,) a drone: position 3, velocity 3, quaternion 4 (x, y, z, w), body rates 3."""
        return [world.state for world in self._worlds]

    def step(self, commands: Sequence[Array | None]) -> list[Array | None]:
        """Fly one step of the environment.

        Parameters
        ----------
        commands: one a drone, in the level's mode; None for one that is out of the race, which
            is no longer there for the others.

        Returns
        -------
        The ticks of each drone, (k, TRACE_SIZE); None for those that are out. The code of a
        contact with drone i is the number of gates and obstacles, and i.
        """
        traces = [
            None if command is None else world.step(command)
            for world, command in zip(self._worlds, commands, strict=True)
        ]
        flying = [(drone, trace) for drone, trace in enumerate(traces) if trace is not None]
        for (a, first), (b, second) in combinations(flying, 2):
            self._meet(a, first, b, second)
        return traces

    def _meet(self, a: int, first: Array, b: int, second: Array) -> None:
        apart = first[:, TR_POS : TR_POS + 3] - second[:, TR_POS : TR_POS + 3]
        near = np.flatnonzero((apart * apart).sum(axis=1) < _REACH * _REACH)
        for tick in near.tolist():
            for box, row in zip(self._boxes, (first[tick], second[tick]), strict=True):
                place_drone(box, *row[TR_POS : TR_POS + 3], *row[TR_QUAT : TR_QUAT + 4])
            if boxes_overlap(*self._boxes):
                for row, other in ((first[tick], b), (second[tick], a)):
                    if row[TR_CONTACT] == NO_CONTACT:
                        row[TR_CONTACT] = self._first_code + other
