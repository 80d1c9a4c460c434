"""A level of lsy_drone_racing as what an arena is put together from.

Rig, fence and way home know a :class:`~crazyarena.levels.schema.Level`. That of such a level has
its safety limits as the fence and its vehicle's model; its gates and obstacles stand for what is
to be flown over. Rows of a drawn or measured track keep the level's own frames: gates (n, 7) are
x, y, z of the opening's centre, roll, pitch, yaw and a 0, obstacles (m, 6) x, y, z of the top and
zeros.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from crazyarena.errors import InputError
from crazyarena.levels.draw import Draw, _NoiseStream
from crazyarena.levels.lsy.draw import LsyDraw, LsyRandom, Nominal
from crazyarena.levels.lsy.schema import LsyLevel
from crazyarena.levels.schema import (
    Arena,
    Disturbances,
    Gate,
    GateType,
    Goal,
    Level,
    Obstacle,
    Profile,
    Start,
    Track,
    Vehicle,
)

Array = NDArray[np.float64]

MODELS = {
    "cf21B_500": "cf21b",
    "cf2x_L250": "cf21",
    "cf2x_P250": "cf21plus",
    "cf2x_T350": "cf21plus_thrust_kit",
}
"""Vehicle models (docs/fidelity.md) by the names of lsy_drone_racing."""
FASTEST = 100
"""Hz, up to which commands go to a vehicle in an arena."""
_BELOW = -0.1  # m, under which the fence begins: vehicles stand on the floor
_POLE = 0.95  # m, that an obstacle of ours is high
_MIDDLE = 1.0  # m, from which on a gate is a tall one


def arena_level(level: LsyLevel, seed: int) -> Level:
    """The arena of a level; ``seed`` is that of its draws.

    Raises
    ------
    InputError: its track does not lie inside its safety limits, or it is faster than a radio link.
    """
    env, track = level.env, level.env.track
    if env.freq > FASTEST:
        raise InputError(
            f"level {level.name}: env.freq: found {env.freq}; an arena takes up to {FASTEST} Hz"
        )
    low, high = track.safety_limits.pos_limit_low, track.safety_limits.pos_limit_high
    start = track.drones[0]
    x, y, z = start.pos
    floor = min(low[2], _BELOW)
    gates = []
    for gate in track.gates:
        kind = GateType.TALL if gate.pos[2] >= _MIDDLE else GateType.LOW
        gx, gy, gz = gate.pos
        gates.append(Gate(x=gx, y=gy, z=gz - kind.height, yaw=_span(gate.rpy[2]), type=kind))
    poles = [
        Obstacle(x=pole.pos[0], y=pole.pos[1], z=max(floor, pole.pos[2] - _POLE))
        for pole in track.obstacles
    ]
    try:
        return Level(
            name=level.name.lstrip("_.-")[:64] or "level",
            profile=Profile.ARENA,
            seed=min(seed, 2**63 - 1),
            reseed_on_reset=False,
            episode_length=level.duration,
            control_frequency=env.freq,
            vehicle=Vehicle(model=MODELS[level.sim.drone_model]),
            arena=Arena(low=(low[0], low[1], floor), high=high),
            start=Start(position=(x, y, z), attitude=start.rpy, tolerance=_start_reach(level)),
            goal=Goal(position=(x, y, z)),
            track=Track(gates=tuple(gates), obstacles=tuple(poles)),
        )
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or "track"
        raise InputError(
            f"level {level.name}: env.track: {where}: {first['msg']}; a real race has to lie "
            "inside env.track.safety_limits"
        ) from None


def _span(yaw: float) -> float:
    """Direction (rad) that a gate spans which is flown through along ``yaw``."""
    return math.remainder(yaw + 0.5 * math.pi, 2.0 * math.pi)


def start_offsets(level: LsyLevel) -> tuple[Array, Array] | None:
    """Least and largest x, y, z (m) that the drone may stand from its start; None: not said."""
    spec = level.env.randomizations.drone_pos
    bounds = None if spec is None else spec.bounds((1, 1, 3))
    return None if bounds is None else (bounds[0].reshape(3), bounds[1].reshape(3))


def _start_reach(level: LsyLevel) -> float:
    offsets = start_offsets(level)
    if offsets is None:
        return 0.15
    flat = np.maximum(np.abs(offsets[0]), np.abs(offsets[1]))[:2]
    return float(min(max(np.hypot(*flat) + 0.02, 0.05), 5.0))


class ArenaDraws:
    """Draws the worlds of consecutive episodes as an arena takes them.

    No disturbance is drawn: an arena brings its own. ``nominal``: mass (kg) and inertia (3,)
    (kg m^2) of the vehicle that flies.
    """

    def __init__(self, level: LsyLevel, mass: float, inertia: Sequence[float], seed: int) -> None:
        self._random = LsyRandom(level, Nominal(mass, np.diag(inertia)), seed)

    def reset(self) -> Draw:
        """Begin the next episode."""
        return as_draw(self._random.reset())


def as_draw(drawn: LsyDraw) -> Draw:
    """The same world in the rows of this module's text."""
    state = np.empty(12)
    state[0:6:2], state[1:6:2] = drawn.start[:3], drawn.start[3:6]
    state[6:9] = Rotation.from_quat(drawn.start[6:10]).as_euler("xyz")
    state[9:12] = drawn.start[10:13]
    rng = np.random.default_rng(0)
    nothing = _NoiseStream(rng, Disturbances())
    return Draw(
        state,
        drawn.mass,
        np.diag(drawn.inertia).copy(),
        rows_of(drawn.gates),
        rows_of(drawn.nominal_gates),
        poles_of(drawn.obstacles),
        nothing,
    )


def rows_of(gates: Array) -> Array:
    """Gates (n, 7) with a quaternion x, y, z, w to rows with angles and a 0."""
    angles = Rotation.from_quat(gates[:, 3:7]).as_euler("xyz")
    return np.hstack([gates[:, :3], angles, np.zeros((len(gates), 1))])


def quaternions_of(rows: Array) -> Array:
    """Rows (n, >= 6) of gates to (n, 7) with a quaternion x, y, z, w."""
    return np.hstack([rows[:, :3], Rotation.from_euler("xyz", rows[:, 3:6]).as_quat()])


def poles_of(tops: Array) -> Array:
    """Tops (m, 3) to rows (m, 6)."""
    return np.hstack([tops, np.zeros((len(tops), 3))])


__all__ = [
    "FASTEST",
    "MODELS",
    "ArenaDraws",
    "arena_level",
    "as_draw",
    "poles_of",
    "quaternions_of",
    "rows_of",
    "start_offsets",
]
