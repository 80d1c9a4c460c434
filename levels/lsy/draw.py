"""The random numbers of a level of lsy_drone_racing.

At a reset the key of the generator is split in two, for the drone and for the track. Drone:
inertia (nine entries of the matrix, row by row), mass, position, attitude. Track: the whole layout
if ``randomize`` asks for it (see :mod:`.layout`), then gate positions, gate attitudes, obstacle
positions, gate by gate. Then at every step of the environment one array for the command, and at
every physics tick in it one force. What a level leaves out draws nothing. In a race every array
of the drone, of commands and of forces is drawn for all drones at once, drone by drone.

``rng: pcg64`` takes all of that in this order from one stream. ``rng: threefry`` splits keys as
the original does (a split off the simulator's key before every array of the drone, of commands
and of ticks; the track's key split into as many keys as it has functions), so that a seed means
the same there and here; numbers are then rounded to single precision.
"""

from __future__ import annotations

import secrets
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from crazyarena.errors import InputError
from crazyarena.levels.lsy.layout import random_layout
from crazyarena.levels.lsy.random_source import Array, Source, draw, make_source, scaled
from crazyarena.levels.lsy.schema import DRAWN_DRONE, DRAWN_TRACK, LsyLevel, LsyRng, Spec


@dataclass(frozen=True, slots=True)
class Nominal:
    """Mass (kg) and inertia (3, 3) (kg m^2) of the vehicle before anything is drawn."""

    mass: float
    inertia: Array


@dataclass(slots=True)
class LsyDraw:
    """The world of one episode. m, rad, kg; quaternions x, y, z, w; world frame.

    start: (13,) position 3, velocity 3, quaternion 4, body rates 3. mass; inertia (3, 3).
    gates: (n, 7) true position and quaternion of the opening; obstacles: (m, 3) true tops.
    nominal_gates, nominal_obstacles: the same as told before they were seen.
    """

    start: Array
    mass: float
    inertia: Array
    gates: Array
    obstacles: Array
    nominal_gates: Array
    nominal_obstacles: Array
    _noise: _Noise = field(repr=False)
    _drone: int = 0
    _steps: int = 0

    def step_noise(self) -> tuple[Array, Array]:
        """Disturbances of the next step: of the command (k,), and N of each tick (ticks, 3).

        In a race they are drawn for all drones by whoever is the first to ask; one that has not
        asked for a step is out of the race.
        """
        self._steps += 1
        action, force = self._noise.step(self._steps)
        return action[self._drone], force[:, self._drone]


def fresh_seed() -> int:
    """A seed for levels that want a new one each time."""
    return secrets.randbelow(2**31)


def refuse_short_keys(level: LsyLevel) -> None:
    """Raise InputError if a secret seed of the level would have less than 128 bits."""
    if level.rng is LsyRng.THREEFRY:
        raise InputError(
            "--secret: rng threefry has keys of 64 bits; add --set rng=pcg64, which takes 128"
        )


class LsyRandom:
    """Draws the worlds of consecutive episodes, one stream through all of them.

    Raises
    ------
    InputError: the seed is negative.
    """

    def __init__(self, level: LsyLevel, nominal: Nominal, seed: int) -> None:
        if seed < 0:
            raise InputError(f"seed: expected a whole number >= 0, found {seed}")
        self._level = level
        self._nominal = nominal
        self._source, self._key = make_source(level.rng, seed)
        self._noise: _Noise | None = None

    def reset(self) -> LsyDraw:
        """Begin the next episode; the previous :class:`LsyDraw` is over."""
        return self.race()[0]

    def race(self) -> list[LsyDraw]:
        """Begin the next episode of a race: a draw a drone, with the same track in all of them."""
        level, source = self._level, self._source
        if self._noise is not None:
            self._key = self._noise.key
        key, track_key = source.split(self._key, 2)
        random, drones = level.env.randomizations, level.drones
        shapes = {"drone_inertia": (1, drones, 3, 3), "drone_mass": (1, drones, 1)}
        offsets: dict[str, Array] = {}
        for name in DRAWN_DRONE:
            spec = getattr(random, name)
            if spec is not None:
                key, own = source.split(key, 2)
                offsets[name] = draw(source, own, spec, shapes.get(name, (1, drones, 3)))[0]
        track = self._track(track_key)
        self._noise = _Noise(source, key, level)
        return [
            self._drone(drone, {name: each[drone] for name, each in offsets.items()}, track)
            for drone in range(drones)
        ]

    def _drone(
        self, drone: int, offsets: dict[str, Array], track: tuple[Array, Array, Array, Array]
    ) -> LsyDraw:
        level, noise = self._level, self._noise
        assert noise is not None
        start = level.env.track.drones[drone]
        rpy = np.array(start.rpy) + offsets.get("drone_rpy", 0.0)
        state = np.concatenate(
            [
                np.array(start.pos) + offsets.get("drone_pos", 0.0),
                start.vel,
                Rotation.from_euler("xyz", rpy).as_quat(),
                start.ang_vel,
            ]
        )
        inertia = self._nominal.inertia + offsets.get("drone_inertia", 0.0)
        mass = self._nominal.mass + float(np.ravel(offsets.get("drone_mass", 0.0))[0])
        if mass <= 0.0 or np.any(np.linalg.eigvals(inertia).real <= 0.0):
            raise InputError(
                f"level {level.name}: env.randomizations: drew a mass of {mass:.4g} kg with an "
                "inertia that no body has; make the ranges of drone_mass and drone_inertia smaller"
            )
        nominal_gates, nominal_obstacles, gates, obstacles = track
        return LsyDraw(
            state, mass, inertia, gates, obstacles, nominal_gates, nominal_obstacles, noise, drone
        )

    def _track(self, key: Any) -> tuple[Array, Array, Array, Array]:
        track, random, source = self._level.env.track, self._level.env.randomizations, self._source
        place = np.array([gate.pos for gate in track.gates], float)
        rpy = np.array([gate.rpy for gate in track.gates], float)
        tops = np.array([pole.pos for pole in track.obstacles], float).reshape(-1, 3)
        named = [name for name in DRAWN_TRACK if getattr(random, name) is not None]
        keys = source.split(key, len(named) + track.randomize)
        if track.randomize:
            drawn, poles = random_layout(source, keys.pop(0), track)
            place[:, :2], rpy[:, 2], tops[:, :2] = drawn[:, :2], drawn[:, 2], poles
        nominal, nominal_tops = _rows(place, rpy), tops.copy()
        for name, own in zip(named, keys, strict=True):
            target = {"gate_pos": place, "gate_rpy": rpy, "obstacle_pos": tops}[name]
            target += draw(source, own, getattr(random, name), (1, *target.shape))[0]
        return nominal, nominal_tops, _rows(place, rpy), tops


def _rows(place: Array, rpy: Array) -> Array:
    return np.hstack([place, Rotation.from_euler("xyz", rpy).as_quat()])


class _Noise:
    """Disturbances step by step; ``key`` is what the next episode goes on with."""

    def __init__(self, source: Source, key: Any, level: LsyLevel) -> None:
        self._source = source
        self._level = level
        self._action = level.env.disturbances.action
        self._force = level.env.disturbances.dynamics
        self._steps = 0
        self._drawn = np.empty(0), np.empty(0)
        self.key = key

    def step(self, number: int) -> tuple[Array, Array]:
        """Those of step ``number``, from 1, one after the other: (drones, k) for the commands,
        (ticks, drones, 3) N."""
        if number > self._steps:
            self._steps = number
            self._drawn = self._draw()
        return self._drawn

    def _draw(self) -> tuple[Array, Array]:
        width, ticks, drones = self._level.command_size, self._level.ticks, self._level.drones
        action, force = np.zeros((drones, width)), np.zeros((ticks, drones, 3))
        if self._action is not None:
            action = self._rows(self._action, 1, width)[0]
        if self._force is not None:
            force = self._rows(self._force, ticks, 3)
        return action, force

    def _rows(self, spec: Spec, count: int, width: int) -> Array:
        normal, drones = spec.fn == "normal", self._level.drones
        self.key, raw = self._source.rows(self.key, count, drones * width, normal=normal)
        return scaled(self._source, spec, raw.reshape(count, 1, drones, width))[:, 0]
