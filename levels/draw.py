"""The random numbers of a level, in the competition's order.

At a reset: for each obstacle x, y, yaw; for each gate x, y, yaw; mass, Ixx, Iyy, Izz; then the
start state in the order of ``STATE_NAMES``. Per physics tick: four normals (rotor forces), then
three uniforms (force on the body). What a level leaves out draws nothing. One generator serves
all of it: with ``reseed_on_reset`` it starts anew from the seed at every reset, without it the
stream runs on from episode to episode.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from crazyarena.errors import InputError
from crazyarena.levels.schema import (
    INERTIA_NAMES,
    STATE_NAMES,
    Disturbances,
    Level,
    RngKind,
)

Array = NDArray[np.float64]
AnyGenerator = np.random.Generator | np.random.RandomState

_BLOCK = 256  # ticks drawn ahead; calling into compiled code costs as much as some hundred draws


@dataclass(frozen=True, slots=True)
class Draw:
    """The world of one episode. Lengths m, angles rad, world frame; arrays are read-only.

    Attributes
    ----------
    start: (12,) x, vx, y, vy, z, vz, phi, theta, psi, p, q, r.
    mass: kg.
    inertia: (3,) Ixx, Iyy, Izz, kg m^2.
    gates: (n, 7) true x, y, z of the opening's centre, roll, pitch, yaw, type (0 tall, 1 low).
    nominal_gates: (n, 7) the same as listed in the level, so with the z of the gate's foot.
    obstacles: (m, 6) true x, y, z of the foot, roll, pitch, yaw.
    """

    start: Array
    mass: float
    inertia: Array
    gates: Array
    nominal_gates: Array
    obstacles: Array
    _noise: _NoiseStream = field(repr=False)

    @property
    def disturbed(self) -> bool:
        """False when :meth:`tick_noise` is all zeros."""
        return self._noise.active

    def tick_noise(self, n_ticks: int) -> Array:
        """Disturbances of the next ticks, (n, 7): rotor forces 4 (N), then world force 3 (N).

        Columns of an absent disturbance are zero. The array is the caller's to keep.

        Raises
        ------
        RuntimeError: the episode is over, that is, its :class:`LevelRandom` was reset again.
        """
        return self._noise.take(n_ticks)


class LevelRandom:
    """Draws the worlds of consecutive episodes.

    Parameters
    ----------
    level: what to draw.
    seed: replaces the level's own; of 128 random bits where nobody may guess the draw.

    Raises
    ------
    InputError: the seed is negative.
    """

    def __init__(self, level: Level, seed: int | None = None) -> None:
        self._level = level
        self._seed = level.seed if seed is None else seed
        if self._seed < 0:
            raise InputError(f"seed: expected a whole number >= 0, found {self._seed}")
        self._rng = make_generator(level.rng, self._seed)
        self._noise: _NoiseStream | None = None

    def reset(self) -> Draw:
        """Begin the next episode; the previous :class:`Draw` yields no more noise."""
        level = self._level
        if self._noise is not None:
            self._noise.close()
            if level.reseed_on_reset:
                self._rng = make_generator(level.rng, self._seed)
        rng, random = self._rng, level.randomization
        obstacles = _rows([obstacle.row for obstacle in level.track.obstacles], 6)
        nominal = _rows([gate.row for gate in level.track.gates], 7)
        gates = nominal.copy()
        gates[:, 2] += [gate.type.height for gate in level.track.gates]
        if random.gates_and_obstacles is not None:
            _shift(rng, obstacles, random.gates_and_obstacles.obstacles)
            _shift(rng, gates, random.gates_and_obstacles.gates)
        vehicle = _offset(
            rng,
            [getattr(level.vehicle, name) for name in INERTIA_NAMES],
            random.inertia,
            INERTIA_NAMES,
        )
        start = _offset(rng, level.start.state, random.start, STATE_NAMES)
        self._noise = _NoiseStream(rng, level.disturbances)
        inertia = vehicle[1:]
        for array in (start, inertia, gates, nominal, obstacles):
            array.flags.writeable = False
        return Draw(start, float(vehicle[0]), inertia, gates, nominal, obstacles, self._noise)


class SeparateDraws:
    """Worlds of consecutive episodes, each from a seed of its own: what was flown before has no
    part in the next one, so that they are the same for everybody.

    Raises
    ------
    InputError: a seed is negative.
    """

    def __init__(self, level: Level, seeds: Sequence[int]) -> None:
        self._random = iter([LevelRandom(level, seed) for seed in seeds])

    def reset(self) -> Draw:
        """Begin the next episode; raises StopIteration after the last one."""
        return next(self._random).reset()


def make_generator(kind: RngKind, seed: int) -> AnyGenerator:
    """Generator as gym seeded it: PCG64 since 0.22, Mersenne Twister up to 0.21."""
    if kind is RngKind.PCG64:
        return np.random.default_rng(seed)
    # gym 0.21 took the first eight bytes of a hash of the seed's digits as little-endian words,
    # and dropped leading zero words as it went through a big integer.
    digest = int.from_bytes(hashlib.sha512(str(seed).encode()).digest()[:8], "little")
    words = [digest & 0xFFFFFFFF]
    if digest >> 32:
        words.append(digest >> 32)
    return np.random.RandomState(words)


def _rows(rows: list[list[float]], width: int) -> Array:
    return np.array(rows, dtype=np.float64).reshape(-1, width)


def _shift(rng: AnyGenerator, rows: Array, bounds: tuple[float, ...]) -> None:
    for row in rows:
        for column in (0, 1, 5):
            row[column] += rng.uniform(bounds[0], bounds[1])


def _offset(
    rng: AnyGenerator, nominal: list[float], ranges: object, names: tuple[str, ...]
) -> Array:
    values = np.array(nominal, dtype=np.float64)
    for index, name in enumerate(names):
        bounds = getattr(ranges, name, None)
        if bounds is not None:
            values[index] += rng.uniform(bounds[0], bounds[1])
    return values


class _NoiseStream:
    """Per-tick draws from a generator it shares with the resets around it.

    Draws blocks ahead for speed; :meth:`close` puts the generator where tick-by-tick drawing
    would have left it, so that the next episode continues the same stream.
    """

    def __init__(self, rng: AnyGenerator, disturbances: Disturbances) -> None:
        action, force = disturbances.action, disturbances.dynamics
        self._rng = rng
        self._action = action is not None
        self._force = force is not None
        self._std = np.array(action.std if action else (0.0,) * 4)
        self._low = np.array(force.low if force else (0.0,) * 3)
        self._span = np.array(force.high if force else (0.0,) * 3) - self._low
        self._block = np.zeros((0, 7))
        self._used = 0
        self._before: Mapping[str, Any] = {}  # generator state at the start of the block
        self._closed = False

    @property
    def active(self) -> bool:
        return self._action or self._force

    def take(self, n_ticks: int) -> Array:
        if self._closed:
            raise RuntimeError("this draw's episode is over; use the one of the latest reset()")
        out = np.zeros((n_ticks, 7))
        if not self.active:
            return out
        if isinstance(self._rng, np.random.RandomState):
            self._fill_legacy(self._rng, out)
            return out
        done = 0
        while done < n_ticks:
            if self._used == len(self._block):
                self._before = self._rng.bit_generator.state
                self._block = np.zeros((_BLOCK, 7))
                self._fill(self._rng, self._block)
                self._used = 0
            count = min(n_ticks - done, len(self._block) - self._used)
            out[done : done + count] = self._block[self._used : self._used + count]
            self._used += count
            done += count
        return out

    def close(self) -> None:
        self._closed = True
        if isinstance(self._rng, np.random.Generator) and self._used < len(self._block):
            self._rng.bit_generator.state = self._before
            self._fill(self._rng, np.zeros((self._used, 7)))

    def _fill(self, rng: np.random.Generator, out: Array) -> None:
        from crazyarena.levels._noise import fill

        fill(rng, out, self._std, self._low, self._span, self._action, self._force)

    def _fill_legacy(self, rng: np.random.RandomState, out: Array) -> None:
        # Numba knows no RandomState objects; this generator is for comparisons, not for speed.
        for row in out:
            if self._action:
                row[:4] = self._std * rng.standard_normal(4)
            if self._force:
                row[4:] = self._low + self._span * rng.random_sample(3)
