"""Where the things of a track of lsy_drone_racing may stand in an arena.

Its levels say by how much each axis of a gate, and each of its angles, may differ from nominal:
the range it is drawn from in simulation. What is not drawn is placed by hand. The origin of a gate
is the centre of its opening, that of an obstacle its top.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

from crazyarena.levels.lsy.arena import start_offsets
from crazyarena.levels.lsy.schema import LsyLevel, Spec
from crazyarena.mocap.survey import Allowed
from crazyarena.safety.placement import BY_HAND, MEASURING
from crazyarena.types import Pose

_ANY = (-math.pi, math.pi)


def lsy_nominal(level: LsyLevel) -> dict[str, Pose]:
    """Poses of the level's track bodies: ``gate1`` ..., ``obstacle1`` ..."""
    track = level.env.track
    poses = {
        f"gate{i + 1}": Pose(
            np.array(gate.pos, float), Rotation.from_euler("xyz", gate.rpy).as_quat()
        )
        for i, gate in enumerate(track.gates)
    }
    upright = np.array([0.0, 0.0, 0.0, 1.0])
    for i, pole in enumerate(track.obstacles):
        poses[f"obstacle{i + 1}"] = Pose(np.array(pole.pos, float), upright)
    return poses


def lsy_allowed(level: LsyLevel) -> dict[str, Allowed]:
    """How far each body of the track may be from nominal, axis by axis.

    Where the whole layout is drawn, anywhere inside the safety limits and with any heading.
    """
    track, random = level.env.track, level.env.randomizations
    count, poles = len(track.gates), len(track.obstacles)
    place = _ranges(random.gate_pos, count, *_hand(0))
    angles = _ranges(random.gate_rpy, count, *_hand(1))
    tops = _ranges(random.obstacle_pos, poles, *_hand(0))
    rules: dict[str, Allowed] = {}
    for i, gate in enumerate(track.gates):
        x, y, z = place[i]
        roll, pitch, yaw = angles[i]
        if track.randomize:
            x, y = _anywhere(level, gate.pos)
            yaw = _ANY
        rules[f"gate{i + 1}"] = Allowed(x, y, z, yaw, roll, pitch)
    for i, pole in enumerate(track.obstacles):
        x, y, z = tops[i]
        if track.randomize:
            x, y = _anywhere(level, pole.pos)
        # A pole is round.
        rules[f"obstacle{i + 1}"] = Allowed(x, y, z, _ANY)
    return rules


def start_problem(level: LsyLevel, x: float, y: float) -> str | None:
    """What is wrong with a vehicle that stands at x, y (m), axis by axis; None if nothing is."""
    offsets = start_offsets(level)
    nominal = level.env.track.drones[0].pos
    more = BY_HAND[0] if offsets is None else MEASURING[0]
    low, high = (np.zeros(3), np.zeros(3)) if offsets is None else offsets
    for axis, value in enumerate((x, y)):
        off = value - nominal[axis]
        if not low[axis] - more <= off <= high[axis] + more:
            return (
                f"stands {off * 1e2:+.1f} cm from the start in {'xy'[axis]}; "
                f"{(low[axis] - more) * 1e2:+.1f} to {(high[axis] + more) * 1e2:+.1f} cm are "
                "allowed"
            )
    return None


def _hand(kind: int) -> tuple[float, float]:
    return BY_HAND[kind], MEASURING[kind]


def _ranges(
    spec: Spec | None, count: int, by_hand: float, measuring: float
) -> list[list[tuple[float, float]]]:
    """(low, high) of three numbers of ``count`` things. What has no ends has those of a hand."""
    bounds = None if spec is None or count == 0 else spec.bounds((1, count, 3))
    if bounds is None:
        return [[(-by_hand, by_hand)] * 3 for _ in range(count)]
    low, high = (end.reshape(count, 3) for end in bounds)
    return [
        [(float(a) - measuring, float(b) + measuring) for a, b in zip(*rows, strict=True)]
        for rows in zip(low, high, strict=True)
    ]


def _anywhere(
    level: LsyLevel, nominal: tuple[float, ...]
) -> tuple[tuple[float, float], tuple[float, float]]:
    limits = level.env.track.safety_limits
    x, y = (
        (limits.pos_limit_low[i] - nominal[i], limits.pos_limit_high[i] - nominal[i])
        for i in (0, 1)
    )
    return x, y
