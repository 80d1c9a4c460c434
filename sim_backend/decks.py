"""Positioning decks in software: what a vehicle without cameras knows of its place.

They feed the simulated estimator as the drivers of the decks do, with the faults that matter to a
flight: an absolute system is a little off everywhere, and differently so at every place; one that
only measures how it moves is off by more and more.

- Lighthouse: base stations whose places were estimated. Errors of some centimetres that vary over
  metres, a precision of about a millimetre (A. Taffanel et al., "Lighthouse positioning system:
  dataset, accuracy, and precision for UAV research", 2021).
- Flow: optical flow gives the velocity over ground, a laser the height. A wrong scale, and noise
  that adds up to a random walk of the position. That of the heading is not modelled.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from crazyarena.errors import InputError
from crazyarena.mocap.rotations import conjugate, multiply, rotate
from crazyarena.sim_backend.firmware.kalman import MEAS_FLOW, MEAS_POSE
from crazyarena.types import Pose

Array = NDArray[np.float64]

_RANGE = 4.0  # m, beyond which the laser sees nothing
_LEAST_HEIGHT = 0.02  # m


class Deck(Protocol):
    """A deck on one vehicle.

    Attributes
    ----------
    period: ticks of 1 ms between measurements.
    parameters: firmware parameters that say that it is fitted.
    """

    period: int
    parameters: frozenset[str]

    def sense(self, pose: Pose, velocity: Array) -> tuple[int, Array]:
        """Measure a vehicle at a true pose, with a true velocity (3,) m/s in the world.

        Returns the kind of measurement and its row (7,): :func:`.firmware.kalman.kalman_measure`.
        """
        ...


@dataclass(frozen=True, slots=True)
class LighthouseModel:
    """rate Hz; error: standard deviation per axis of what does not change at a place, m;
    reach: m over which that becomes another; noise m; yaw: rad, constant error of the heading;
    attitude_noise rad."""

    rate: float = 50.0
    error: float = 0.015
    reach: float = 2.0
    noise: float = 0.001
    yaw: float = 0.02
    attitude_noise: float = 0.003


@dataclass(frozen=True, slots=True)
class FlowModel:
    """rate Hz; scale: standard deviation of the relative error of velocities; noise: m/s of one
    measurement; height_noise m; std_velocity, std_height: what the driver tells the filter."""

    rate: float = 100.0
    scale: float = 0.01
    noise: float = 0.1
    height_noise: float = 0.003
    std_velocity: float = 0.15
    std_height: float = 0.01


class Lighthouse:
    """See :class:`LighthouseModel`; errors of the geometry are drawn once. ``place`` (3,) m is
    what was measured last."""

    parameters = frozenset({"deck.bcLighthouse4"})

    def __init__(self, rng: np.random.Generator, model: LighthouseModel | None = None) -> None:
        self._model = model = model or LighthouseModel()
        self.period = round(1000.0 / model.rate)
        self._rng = rng
        # A smooth field: a few waves for each axis, whose sum has the variance that is wanted.
        self._waves = rng.normal(0.0, 1.0 / model.reach, (3, 4, 3))
        self._phases = rng.uniform(0.0, math.tau, (3, 4))
        self._yaw = float(rng.normal(0.0, model.yaw))
        self.place = np.zeros(3)

    def sense(self, pose: Pose, velocity: Array) -> tuple[int, Array]:
        model, rng = self._model, self._rng
        waves = np.sin(self._waves @ pose.position + self._phases).sum(axis=1)
        row = np.empty(7)
        row[:3] = pose.position + model.error * waves / math.sqrt(2.0)
        row[:3] += rng.normal(0.0, model.noise, 3)
        self.place = row[:3].copy()
        turn = 0.5 * (rng.normal(0.0, model.attitude_noise, 3) + (0.0, 0.0, self._yaw))
        turned = multiply(np.array((*turn, 1.0)), pose.quaternion)
        row[3:] = turned / np.linalg.norm(turned)
        return MEAS_POSE, row


class Flow:
    """See :class:`FlowModel`; the error of the scale is drawn once."""

    parameters = frozenset({"deck.bcFlow2"})

    def __init__(self, rng: np.random.Generator, model: FlowModel | None = None) -> None:
        self._model = model = model or FlowModel()
        self.period = round(1000.0 / model.rate)
        self._rng = rng
        self._scale = 1.0 + float(rng.normal(0.0, model.scale))

    def sense(self, pose: Pose, velocity: Array) -> tuple[int, Array]:
        model, rng = self._model, self._rng
        body = rotate(conjugate(pose.quaternion), velocity)
        seen = self._scale * body[:2] + rng.normal(0.0, model.noise, 2)
        height = max(_LEAST_HEIGHT, float(pose.position[2])) + rng.normal(0.0, model.height_noise)
        std = model.std_height if height < _RANGE else 1e3  # out of reach says nothing
        return MEAS_FLOW, np.array((*seen, height, model.std_velocity, std, 0.0, 0.0))


# Parameters that say which positioning decks are fitted.
_PARAMETERS = frozenset(
    f"deck.bc{name}" for name in ("Lighthouse4", "Loco", "DWM1000", "Flow2", "Flow")
)


class DeckRack:
    """Which vehicle of a fleet carries which deck, by index."""

    def __init__(self) -> None:
        self._decks: dict[int, Deck] = {}

    def fit(self, vehicle: int, deck: Deck) -> None:
        """Put a deck onto a vehicle; it feeds the estimator from now on."""
        self._decks[vehicle] = deck

    def on(self, vehicle: int) -> Deck | None:
        """The deck of a vehicle, if it has one."""
        return self._decks.get(vehicle)

    def fitted(self, vehicle: int, name: str) -> float | None:
        """What a vehicle says of a deck's parameter; None for other parameters, and without a
        deck."""
        deck = self._decks.get(vehicle)
        return None if deck is None or name not in _PARAMETERS else float(name in deck.parameters)

    def due(self, tick: int) -> Iterator[tuple[int, Deck]]:
        """Vehicles and decks that measure at a tick."""
        for vehicle, deck in self._decks.items():
            if tick % deck.period == 0:
                yield vehicle, deck

    def span(self, tick: int, most: int) -> int:
        """Ticks, at most ``most``, until one measures again."""
        return min([most, *(deck.period - tick % deck.period for deck in self._decks.values())])


_DECKS = {"lighthouse": Lighthouse, "flow": Flow}
KINDS = tuple(_DECKS)


def make_deck(kind: str, rng: np.random.Generator) -> Deck:
    """A deck by name; raises InputError for one that is not simulated."""
    if kind not in _DECKS:
        raise InputError(f"deck: found {kind!r}; choose {' or '.join(KINDS)}")
    return _DECKS[kind](rng)
