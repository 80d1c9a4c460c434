"""What the vehicle's own planner is doing, as far as commands tell.

The high-level commander of the firmware adds to the plan that it follows, not to where the
vehicle is: relative goals and the way to any goal begin there. While it follows none (on the
ground, or as long as setpoints are streamed) it begins at the vehicle's estimate.

Plans are polynomials of 7th order in time: place, velocity and acceleration at both ends, no
jerk there.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from crazyarena.safety.observation import Point, as_point

Array = NDArray[np.float64]

_POWERS = np.arange(8)
_JERK = np.array([6.0, 24.0, 60.0, 120.0, 210.0])  # of the third derivative, from order 3 on
# Of the coefficients of orders 4..7 over the unit interval: place, velocity, acceleration and
# jerk at its end.
_END = np.array([[1, 1, 1, 1], [4, 5, 6, 7], [12, 20, 30, 42], [24, 60, 120, 210]], dtype=float)
_FROM_END = np.linalg.inv(_END)


@dataclass(frozen=True, slots=True)
class Motion:
    """Place m, velocity m/s and acceleration m/s2, world."""

    position: Point
    velocity: Point = (0.0, 0.0, 0.0)
    acceleration: Point = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Plan:
    """A piecewise polynomial.

    Attributes
    ----------
    durations: (n,) s, as flown.
    coefficients: (n, 3, 8) ascending, of x, y, z over the time within the piece.
    """

    durations: Array
    coefficients: Array

    @property
    def duration(self) -> float:
        """s."""
        return float(self.durations.sum())

    @property
    def end(self) -> Point:
        """Where it comes to rest, m."""
        last = self.coefficients[-1] @ self.durations[-1] ** _POWERS
        return as_point(last)

    def at(self, time: float) -> Motion:
        """Motion ``time`` s after the beginning; at rest after the end."""
        for duration, axes in zip(self.durations, self.coefficients, strict=True):
            if time <= duration:
                rows = _evaluate(axes, np.array([max(time, 0.0)]))
                return Motion(*(as_point(row[0]) for row in rows))
            time -= float(duration)
        return Motion(self.end)

    def samples(self, least: int, step: float) -> tuple[Array, Array, Array]:
        """Places, velocities and accelerations (k, 3) along the way.

        At least ``least`` in each piece, at most ``step`` s apart as long as that takes no more
        than 400.
        """
        rows = [_evaluate(axes, times) for axes, times in self._looks(least, step)]
        places, velocities, accelerations = zip(*rows, strict=True)
        return np.concatenate(places), np.concatenate(velocities), np.concatenate(accelerations)

    def jerks(self, least: int, step: float) -> Array:
        """m/s3, (k, 3), at the same times."""
        return np.concatenate(
            [
                (_JERK * times[:, None] ** _POWERS[:5]) @ axes[:, 3:].T
                for axes, times in self._looks(least, step)
            ]
        )

    def _looks(self, least: int, step: float) -> list[tuple[Array, Array]]:
        """Coefficients and times of every piece."""
        looks = []
        for duration, axes in zip(self.durations, self.coefficients, strict=True):
            count = min(max(least, int(duration / step) + 1), 400)
            looks.append((axes, np.linspace(0.0, float(duration), count)))
        return looks

    def moved(self, shift: Array) -> Plan:
        """The same plan, ``shift`` (3,) m away."""
        coefficients = self.coefficients.copy()
        coefficients[:, :, 0] += shift
        return Plan(self.durations, coefficients)


def to_rest(start: Motion, goal: Point, duration: float) -> Plan:
    """The plan that the firmware makes from a motion to a rest."""
    scale = np.array([1.0, duration, 0.5 * duration**2])
    first = np.array([start.position, start.velocity, start.acceleration]).T * scale
    x0, x1, x2 = first.T
    wanted = np.array([goal - x0 - x1 - x2, -x1 - 2.0 * x2, -2.0 * x2, np.zeros(3)])
    unit = np.zeros((3, 8))
    unit[:, :3] = first
    unit[:, 4:] = (_FROM_END @ wanted).T
    return Plan(np.array([duration]), (unit / duration**_POWERS)[None])


def uploaded(pieces: Array, timescale: float, reverse: bool) -> Plan:
    """A trajectory (n, 33) as it is flown: stretched, and from its end if ``reverse``."""
    durations = pieces[:, 0]
    axes = pieces[:, 1:25].reshape(-1, 3, 8)
    if reverse:
        durations, axes = durations[::-1], axes[::-1]
        axes = np.array([_reversed(row, t) for row, t in zip(axes, durations, strict=True)])
    return Plan(durations * timescale, axes / timescale**_POWERS)


def _reversed(axes: Array, duration: float) -> Array:
    """Coefficients (3, 8) of p(duration - t)."""
    out = np.zeros_like(axes)
    for axis, row in enumerate(axes):
        mirrored = np.polynomial.Polynomial(row)(np.polynomial.Polynomial([duration, -1.0]))
        out[axis, : len(mirrored.coef)] = mirrored.coef
    return out


def _evaluate(axes: Array, times: Array) -> tuple[Array, Array, Array]:
    basis = times[:, None] ** _POWERS
    first = _POWERS[1:] * basis[:, :-1]
    second = _POWERS[2:] * _POWERS[1:-1] * basis[:, :-2]
    return basis @ axes.T, first @ axes[:, 1:].T, second @ axes[:, 2:].T


class Flown(Enum):
    """What gives the vehicle its setpoints."""

    NOTHING = "nothing"
    PLAN = "plan"
    STREAM = "stream"


@dataclass(slots=True)
class Planner:
    """The high-level commander of one vehicle (firmware of 2026).

    Attributes
    ----------
    slots: pieces of the trajectory memory that the plan in the air reads; empty for others.
    """

    flown: Flown = Flown.NOTHING
    plan: Plan | None = None
    begin: float = 0.0
    landing: bool = False
    slots: range = field(default_factory=lambda: range(0))

    def look(self, now: float) -> None:
        """Let time pass: a landing that is over leaves the planner idle."""
        if self.landing and self.plan is not None and now >= self.begin + self.plan.duration:
            self.stop()

    def origin(self, now: float, seen: Motion | None) -> Motion | None:
        """Where a go-to begins: on the plan, else at the vehicle; None if nobody knows."""
        self.look(now)
        if self.flown is Flown.PLAN and self.plan is not None:
            return self.plan.at(now - self.begin)
        return None if seen is None else Motion(seen.position, seen.velocity)

    def last_known(self, now: float, seen: Motion | None) -> Point | None:
        """Where landings and relative trajectories begin, at rest."""
        origin = self.origin(now, seen)
        return None if origin is None else origin.position

    def follow(
        self, plan: Plan | None, now: float, landing: bool = False, slots: range = range(0)
    ) -> None:
        """A plan was sent; None if nobody knows where it begins."""
        self.flown, self.plan, self.begin = Flown.PLAN, plan, now
        self.landing, self.slots = landing, slots

    def stream(self) -> None:
        """A setpoint was streamed: the planner is disabled."""
        self.stop()
        self.flown = Flown.STREAM

    def stop(self) -> None:
        """The planner was told to stop, or motors were."""
        self.flown, self.plan, self.landing, self.slots = Flown.NOTHING, None, False, range(0)
