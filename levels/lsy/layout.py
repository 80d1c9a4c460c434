"""Whole tracks at random, as ``track.randomize`` asks for.

A grid of 40 x 40 places over the safety limits less half a metre. A start is drawn anywhere in the
limits; the drone does not start there: it only keeps gates away and gives the first direction of
travel. Each gate stands at least 1 m from it and from the gates before, outside the corridors
flown so far, and faces the direction of travel within 0.75 rad. Each obstacle stands in the
corridor to its gate, at least 1 m from gates, obstacles and start. Where no place is left, any is
taken.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from crazyarena.levels.lsy.random_source import Array, Source, between, choice
from crazyarena.levels.lsy.schema import LsyTrack

_CELLS = 40
_BORDER = 0.5  # m
_APART = 1.0  # m
_CORRIDOR = 0.4  # m, half its width
_YAW = 0.75  # rad


def random_layout(source: Source, key: Any, track: LsyTrack) -> tuple[Array, Array]:
    """Draw a track.

    Returns
    -------
    gates: (n, 3) x, y (m) and yaw (rad, 0 .. 2 pi); obstacles: (m, 2) x, y.
    """
    limits = track.safety_limits
    low, high = np.array(limits.pos_limit_low[:2]), np.array(limits.pos_limit_high[:2])
    start = between(source, source.unit(key, (2,)), low, high)
    low, high = low + _BORDER, high - _BORDER
    x, y = np.meshgrid(np.linspace(low[0], high[0], _CELLS), np.linspace(low[1], high[1], _CELLS))
    places = np.stack([x, y], axis=-1).reshape(-1, 2)
    cell = (high - low) / _CELLS

    count = len(track.gates)
    keys = source.split(key, 2 * count + 1)
    obstacle_keys = source.split(keys[-1], count)
    far_from_start = _far(places, start)
    free = far_from_start.copy()
    far_from_gates = np.ones(len(places), bool)
    far_from_obstacles = np.ones(len(places), bool)
    gates, obstacles = np.zeros((count, 3)), np.zeros((count, 2))
    before = start
    for i in range(count):
        place = places[choice(source, keys[2 * i], free.astype(float))]
        _, jitter_x, jitter_y = source.split(keys[2 * i], 3)
        jitter = [float(source.unit(k, ())) - 0.5 for k in (jitter_x, jitter_y)]
        place = place + np.array(jitter) * cell
        yaw = float(between(source, source.unit(keys[2 * i + 1], ()), -_YAW, _YAW))
        ahead = place - before
        yaw += math.atan2(ahead[1], ahead[0])
        gates[i] = *place, yaw % (2.0 * math.pi)
        far_from_gates &= _far(places, place)
        corridor = _corridor(places, before, place)
        free &= far_from_gates & ~corridor
        room = corridor & far_from_gates & far_from_obstacles & far_from_start
        obstacles[i] = places[choice(source, obstacle_keys[i], room.astype(float))]
        far_from_obstacles &= _far(places, obstacles[i])
        before = place
    return gates, obstacles[: len(track.obstacles)]


def _far(places: Array, point: Array) -> Any:
    return ((places - point) ** 2).sum(-1) > _APART**2


def _corridor(places: Array, start: Array, end: Array) -> Any:
    way = end - start
    length = float(np.linalg.norm(way)) + 1e-8
    along = (places - start) @ (way / length)
    aside = np.linalg.norm(places - start - along[:, None] * (way / length), axis=-1)
    return (aside < _CORRIDOR) & (along >= 0.0) & (along <= length)
